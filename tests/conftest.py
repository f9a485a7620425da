"""Shared by all tests: the golden study, the demo, and checkouts that a test may alter."""

from __future__ import annotations

import fcntl
import json
import os
import re
import shutil
import signal
import sqlite3
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

from tests import objectstore
from tests.build.commands import traps
from tests.objectstore import S3
from tests.postgres import LACKING, Postgres, programs

if TYPE_CHECKING:  # aiohttp is imported by the tests that use the provider
    from tests.providers.server import Provider

pytest_plugins = ["tests.tiers"]
ROOT = Path(__file__).resolve().parents[1]
EXPERIMENT = "tests/experiments/small.yaml"  # of the small study, relative to a checkout
SMALL = ROOT / EXPERIMENT
CLIP_CACHE = os.environ.get("TRAPS_CLIP_CACHE", "")  # of the user, for studies that are made once a run
for named in ("TRAPS_WORKSPACE", "DAGSTER_HOME"):  # by a shell, as the README has it: its keys would be all partitions
    os.environ.pop(named, None)
KEY, SECRET = "TRAPS_TEST_KEY", "sk-planted-0123456789abcdef"  # of the test provider


@dataclass(frozen=True)
class Finished:
    """A finished `traps` command."""

    code: int
    out: str
    err: str
    raised: str = ""  # the function whose error ended a command in this process, as `base.files.replace_file`

    def ok(self) -> Finished:
        """Itself; fails with what the command said where it did not end with 0."""
        assert self.code == 0, f"{self.out[-3000:]}\n{self.err[-3000:]}"
        return self

    def counts(self) -> dict[str, int]:
        """Answers asked, votes asked, frames rendered, as the last lines say."""
        summary = r"([\d,]+) answers? asked .*?([\d,]+) votes? asked .*?([\d,]+) frames? rendered"
        found = re.search(summary, self.out, re.DOTALL)
        assert found, f"no summary line in:\n{self.out}\n{self.err}"
        counts = (int(number.replace(",", "")) for number in found.groups())
        return dict(zip(("answers", "votes", "frames"), counts, strict=True))


@dataclass(frozen=True)
class Checkout:
    """A copy of the checkout's code and data, with one workspace, driven by real commands."""

    root: Path
    workspace: Path

    @property
    def environment(self) -> dict[str, str]:
        """What a shell in this checkout exports."""
        own = {"TRAPS_WORKSPACE": self.workspace, "DAGSTER_HOME": self.workspace / "dagster", "PYTHONPATH": self.root}
        return os.environ | {name: str(value) for name, value in own.items()}

    def start(self, *command: str | Path) -> subprocess.Popen[str]:
        """A command in the checkout, in a process group of its own."""
        return subprocess.Popen(
            list(map(str, command)),
            cwd=self.root,
            env=self.environment,
            text=True,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            start_new_session=True,
        )

    def run(self, *command: str | Path) -> Finished:
        """Run a command to its end."""
        process = self.start(*command)
        out, err = process.communicate()
        return Finished(process.returncode, out, err)

    def python(self, *arguments: str | Path) -> Finished:
        """Run Python in the checkout, with `-m MODULE` or `-c CODE`; a program of the latter prints no warnings."""
        quiet = ("-W", "ignore") if arguments[0] == "-c" else ()
        return self.run(sys.executable, *quiet, *arguments)

    def traps(self, *arguments: str | Path) -> Finished:
        """Run a `traps` command: in this process, or in one of its own where the checkout is a copy of this one."""
        if self.root == ROOT:
            return Finished(*traps([*map(str, arguments)], ROOT, self.environment))
        return self.python("-m", "traps_pipeline.cli", *arguments)

    def score(self, experiment: str | Path) -> Finished:
        """`traps run` up to the leaderboard: most tests have nothing to see in the figures and pages after it."""
        return self.traps("run", experiment, "--until", "leaderboard")

    def dagster(self, *arguments: str | Path) -> Finished:
        """Run a `dagster` command."""
        return self.python("-m", "dagster", *arguments)

    def correct(self, scenario_id: str, action: str = "correct", **changes: Any) -> None:
        """Append a review decision."""
        assert self.root != ROOT, "this would change the checkout that is tested: use own_study"
        decision = {
            "scenario_id": scenario_id,
            "action": action,
            **changes,
            "who": "test",
            "when": "2026-11-21",
            "why": "test",
        }
        folder = self.root / "scene_specs" / "corrections"
        folder.mkdir(exist_ok=True)
        with (folder / "review.jsonl").open("a") as stream:
            stream.write(json.dumps(decision) + "\n")

    def ledger_rows(self, kind: str) -> list[dict[str, Any]]:
        """Every complete row of a ledger, repeated keys too."""
        return [json.loads(content) for content in self.ledger_values(kind, "content")]

    def ledger_values(self, kind: str, column: str) -> list[Any]:
        """A column of all rows of a ledger, read without this project's code."""
        path = self.workspace / "ledger" / "ledger.sqlite"
        if not path.exists():
            return []
        join = "traps_rows r join traps_evaluations e on r.evaluation = e.id"
        with closing(sqlite3.connect(path, timeout=600)) as opened:
            try:
                values = opened.execute(
                    f"select r.{column} from {join} where e.kind = ? order by r.id", [kind]
                ).fetchall()
            except sqlite3.OperationalError:  # its tables are not there yet
                return []
        return [value for (value,) in values]

    def in_flight_usd(self) -> float:
        """Dollars of calls that are in flight, or were when a process died."""
        with closing(sqlite3.connect(self.workspace / "ledger" / "ledger.sqlite", timeout=600)) as opened:
            return opened.execute("select coalesce(sum(usd), 0) from traps_reservations").fetchone()[0]


