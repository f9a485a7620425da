"""A PostgreSQL server of Debian's, as a test or a benchmark starts, kills and restarts it: its own folder, a port of
this machine alone, and a password that a wrong one is told from."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path

from tests.providers.servers import closed_port

USER, PASSWORD = "traps", "a-password-0123"
START_S = 600
LACKING = "PostgreSQL's initdb was not found; Debian's package `postgresql` brings it"


@cache
def programs() -> Path | None:
    """The folder of initdb and postgres; None where they are not installed. Debian keeps them off the path."""
    found = shutil.which("initdb")
    if found:
        return Path(found).resolve().parent
    return max(Path("/usr/lib/postgresql").glob("*/bin"), key=lambda path: float(path.parent.name), default=None)


@dataclass
class Postgres:
    """A server with an empty database. Made by `Postgres.running`."""

    folder: Path
    port: int
    durable: bool
    process: subprocess.Popen[bytes] | None = field(default=None)

    @classmethod
    @contextmanager
    def running(cls, *, durable: bool = False) -> Iterator[Postgres]:
        """A server until the block ends. durable: it syncs to the disk as a real one does, which tests of processes
        that are killed need not wait for."""
        folder = Path(tempfile.mkdtemp(prefix="pg-"))  # short: the name of a Unix socket holds 107 characters
        server = cls(folder, closed_port(), durable)
        try:
            if server._user is not None:
                shutil.chown(folder, server._user)
            (folder / "password").write_text(PASSWORD)
            (folder / "password").chmod(0o644)
            server._run(
                "initdb", "--pgdata", str(folder / "data"), "--username", USER, "--pwfile", str(folder / "password"),
                "--auth", "scram-sha-256", "--encoding", "UTF8", "--locale", "C", "--no-sync",
            )  # fmt: skip
            server.start()
            yield server
        finally:
            server.stop(signal.SIGQUIT)
            shutil.rmtree(folder, ignore_errors=True)

    @property
    def _user(self) -> str | None:
        """Who runs the server: it refuses root."""
        return "postgres" if os.geteuid() == 0 else None

    def address(self, *, database: str = "postgres", password: str = PASSWORD, port: int | None = None) -> str:
        """The address as a study's variable holds it."""
        return f"postgresql://{USER}:{password}@127.0.0.1:{port or self.port}/{database}"

    def start(self) -> None:
        """Start the server and wait until it answers."""
        options = {
            "listen_addresses": "127.0.0.1", "port": self.port, "unix_socket_directories": self.folder,
            "fsync": "on" if self.durable else "off", "max_connections": 100, "shared_buffers": "32MB",
        }  # fmt: skip
        settings = [f"--{name}={value}" for name, value in options.items()]
        with (self.folder / "log").open("ab") as log:
            self.process = subprocess.Popen(
                [self._program("postgres"), "-D", str(self.folder / "data"), *settings],
                stdout=log, stderr=log, user=self._user, cwd=self.folder, start_new_session=True,
            )  # fmt: skip
        until = time.monotonic() + START_S
        while subprocess.run(
            [self._program("pg_isready"), "-q", "-h", "127.0.0.1", "-p", str(self.port)], check=False
        ).returncode:
            said = (self.folder / "log").read_text()[-2000:]
            assert self.process.poll() is None and time.monotonic() < until, f"PostgreSQL does not start:\n{said}"
            time.sleep(0.05)

    def stop(self, by: signal.Signals = signal.SIGQUIT) -> None:
        """End the server: SIGQUIT, immediately, as in a crash of the machine; SIGINT, in order."""
        if self.process is not None:
            self.process.send_signal(by)
            self.process.wait()
            self.process = None

    def _program(self, name: str) -> str:
        folder = programs()
        assert folder is not None, LACKING
        return str(folder / name)

    def _run(self, program: str, *arguments: str) -> None:
        subprocess.run(
            [self._program(program), *arguments], check=True, capture_output=True, user=self._user, cwd=self.folder
        )
