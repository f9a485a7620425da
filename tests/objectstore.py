"""An S3 server of this machine, moto's, as a test or a benchmark starts and empties it. It keeps everything in memory
and is no fake of ours: what is tested goes through HTTP, signatures and status codes."""

from __future__ import annotations

import os
import subprocess
import sys
import time
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.util import find_spec

from tests.providers.servers import closed_port

LACKING = "moto's S3 server or obstore is not installed; `pip install -e '.[dev]'` brings both"
START_S = 600


def is_installed() -> bool:
    """Whether the server and the client are there."""
    return all(find_spec(name) for name in ("moto", "flask", "flask_cors", "obstore"))


@dataclass
class S3:
    """A server with the bucket `lab`. Made by `S3.running`."""

    port: int

    @classmethod
    @contextmanager
    def running(cls) -> Iterator[S3]:
        """A server until the block ends."""
        server = cls(closed_port())
        command = [sys.executable, "-m", "moto.server", "-H", "127.0.0.1", "-p", str(server.port)]
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        try:
            until = time.monotonic() + START_S
            while not server._answers():
                assert process.poll() is None and time.monotonic() < until, "moto's server does not start"
                time.sleep(0.05)
            server.make_bucket()
            yield server
        finally:
            process.kill()
            process.wait()

    @property
    def environment(self) -> dict[str, str]:
        """What a person exports to use it."""
        return {
            "AWS_ACCESS_KEY_ID": "a-key", "AWS_SECRET_ACCESS_KEY": "a-secret", "AWS_REGION": "us-east-1",
            "AWS_ENDPOINT": f"http://127.0.0.1:{self.port}", "AWS_ALLOW_HTTP": "true",
        }  # fmt: skip

    def make_bucket(self) -> None:
        """Make the bucket `lab`."""
        self._request("lab", "PUT")

    def empty(self) -> None:
        """Lose everything, the bucket too."""
        self._request("moto-api/reset", "POST")

    def names(self) -> list[str]:
        """The names of all objects."""
        import obstore
        from obstore.store import S3Store

        store = S3Store(
            "lab", config={k.lower(): v for k, v in self.environment.items()}, client_options={"allow_http": True}
        )  # pyright: ignore
        return sorted(one["path"] for page in obstore.list(store) for one in page)

    def _request(self, path: str, method: str) -> bytes:
        request = urllib.request.Request(f"http://127.0.0.1:{self.port}/{path}", method=method)
        with urllib.request.urlopen(request) as answer:
            return answer.read()

    def _answers(self) -> bool:
        try:
            self._request("moto-api/", "GET")
        except OSError:
            return False
        return True


@contextmanager
def exported(server: S3) -> Iterator[None]:
    """The server's address and keys in the environment of this process."""
    former = {name: os.environ.get(name) for name in server.environment}
    os.environ.update(server.environment)
    try:
        yield
    finally:
        for name, value in former.items():
            if value is None:
                os.environ.pop(name)
            else:
                os.environ[name] = value
