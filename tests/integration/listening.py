"""Servers of `traps people review` and `annotate` as a test starts, asks and kills them."""

from __future__ import annotations

import http.client
import json
import re
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

from tests.conftest import Checkout

TOKEN = "token-of-a-reviewer-0123"


@dataclass
class Server:
    """A server that listens. addresses: by person, "" where one address is for all."""

    port: int
    process: subprocess.Popen[str]
    addresses: dict[str, str]

    @property
    def address(self) -> str:
        return self.addresses[""]

    def ask(self, method: str, path: str, body: Any = None, who: str = "", **headers: str) -> tuple[int, Any]:
        """Status and JSON (or text) of a request with the token."""
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=20)
        token = self.addresses[who].partition("token=")[2]
        sent = {"Content-Type": "application/json", "Authorization": f"Bearer {token}"}
        sent |= {name.replace("_", "-"): value for name, value in headers.items()}
        connection.request(method, path, None if body is None else json.dumps(body), sent)
        answer = connection.getresponse()
        text = answer.read()
        connection.close()
        is_json = (answer.getheader("content-type") or "").startswith("application/json")
        return answer.status, json.loads(text) if is_json else text

    def kill(self) -> None:
        self.process.send_signal(signal.SIGKILL)
        self.process.communicate()


@contextmanager
def listening(study: Checkout, command: str, *people: str, port: int = 0) -> Iterator[Server]:
    """`traps people review` or `traps people annotate` for these people; killed at the end unless it was before."""
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        probe.bind(("127.0.0.1", port))
        port = probe.getsockname()[1]
    called = [sys.executable, "-m", "traps_pipeline.cli", "people", command]
    called += ["--port", str(port), "--token", TOKEN, "--who"]
    process = study.start(*called, *people)
    server = Server(port, process, {})
    try:
        assert process.stdout is not None and process.stderr is not None
        while len(server.addresses) < (1 if command == "review" else len(people)):
            line = process.stdout.readline()
            found = re.fullmatch(r"(?:(.+): )?open (http://127\.0\.0\.1:\d+/\?token=\S+)\n", line)
            assert found, line + process.stderr.read()
            server.addresses[found[1] or ""] = found[2]
        end = time.monotonic() + 540
        while time.monotonic() < end:
            with socket.socket() as probe:
                if probe.connect_ex(("127.0.0.1", port)) == 0:
                    break
            time.sleep(0.05)
        yield server
    finally:
        if process.poll() is None:
            server.kill()
