"""Commands in processes of their own that need not import the libraries: they are forked from one that has them.

Importing Dagster, SQLAlchemy, pandas and others is most of what a short command does, and the tests give hundreds. Only
libraries are there beforehand, nothing of this package, and none that reads its settings as it is imported, but for
litellm, which has those that `models.api` imports it with (tests/models/test_api.py tries that import itself). Who
wants a process to be started in full (to be killed, traced or timed) starts the interpreter; so does a shell.

`python tests/forked.py FD` serves a test process over a socket until that ends. Once it has forked, the new process
goes on as the command, and ends as any interpreter does.
"""

from __future__ import annotations

import atexit
import gc
import importlib
import json
import os
import runpy
import selectors
import socket
import subprocess
import sys
import threading
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from tempfile import TemporaryFile
from typing import Any

LIBRARIES = (
    "dagster",
    "dagster._core.execution.plan.execute_plan",
    "dagster._core.executor.in_process",
    "dagster._core.storage.event_log.sqlite",
    "dagster._core.storage.runs.sqlite",
    "dagster._core.storage.schedules.sqlite",
    "dagster._core.storage.local_compute_log_manager",
    "dagster._core.storage.sqlite_storage",
    "dagster._core.storage.root",
    "dagster._core.instance.factory",
    "dagster._core.secrets.env_file",
    "upath.implementations.local",
    "alembic.command",
    "sqlalchemy.dialects.sqlite",
    "numpy",
    "pandas",
    "pyarrow.parquet",
    "rich.console",
    "rich.live",
    "scipy.stats",
    "scipy.optimize",
    "sklearn.linear_model",
    "sklearn.metrics",
    "matplotlib.figure",
    "matplotlib.backends.backend_agg",
    "jinja2",
    "cv2",
    "av",
    "PIL.Image",
    "litellm",
    "litellm.llms.custom_httpx.http_handler",
    "litellm.integrations.custom_logger",
    "openai.types.responses",
)
SETTINGS = {
    "LITELLM_MODE": "PRODUCTION",
    "LITELLM_LOCAL_MODEL_COST_MAP": "True",
    "LITELLM_LOCAL_ANTHROPIC_BETA_HEADERS": "True",
}
# Anything else in the environment may have been read when the process started that commands are forked from.
FREE = ("TRAPS_", "DAGSTER_HOME", "PYTHONPATH", "PYTEST_", "AWS_")
MOST = 150_000  # bytes of a message; an environment has a few thousand


