"""No key is printed, logged or stored by any command, whatever is wrong with it and whatever a server says of it."""

from __future__ import annotations

import json
import re
import threading
from base64 import b64encode
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any
from urllib.parse import quote

import pyarrow.parquet as pq
import pytest
import yaml

from tests.conftest import KEY, ROOT, Checkout, Finished

pytestmark = pytest.mark.slow

CORE = "sk-pL4nt3dQz93XwJk20vB"
REFUSED = {
    "line break": f"{CORE}\n",
    "carriage return": f"{CORE}\r",
    "space after": f"{CORE} ",
    "space before": f" {CORE}",
    "tab": f"{CORE[:9]}\t{CORE[9:]}",
    "control character": f"{CORE}\x1b",
    "not ASCII": f"{CORE}ä",
    "no Unicode": f"{CORE}\udce4",
    "two lines": f"{CORE}\n{CORE[::-1]}",
    "quotes": f'"{CORE}"',
}
TAKEN = {
    "plain": CORE,
    "quotes and dollars": f"{CORE}'$\"`",
    "percent signs": f"%41{CORE}%25%",
    "base64": b64encode(CORE.encode()).decode(),
    "very long": CORE * 150,
}
KINDS = ("refusal", "server-error", "answer", "odd")  # models of the server, by what they do
MATERIALIZE = "asset materialize -m traps_pipeline.definitions --select responses --partition"
COMMANDS = (
    "models check --live {experiment}",
    "plan {experiment}",
    "run {experiment} --until responses",
    "run {experiment} --until votes --no-preflight",
    "models test-panel own",
    "study export-requests {experiment} --batch --out {out}",
    "study export-votes {experiment} --out {out}",
    "doctor",
    *(f"dagster {MATERIALIZE} occlusion|{kind}__standard__run1" for kind in ("refusal", "answer")),
)
SCRIPT = """
import os, shlex, sys
import traps_pipeline.definitions
from dagster._cli import cli as dagster_cli
from traps_pipeline.cli import main
commands, variable, keys = eval(open(sys.argv[1]).read())
for name, key in keys.items():
    os.environ[variable] = key
    for command in commands:
        words = shlex.split(command)
        try:
            code = dagster_cli(words[1:], standalone_mode=False) if words[0] == "dagster" else main(words)
        except Exception:
            sys.excepthook(*sys.exc_info())
            code = 1
        for stream in (sys.stdout, sys.stderr):
            print(f"== {name} == {command} == {code}", file=stream, flush=True)
"""


class _Echo(BaseHTTPRequestHandler):
    """Answers with the key that came in every form: in an error, in an answer, in what is no answer."""

    def do_POST(self) -> None:
        request = json.loads(self.rfile.read(int(self.headers["content-length"])))
        sent = self.headers["authorization"] + " " + repr(self.headers.items())
        forms = (sent, repr(sent), quote(sent), quote(quote(sent)), json.dumps(sent), b64encode(sent.encode()).decode())
        echo = "\n".join((*forms, sent[:20], sent[20:]))
        message = {"role": "assistant", "content": f"The answer is: {echo}", "reasoning_content": echo}
        choice = {"index": 0, "finish_reason": "stop", "message": message}
        usage = {"prompt_tokens": 9000, "completion_tokens": 5000, "total_tokens": 14000}
        answer = {"id": "x", "object": "chat.completion", "created": 1, "model": echo[:90], "usage": usage}
        error = {"error": {"message": echo, "type": echo, "code": echo[:90]}}
        status, body = {"refusal": (400, error), "server-error": (500, error), "odd": (200, {"choices": echo})}.get(
            request["model"], (200, {**answer, "choices": [choice]})
        )
        content = json.dumps(body).encode()
        self.send_response(status)
        self.send_header("content-type", "application/json")
        self.send_header("content-length", str(len(content)))
        self.end_headers()
        self.wfile.write(content)

    def do_GET(self) -> None:
        self.send_error(404)

    def log_message(self, *_: Any) -> None:  # pyright: ignore[reportIncompatibleMethodOverride]
        pass


