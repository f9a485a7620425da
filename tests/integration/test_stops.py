"""Commands that are started where SIGINT is ignored, as by `&` in a script, end with all that they started."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import time
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path

import pytest

from tests.build.processes import MARK, marked, wait_until_gone
from tests.conftest import ROOT, Checkout
from tests.providers.servers import closed_port
from traps_pipeline.pipeline.webserver import AGAIN

pytestmark = pytest.mark.slow
START_S, END_S = 600, 120  # nine times what a busy machine of two cores takes
TOKEN = "token-of-the-user-interface"


class Background:
    """`traps` commands of one study in the background of a script, below `nohup` where a test says so."""

    def __init__(self, folder: Path) -> None:
        self.mark, self.log = folder.name, folder / "log"
        self.environment = os.environ | {
            MARK: self.mark,
            "TRAPS_WORKSPACE": str(folder / "study"),
            "DAGSTER_HOME": str(folder / "study" / "dagster"),
        }
        self.port = closed_port()

    def traps(self, *arguments: str, before: str = "") -> int:
        """Start a command; returns its process id."""
        command = f'trap "" INT; {before} {sys.executable} -m traps_pipeline.cli "$@" >&2 & echo $!'
        with self.log.open("w") as log:
            shell = subprocess.run(
                ["sh", "-c", command, "sh", *arguments], cwd=ROOT, env=self.environment,
                stdout=subprocess.PIPE, stderr=log, text=True, check=True,
            )  # fmt: skip
        return int(shell.stdout)

    def wait_until(self, condition: Callable[[], bool]) -> None:
        until = time.monotonic() + START_S
        while not condition():
            assert marked(self.mark) and time.monotonic() < until, self.log.read_text()
            time.sleep(0.2)

    def answers(self) -> bool:
        """Whether a server of the study answers at the port."""
        address = f"http://127.0.0.1:{self.port}/server_info"
        request = urllib.request.Request(address, headers={"Authorization": f"Bearer {TOKEN}"})
        with suppress(OSError), urllib.request.urlopen(request, timeout=5) as response:
            return response.status == 200
        return False


@pytest.fixture
def background(tmp_path: Path) -> Iterator[Background]:
    started = Background(tmp_path)
    subprocess.run(
        [sys.executable, "-m", "traps_pipeline.cli", "init", "demo"], cwd=ROOT, env=started.environment, check=True
    )
    yield started
    for pid in marked(started.mark):
        os.kill(pid, signal.SIGKILL)


@pytest.mark.parametrize("stop", [signal.SIGINT, signal.SIGTERM, signal.SIGKILL])
def test_no_process_of_the_pages_outlives_the_command(background: Background, stop: signal.Signals) -> None:
    pid = background.traps("ui", "--port", str(background.port), "--token", TOKEN, before="nohup")
    background.wait_until(background.answers)
    # The command's two processes, web server, daemon, code server, and the one that has loaded the code.
    background.wait_until(lambda: len(marked(background.mark)) >= 6)
    os.kill(pid, signal.SIGHUP)  # `nohup` has it ignored
    time.sleep(2)
    assert background.answers()
    os.kill(pid, stop)
    wait_until_gone(background.mark, END_S)
    told = background.log.read_text()
    assert "Dagster" in told.partition(f"http://127.0.0.1:{background.port}/?token={TOKEN}")[0]  # which takes a while
    assert AGAIN in told


@pytest.mark.parametrize("stop", [signal.SIGTERM, signal.SIGKILL])
def test_no_process_of_a_run_outlives_it(background: Background, stop: signal.Signals) -> None:
    pid = background.traps("run", "demo")
    background.wait_until(lambda: len(marked(background.mark)) > 2)  # it draws, with processes of its own
    os.kill(pid, stop)
    wait_until_gone(background.mark, END_S)


@pytest.mark.parametrize(
    ("pages", "stop"),
    [(("review", "--token", TOKEN), signal.SIGINT), (("annotate",), signal.SIGTERM)],
    ids=["review", "annotate"],
)
def test_pages_for_people_end(
    background: Background, small: Checkout, pages: tuple[str, ...], stop: signal.Signals
) -> None:
    background.environment["TRAPS_WORKSPACE"] = str(small.workspace)
    pid = background.traps("people", *pages, "--who", "jd", "--port", str(background.port))
    background.wait_until(lambda: _listens(background.port))
    os.kill(pid, stop)
    wait_until_gone(background.mark, END_S)


def _listens(port: int) -> bool:
    with socket.socket() as probe:
        return probe.connect_ex(("127.0.0.1", port)) == 0