class Forks:
    """The process that commands are forked from, started when the first one is wanted."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._control: socket.socket | None = None
        self._environment: Mapping[str, str] = {}
        self._pid: int | None = None

    def cpu_s(self) -> float:
        """Return the CPU seconds of the process and of the commands that it forked and that have ended."""
        if self._pid is None:
            return 0.0
        stat = Path(f"/proc/{self._pid}/stat").read_text().rpartition(")")[2].split()
        return sum(map(int, stat[11:15])) / os.sysconf("SC_CLK_TCK")  # utime, stime, cutime, cstime

    def run(self, what: Sequence[str | Path], folder: Path, environment: Mapping[str, str]) -> tuple[int, str, str]:
        """Exit code, stdout and stderr of `python` with these arguments, which begin with `-m MODULE` or `-c CODE`, in
        a folder; `-c` without warnings. An environment that the forked process cannot have gets a process started in
        full."""
        control = self._started()
        request = {"what": [*map(str, what)], "folder": str(folder), "environment": dict(environment)}
        asked = json.dumps(request).encode()
        if _bound(environment) != _bound(self._environment) or len(asked) > MOST:
            quiet = ("-W", "ignore") if what[0] == "-c" else ()
            command = [sys.executable, *quiet, *request["what"]]
            how: Any = {"capture_output": True, "text": True, "check": False, "start_new_session": True}
            done = subprocess.run(command, cwd=folder, env=environment, **how)
            return done.returncode, done.stdout, done.stderr
        with TemporaryFile() as out, TemporaryFile() as err:
            ours, theirs = socket.socketpair()
            with ours:
                with theirs:
                    socket.send_fds(control, [asked], [out.fileno(), err.fileno(), theirs.fileno()])
                code = ours.recv(16)
            assert code, f"no end of {what}: the process that it was forked from is gone"
            said = [_read(stream) for stream in (out, err)]
        return int(code), said[0], said[1]

    def _started(self) -> socket.socket:
        with self._lock:
            if self._control is None:
                self._environment = dict(os.environ)
                ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
                clean = {name: value for name, value in self._environment.items() if name != "PYTHONPATH"}
                command = [sys.executable, __file__, str(theirs.fileno())]
                process = subprocess.Popen(command, env=clean, pass_fds=[theirs.fileno()])
                theirs.close()
                self._control, self._pid = ours, process.pid
                atexit.register(lambda: (ours.close(), process.wait()))
            return self._control


def _bound(environment: Mapping[str, str]) -> dict[str, str]:
    return {name: value for name, value in environment.items() if not name.startswith(FREE)}


def _read(stream: Any) -> str:
    stream.seek(0)
    return stream.read().decode().replace("\r\n", "\n").replace("\r", "\n")  # as a pipe in text mode


FORKS = Forks()


# --- the process that is forked ---------------------------------------------------------------------------------------


def serve(control: socket.socket) -> dict[str, Any] | None:
    """Fork for each message. Returns in the new process what it is to do, and None once the test process has ended."""
    with selectors.DefaultSelector() as selector:
        selector.register(control, selectors.EVENT_READ)
        while True:
            for ready, _ in selector.select():
                if ready.data is not None:
                    _tell_end(selector, ready)
                    continue
                asked, descriptors, *_ = socket.recv_fds(control, MOST, 3)
                if not asked:
                    return None
                pid = os.fork()
                if pid == 0:
                    for other in [*selector.get_map().values()]:
                        os.close(other.fd)
                        if other.data is not None:
                            os.close(other.data[1])
                    return json.loads(asked) | {"descriptors": descriptors}
                for descriptor in descriptors[:2]:
                    os.close(descriptor)
                selector.register(os.pidfd_open(pid), selectors.EVENT_READ, (pid, descriptors[2]))


def _tell_end(selector: selectors.BaseSelector, ready: selectors.SelectorKey) -> None:
    pid, reply = ready.data
    code = os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
    selector.unregister(ready.fileobj)
    os.close(ready.fd)
    os.write(reply, str(code).encode())
    os.close(reply)


def become(asked: Mapping[str, Any], base: Sequence[str]) -> None:
    """Be the interpreter that was asked for."""
    os.setsid()
    out, err, reply = asked["descriptors"]
    os.dup2(out, 1)
    os.dup2(err, 2)
    for descriptor in (out, err, reply):
        os.close(descriptor)
    os.chdir(asked["folder"])
    os.environ.clear()
    os.environ.update(asked["environment"])
    how, what, *arguments = asked["what"]
    further = [path for path in os.environ.get("PYTHONPATH", "").split(os.pathsep) if path]
    sys.path[:] = [asked["folder"] if how == "-m" else "", *further, *base]
    importlib.invalidate_caches()
    if how == "-m":
        sys.argv[:] = ["-m", *arguments]
        runpy.run_module(what, run_name="__main__", alter_sys=True)
    else:
        sys.argv[:] = ["-c", *arguments]
        warnings.simplefilter("ignore")
        exec(compile(what, "<string>", "exec"), {"__name__": "__main__"})


if __name__ == "__main__":
    sys.path.pop(0)  # the folder of this file, which no command has
    os.environ.update(SETTINGS)
    for library in LIBRARIES:
        importlib.import_module(library)
    assert threading.active_count() == 1, threading.enumerate()  # no other thread would live on in a fork
    gc.collect()
    gc.freeze()  # or each command would copy what it looks through for garbage
    path = [*sys.path]
    if (asked := serve(socket.socket(fileno=int(sys.argv[1])))) is not None:
        become(asked, path)