@pytest.fixture(scope="module")
def address() -> Iterator[str]:
    with ThreadingHTTPServer(("127.0.0.1", 0), _Echo) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{server.server_port}/v1"
        server.shutdown()


@pytest.fixture(scope="module")
def tried(address: str, tmp_path_factory: pytest.TempPathFactory) -> tuple[Checkout, Finished]:
    """A study of one scenario in which every command was given every key, and what was printed."""
    folder = tmp_path_factory.mktemp("secrets")
    common = {"base_url": address, "key": KEY, "limits": {"retries": 0}, "prices": None}
    price = {"input": 0, "output": 0, "as_of": "2026-11-01"}
    experiment = {
        "name": "echo",
        "models": [{"id": kind, **common, "prices": price, "media": "images"} for kind in KINDS],
        "judges": [{"id": "judge", **common, "prices": price, "served_name": "answer"}],
        "panels": {"own": ["judge"]},
        "panel": "own",
        "regimes": ["standard"],
        "runs": [1],
        "datasets": ["occlusion"],
        "scenarios": ["domino_chain-0001"],
        "budget_usd": 5.0,
    }
    (folder / "echo.yaml").write_text(yaml.safe_dump(experiment))
    checkout = Checkout(ROOT, folder / "study")
    checkout.traps("run", folder / "echo.yaml", "--until", "items").ok()
    commands = [command.format(experiment=folder / "echo.yaml", out=folder / "out") for command in COMMANDS]
    (folder / "keys").write_text(repr((commands, KEY, REFUSED | TAKEN)))
    return checkout, checkout.python("-c", SCRIPT, folder / "keys")


def _leaks(content: str) -> list[str]:
    """The forms of the keys that a text holds."""
    parts = {CORE, CORE[::-1], *TAKEN.values()}
    forms = {form for part in parts for form in (part, repr(part)[1:-1], quote(part, safe=""), json.dumps(part)[1:-1])}
    for before in range(3):
        forms.add(b64encode(b"x" * before + CORE.encode()).decode()[4:-4])
    squeezed = "".join(content.split())
    return [form[:30] for form in forms if form in content or form in squeezed]


def test_no_key_is_printed_and_a_refused_one_is_named_by_its_variable(tried: tuple[Checkout, Finished]) -> None:
    _, finished = tried
    assert finished.code == 0, finished.err[-3000:]
    assert _leaks(finished.out) == []
    assert _leaks(finished.err) == []
    for printed, command in ((finished.out, "models check"), (finished.err, "run")):
        parts = re.split(r"^== (.*)\n", printed, flags=re.MULTILINE)
        told = dict(zip(parts[1::2], parts[::2], strict=False))  # by how it ended, what was printed before
        assert len(told) == len(REFUSED | TAKEN) * len(COMMANDS)
        for name in REFUSED:
            end = next(end for end in told if end.startswith(f"{name} == {command} "))
            assert end.endswith("== 1") and KEY in told[end], end


def test_no_key_is_in_any_file_of_the_study(tried: tuple[Checkout, Finished]) -> None:
    checkout, _ = tried
    files = [path for path in checkout.workspace.parent.rglob("*") if path.is_file() and path.name != "keys"]
    assert {path.suffix for path in files} >= {".db", ".parquet", ".sqlite", ".err"}
    leaks = {}
    for path in files:
        if path.suffix == ".parquet":
            content = str(pq.read_table(path).to_pylist())
        else:
            content = path.read_bytes().decode("latin-1")
        if found := _leaks(content):
            leaks[str(path)] = found
    assert leaks == {}


def test_what_the_server_said_is_there_without_the_key(tried: tuple[Checkout, Finished]) -> None:
    checkout, finished = tried
    answers = [row for row in checkout.ledger_rows("answers") if row["components"]["participant"] == "answer"]
    assert answers
    assert "Bearer ***" in str(answers[-1]["text"])
    assert "(http_400: Bearer ***" in finished.err