def make_checkout(root: Path) -> Path:
    """Copy what the package needs to run, with what Python has compiled: the commands of tests need not do it again."""
    for name in ("traps_pipeline", "traps_cluster", "traps_soft_bodies", "assets", "scene_specs"):
        shutil.copytree(ROOT / name, root / name)
    for name in ("LICENSE-DATA", "CITATION.cff"):
        shutil.copy(ROOT / name, root / name)
    return root


def copy_workspace(source: Path, target: Path) -> None:
    """Copy a study, its Dagster history with it: nothing in it names where it was made."""
    shutil.copytree(source, target, symlinks=True)


def pytest_sessionstart() -> None:
    """What tests start is stopped by signals, also where this run was itself started in the background.

    Tests count what they render: only studies that are made once a run take clips from the cache of this machine.
    """
    os.environ["TRAPS_CLIP_CACHE"] = "off"
    for stop in (signal.SIGINT, signal.SIGHUP):
        if signal.getsignal(stop) is signal.SIG_IGN:
            signal.signal(stop, signal.default_int_handler if stop is signal.SIGINT else signal.SIG_DFL)


@pytest.fixture(scope="session")
def shared_provider() -> Iterator[Provider]:
    """A server that speaks like providers do and misbehaves as it is told."""
    from tests.providers.server import Provider

    with Provider.start() as provider:
        yield provider


@pytest.fixture
def provider(shared_provider: Provider, monkeypatch: pytest.MonkeyPatch) -> Provider:
    """The server as just started, and its key in the environment."""
    monkeypatch.setenv(KEY, SECRET)
    return shared_provider.afresh()


