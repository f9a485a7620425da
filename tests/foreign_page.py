"""A page of another site in a real browser that does what it can to a server on this machine."""

from __future__ import annotations

import http.server
import json
import threading
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor

from playwright.sync_api import sync_playwright

from tests.pages import CHROMIUM, QUIET, patient

REBOUND = "rebound.test"  # a name that its owner has bound to this machine

PAGE = """<!doctype html><title>working</title><body><script>
const target = "%(target)s", queries = %(queries)s, seen = [];
async function told(promise) {
  try {
    const answer = await promise;
    const read = answer.ok ? "read: " + (await answer.text()).slice(0, 80) : "refused";
    seen.push(answer.type === "opaque" ? "opaque" : read);
  } catch { seen.push("refused"); }
}
function framed() {
  return new Promise(done => {
    const frame = document.createElement("iframe");
    frame.src = target + "/";
    frame.onload = () => {
      try { done(frame.contentDocument ? "read: a frame" : "refused"); } catch { done("refused"); }
    };
    document.body.append(frame);
  });
}
function socket(query) {
  return new Promise(done => {
    const ws = new WebSocket(target.replace("http", "ws") + "/graphql", "graphql-ws");
    ws.onopen = () => {
      ws.send(JSON.stringify({type: "connection_init"}));
      ws.send(JSON.stringify({id: "1", type: "start", payload: {query}}));
      setTimeout(() => done("read: a socket"), 300);
    };
    ws.onerror = ws.onclose = () => done("refused");
  });
}
(async () => {
  await told(fetch(target + "/server_info"));
  await told(fetch(target + "/server_info", {credentials: "include"}));
  for (const query of queries) {
    const json = JSON.stringify({query});
    for (const mode of ["cors", "no-cors"]) {
      const to = {mode, credentials: "include"}, text = {"content-type": "text/plain"};
      await told(fetch(target + "/graphql?query=" + encodeURIComponent(query), to));
      await told(fetch(target + "/graphql", {...to, method: "POST", body: json, headers: text}));
      await told(fetch(target + "/graphql", {...to, method: "POST", body: new URLSearchParams({query})}));
    }
    await told(fetch(target + "/graphql", {method: "POST", body: json, headers: {"content-type": "application/json"}}));
    navigator.sendBeacon(target + "/graphql", json);
    seen.push(await socket(query));
  }
  seen.push(await framed());
  document.body.dataset.seen = JSON.stringify(seen);
})();
</script>"""


def attack(port: int, queries: Sequence[str], cookies: Sequence[tuple[str, str]] = ()) -> list[str]:
    """What a page of another origin, and one under a name that is bound to this machine, get from a server here: of
    each try "refused", "opaque" or "read: ...". cookies: of the server, as a browser has them that uses it."""
    with ThreadPoolExecutor(1) as thread:  # Playwright has one browser's loop a thread, and the test may have its own
        return thread.submit(_attack, port, queries, cookies).result()


def _attack(port: int, queries: Sequence[str], cookies: Sequence[tuple[str, str]]) -> list[str]:
    served: dict[str, str] = {}

    class Foreign(http.server.BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            page = served.get(self.path, "").encode()
            self.send_response(200)
            self.send_header("content-type", "text/html")
            self.end_headers()
            self.wfile.write(page)

        def log_message(self, format: str, *args: object) -> None:
            pass

    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), Foreign) as server, sync_playwright() as playwright:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        own = f"http://127.0.0.1:{port}"
        rebound = f"http://{REBOUND}:{port}"
        served |= {
            "/origin": PAGE % {"target": own, "queries": json.dumps(queries)},
            "/rebound": PAGE % {"target": rebound, "queries": json.dumps(queries)},
        }
        rules = f"--host-resolver-rules=MAP {REBOUND} 127.0.0.1, MAP attacker.test 127.0.0.1"
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=[*QUIET, rules])
        context = browser.new_context()
        context.add_cookies([{"name": name, "value": value, "url": own} for name, value in cookies])
        seen = list[str]()
        for path in served:
            page = patient(context.new_page())
            page.goto(f"http://attacker.test:{server.server_port}{path}")
            page.wait_for_function("document.body.dataset.seen", timeout=60_000)
            seen += json.loads(str(page.evaluate("document.body.dataset.seen")))
        answer = patient(context.new_page()).goto(f"{rebound}/")  # what a rebound name shows as its own page
        seen.append("refused" if answer is None or answer.status >= 400 else "read: its page")
        browser.close()
        server.shutdown()
    return seen