def once(factory: pytest.TempPathFactory, name: str, make: Callable[[Path], str]) -> Path:
    """A folder that is made once for all workers of a test run; `make` returns what it printed (`<name>.out`).

    Where it cannot be made, the first test that wants it says why, and all others that it could not be made.
    TRAPS_TEST_STUDIES names a folder that keeps them for further runs, while one works on what needs them.
    """
    shared = factory.getbasetemp()
    shared = shared.parent if os.environ.get("PYTEST_XDIST_WORKER") else shared
    shared = Path(os.environ.get("TRAPS_TEST_STUDIES") or shared)
    with (shared / f"{name}.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if (shared / f"{name}.failed").exists():
            pytest.fail(f"the study {name} could not be made: see the first test that failed for it", pytrace=False)
        if not (shared / f"{name}.out").exists():
            try:
                printed = make(shared / name)
            except Exception:
                (shared / f"{name}.failed").touch()
                raise
            (shared / f"{name}.out").write_text(printed)
    return shared / name


def run_once(
    factory: pytest.TempPathFactory, name: str, experiment: str | Path, clips: Path | None = None, *more: str
) -> Checkout:
    """A study of this checkout, run once. Clips of another study may be taken over: their names are their content."""

    def make(workspace: Path) -> str:
        if clips:
            shutil.copytree(clips, workspace / "clips")
        with pytest.MonkeyPatch.context() as patch:
            patch.setenv("TRAPS_CLIP_CACHE", CLIP_CACHE)
            finished = Checkout(ROOT, workspace).traps("run", experiment, *more)
        assert finished.code == 0, finished.out + finished.err
        return finished.out

    return Checkout(ROOT, once(factory, name, make))


@pytest.fixture(scope="session")
def demo(tmp_path_factory: pytest.TempPathFactory) -> Checkout:
    """The demo, run once by the command of `make demo`. Read only: copy it before changing anything."""
    return run_once(tmp_path_factory, "demo", "demo")


@pytest.fixture(scope="session")
def demo_output(demo: Checkout) -> str:
    """What the demo printed."""
    return demo.workspace.with_suffix(".out").read_text()


@pytest.fixture(scope="session")
def small(tmp_path_factory: pytest.TempPathFactory) -> Checkout:
    """The golden study, from records to report: three models, two regimes, three scenarios a family. Made once a test
    run and copied: what a correction does there it does in any study."""
    return run_once(tmp_path_factory, "small", SMALL)


@pytest.fixture(scope="session")
def small_output(small: Checkout) -> str:
    """What making the golden study printed."""
    return small.workspace.with_suffix(".out").read_text()


def copy_of(source: Checkout, folder: Path) -> Checkout:
    """A copy of a study; code and data are those of this checkout, so that its commands run in this process."""
    copy_workspace(source.workspace, folder / "study")
    return Checkout(ROOT, folder / "study")


def copied(source: Checkout, folder: Path) -> Checkout:
    """A copy of a study in a checkout of its own, whose code and data may be altered, too."""
    root = make_checkout(folder / "checkout")
    shutil.copytree(SMALL.parent, root / "tests" / "experiments")
    copy_workspace(source.workspace, folder / "study")
    return Checkout(root, folder / "study")


@pytest.fixture
def study(small: Checkout, tmp_path: Path) -> Checkout:
    """A copy of the small study; its experiment is `EXPERIMENT`. Code and data are those of this checkout."""
    return copy_of(small, tmp_path)


@pytest.fixture
def own_study(small: Checkout, tmp_path: Path) -> Checkout:
    """A copy of the small study in a checkout of its own, for a test that alters code, records or registry."""
    return copied(small, tmp_path)


@pytest.fixture
def demo_study(demo: Checkout, tmp_path: Path) -> Checkout:
    """A copy of the finished demo in a checkout of its own."""
    return copied(demo, tmp_path)


def forget_answers(study: Checkout) -> Checkout:
    """Leave clips and items, with nothing asked yet."""
    for table in (study.workspace / "tables").iterdir():
        if table.name not in ("scene_specs", "videos", "items"):
            shutil.rmtree(table)
    shutil.rmtree(study.workspace / "ledger", ignore_errors=True)  # there is none before the first answer
    shutil.rmtree(study.workspace / "reports")
    (study.workspace / "reports").mkdir()
    return study


@pytest.fixture(scope="session")
def one_regime(small: Checkout, tmp_path_factory: pytest.TempPathFactory) -> Checkout:
    """The small study's items put to four reference models, scored without a disturbance. Read only."""
    clips, until = small.workspace / "clips", ("--until", "leaderboard")
    return run_once(tmp_path_factory, "one_regime", SMALL.with_name("one_regime.yaml"), clips, *until)


@pytest.fixture
def unasked(study: Checkout) -> Checkout:
    """The small study's clips and items, with nothing asked yet."""
    return forget_answers(study)


@pytest.fixture
def tiny_disk(tmp_path: Path) -> Iterator[Path]:
    """A folder on a disk of 64 KiB: a full disk without filling anybody's."""
    folder = tmp_path / "tiny-disk"
    folder.mkdir()
    if os.geteuid() != 0:
        pytest.skip("mounting a tmpfs needs root")
    mount = ["mount", "-t", "tmpfs", "-o", "size=64k", "none", str(folder)]
    if subprocess.run(mount, capture_output=True, check=False).returncode != 0:
        pytest.skip("mounting a tmpfs is not permitted here")
    try:
        yield folder
    finally:
        subprocess.run(["umount", "--lazy", str(folder)], check=True)


@pytest.fixture(scope="session")
def postgres() -> Iterator[Postgres]:
    """A server for the tests of a process, each of which uses a study of its own."""
    if programs() is None:
        pytest.skip(LACKING)
    pytest.importorskip("psycopg", reason="psycopg is not installed; `pip install -e '.[dev]'` brings it")
    from traps_cluster.postgres import GRACE_S

    with Postgres.running() as server:
        time.sleep(GRACE_S)  # until then a lock is kept for sessions that had it before the server was started
        yield server


@pytest.fixture(scope="session")
def s3() -> Iterator[S3]:
    """A server for the tests of a process, each of which uses a study of its own; its keys are in the environment."""
    if not objectstore.is_installed():
        pytest.skip(objectstore.LACKING)
    with S3.running() as server, objectstore.exported(server):
        yield server
