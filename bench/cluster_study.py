"""A study of reference models on a cluster of this machine: PostgreSQL, moto's S3 server, a Ray head without CPUs and
two nodes, each with a scratch folder of its own; the study lies on s3:// alone. Then what a cluster must not change is
compared with a run of one process in a folder.

python bench/cluster_study.py [--kill [--at STAGE]] [--interrupt leave|cancel] [--experiment FILE | --mechanism]
(needs the packages of the extra `cluster`, and moto)

--kill: every process of a node is killed (-9) while it renders (or 3 s after the first partition of STAGE), and the
node is started again. --interrupt: Ctrl-C
after the first partition, which leaves or cancels the runs; then the same command once more. --mechanism: hidden
states, probes and steering of a tiny random checkpoint, too, on four scenarios of one family. What else may be killed,
while models are asked: `bench/cluster_kills.py`.
"""

from __future__ import annotations

import argparse
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from traps_cluster.history import export
from traps_cluster.ray_runs import require_cluster
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.pipeline.run import dagster_history
from traps_pipeline.storage.place import name_of
from traps_pipeline.storage.workspace import Workspace

if TYPE_CHECKING:
    from bench.cluster_watch import Opened

ROOT = Path(__file__).resolve().parents[1]
EXPERIMENT = """
name: cluster
description: Reference models, one behind a bad provider, on one scenario of four families.
models: [oracle, flaky, prior]
regimes: [standard]
panel: rules
epoch: cluster
scenarios: [plinko-0001, tumbling_dice-0001, domino_chain-0001, hidden_race-0001]
"""
MECHANISM_UNTIL = "probes,steering_effects,steering_nulls"
ADDRESS = "s3://lab/cluster-study"
NODES = ("one", "two")


class Study:
    """The study as this host sees it, and the daemon of the head."""

    def __init__(
        self,
        folder: Path,
        environment: dict[str, str],
        experiment: Path,
        root: Path = ROOT,
        until: str = "leaderboard",
    ) -> None:
        self.folder, self.environment, self.experiment, self.root = folder, environment, experiment, root
        self.until = until  # the last stages
        self.daemon: subprocess.Popen[bytes] | None = None
        self.home = ""  # Dagster's, once the study is there
        self.failures: list[str] = []

    def traps(self, *arguments: str, **own: str) -> subprocess.CompletedProcess[str]:
        command = [sys.executable, "-m", "traps_pipeline.cli", *arguments]
        return subprocess.run(
            command, env=self.environment | own, cwd=self.root, text=True, capture_output=True, check=False
        )

    def python(self, code: str, *arguments: object) -> str:
        """Return what code prints that works in the study."""
        command = [sys.executable, "-c", code, *map(str, arguments)]
        done = subprocess.run(command, env=self.environment, cwd=self.root, text=True, capture_output=True, check=False)
        if done.returncode:
            raise RuntimeError(done.stderr)
        return done.stdout

    @property
    def dagster(self) -> dict[str, str]:
        """The environment of Dagster's own processes, as `traps ui` starts them."""
        with self.opened() as workspace:
            export(workspace)
            return {**os.environ, "DAGSTER_HOME": self.home}

    @contextmanager
    def opened(self) -> Iterator[Workspace]:
        """The study as a process sees it that has this host's variables: this one, within the block."""
        with self.exported():
            yield Workspace.open()

    @contextmanager
    def exported(self) -> Iterator[None]:
        """This host's variables, within the block those of this process."""
        former = {**os.environ}
        os.environ.clear()
        os.environ.update(self.environment)
        try:
            yield
        finally:
            os.environ.clear()
            os.environ.update(former)

    def start_run(self, *more: str) -> subprocess.Popen[str]:
        command = [sys.executable, "-m", "traps_pipeline.cli", *self._run(*more)]
        return subprocess.Popen(
            command, env=self.environment, cwd=self.root, text=True, stdout=subprocess.PIPE, stderr=subprocess.STDOUT
        )

    def run_to_end(self, *more: str) -> subprocess.CompletedProcess[str]:
        return self.traps(*self._run(*more))

    def _run(self, *more: str) -> list[str]:
        return ["run", str(self.experiment), "--cluster", "--runs", "2", "--until", self.until, *more]

    def start_daemon(self) -> None:
        """What `traps ui` starts beside its pages."""
        said = self.traps("init", str(self.experiment))
        if said.returncode:
            raise SystemExit(said.stderr)
        line = next(line for line in said.stdout.splitlines() if "DAGSTER_HOME=" in line)
        self.home = line.partition("DAGSTER_HOME=")[2]
        with (self.folder / "daemon.log").open("ab") as log:
            command = [sys.executable, "-m", "dagster._daemon", "run", "-m", "traps_pipeline.definitions"]
            self.daemon = subprocess.Popen(command, stdout=log, stderr=log, cwd=self.root, env=self.dagster)
        with self.opened() as workspace, dagster_history(workspace) as instance:
            while True:
                try:
                    require_cluster(workspace, instance)
                    return
                except TrapsError:
                    if self.daemon.poll() is not None:
                        raise
                    time.sleep(0.5)

    def stop(self, keep: Path | None = None) -> None:
        """End the daemon. keep: a file for its log."""
        if self.daemon is not None:
            self.daemon.terminate()
            self.daemon.wait()
            if keep:
                shutil.copy(self.folder / "daemon.log", keep)

    def require(self, holds: bool, what: str) -> None:
        """Print what was looked at, and remember it where it does not hold."""
        print(f"  {'holds' if holds else 'DOES NOT HOLD'}: {what}", flush=True)
        if not holds:
            self.failures.append(what)


def look_inside(folder: Path, experiment: Path) -> dict[str, str]:
    """Write a tiny checkpoint, a registry with it, and an experiment that looks into it; what a shell exports."""
    import yaml

    from tests.build.inside import ENTRY, MECHANISM
    from tools.tiny_checkpoints import build_tiny

    build_tiny("qwen3-vl", folder / "tiny")
    registry = folder / "models.yaml"
    entry = ENTRY.replace("checkpoint: tiny", f"checkpoint: {folder / 'tiny'}")
    registry.write_text((ROOT / "assets" / "models.yaml").read_text() + entry)
    asked = {"models": ["oracle", "flaky"], "regimes": ["standard"], "datasets": ["chaotic", "chaotic_ill_posed"]}
    chosen = {"scenarios": [f"plinko-000{n}" for n in range(1, 5)], "panel": "rules", "judged_by_rules": True}
    about = {"name": "inside", "description": "A look into a tiny model.", "epoch": "cluster"}
    experiment.write_text(yaml.safe_dump({**about, **asked, **chosen, "mechanism": MECHANISM}))
    return {"TRAPS_MODELS": str(registry)}


def watch(run: subprocess.Popen[str], kill: object, at: str = "scene_specs") -> tuple[int, int]:
    """Print what a run says, and kill a node once it tells of a stage; its exit code, and how many calls failed: some
    of `flaky` always do."""
    began, killed, failed = time.monotonic(), kill is None, 0
    assert run.stdout is not None
    for line in run.stdout:
        print(f"  {time.monotonic() - began:6.1f} s  {line.rstrip()}", flush=True)
        failed += sum(int(found) for found in re.findall(r"(\d+) calls? failed; a new run", line))
        if not killed and at in line and "[" in line:
            killed = True
            time.sleep(3)
            kill()  # type: ignore[operator]
    return run.wait(), failed


def asked(said: str) -> int:
    """Return how many answers a command says that it asked; -1 where it says nothing of it."""
    found = re.search(r"^([\d,]+) answers? asked \(", said, re.MULTILINE)
    return int(found[1].replace(",", "")) if found else -1


def main() -> None:
    from bench.cluster_launcher import Cluster
    from bench.cluster_watch import Opened, executing
    from tests.objectstore import S3
    from tests.postgres import Postgres

    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kill", action="store_true")
    parser.add_argument("--at", default="scene_specs", help="a stage: a node is killed 3 s after its first partition")
    parser.add_argument("--log", type=Path, help="a file for the log of Dagster's daemon")
    parser.add_argument("--interrupt", choices=("leave", "cancel"))
    what = parser.add_mutually_exclusive_group()
    what.add_argument("--experiment", type=Path)
    what.add_argument("--mechanism", action="store_true")
    arguments = parser.parse_args()
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background job would ignore it, and so its own
    foreign = ("TRAPS_", "DAGSTER_", "RAY_", "AWS_")
    plain = {key: value for key, value in os.environ.items() if not key.startswith(foreign)}
    with tempfile.TemporaryDirectory(prefix="study-") as name, Postgres.running() as database, S3.running() as store:
        folder = Path(name)
        experiment = arguments.experiment or folder / "cluster.yaml"
        if not arguments.experiment and not arguments.mechanism:
            experiment.write_text(EXPERIMENT)
        common = plain | {"PYTHONPATH": str(ROOT), "TMPDIR": name}
        if arguments.mechanism:
            common |= look_inside(folder, experiment)
        shared = common | store.environment | {
            "TRAPS_DATABASE": database.address(),
            "PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}",  # the launcher calls `dagster`
        }  # fmt: skip
        opens = Opened({node: folder / node for node in NODES})
        cluster = Cluster(folder, shared)
        own = {"TRAPS_RAY": f"http://127.0.0.1:{cluster.dashboard}", "TRAPS_WORKSPACE": ADDRESS}
        until = MECHANISM_UNTIL if arguments.mechanism else "leaderboard"
        study = Study(folder, shared | own | {"TRAPS_SCRATCH": str(folder / "here")}, experiment, until=until)
        try:
            cluster.start_head()
            for node in NODES:
                cluster.start_node(node)
            study.start_daemon()

            def kill() -> None:
                here = {pid for node in NODES for pid in cluster.processes(node)}
                busy = [node for pid, (_, node) in executing().items() if pid in here] or ["one"]
                print(f"  {cluster.signal(busy[0], signal.SIGKILL)} processes of {busy[0]} killed", flush=True)
                cluster.start_node(busy[0])

            began = time.monotonic()
            if arguments.interrupt:
                run = study.start_run("--on-interrupt", arguments.interrupt)
                code, _ = watch(run, lambda: run.send_signal(signal.SIGINT))
                study.require(code == 130, f"Ctrl-C ends the command (exit code {code})")
                time.sleep(5)
                states = runs_of(study)
                print(f"  runs: {states}", flush=True)
                is_left = not ({"CANCELED", "CANCELING", "FAILURE"} & {*states})
                study.require(is_left == (arguments.interrupt == "leave"), f"their runs: {arguments.interrupt}")
            code, failed = watch(study.start_run(), kill if arguments.kill else None, arguments.at)
            print(f"  the study took {time.monotonic() - began:.0f} s on two nodes")
            study.require(code == (1 if failed else 0), f"the run ends well but for {failed} calls (exit code {code})")
            again = study.run_to_end()
            study.require(asked(again.stdout) == failed, f"a second run asks nothing but {failed} calls that failed")
            if arguments.mechanism:
                said = "inside models: 0 items extracted, 0 steered answers asked (0 from"
                study.require(said in again.stdout, "and extracts and steers nothing")
            nodes_are_apart(study, opens)
            compare_with_one_process(study, common, code)
        finally:
            study.stop(arguments.log)
            for node in (*NODES, "head"):
                cluster.signal(node, signal.SIGKILL)
            opens.let_go()
    if study.failures:
        sys.exit("\n".join(study.failures))


# The database may hold the history of other studies, too. A run that a page launched has no tag of ours while it waits.
RUNS = """
from dagster import DagsterEventType as T, DagsterInstance
from traps_cluster.history import export
from traps_pipeline.storage.workspace import Workspace
workspace = Workspace.open()
export(workspace)
instance = DagsterInstance.from_config(str(workspace.dagster_home))
mine = workspace.study.name
runs = [run for run in instance.get_runs() if any(key.path[0] == mine for key in run.asset_selection or ())]
"""


def runs_of(study: Study) -> list[str]:
    """Return what became of the study's runs."""
    return study.python(f"{RUNS}print(*(run.status.value for run in runs))").split()


def failures_of(study: Study) -> str:
    """Return what the study's failed runs said, a line for each error."""
    return study.python(f"""{RUNS}
for run in runs:
    if run.status.value == "FAILURE":
        for entry in instance.all_logs(run.run_id, of_type={{T.STEP_FAILURE, T.RUN_FAILURE, T.ENGINE_EVENT}}):
            error = getattr(entry.dagster_event.event_specific_data, "error", None)
            while error is not None and error.cause is not None:
                error = error.cause
            print(run.run_id[:8], entry.dagster_event.message, error.to_string() if error else "")
""")


def nodes_are_apart(study: Study, opens: Opened, *, least: int = len(NODES)) -> None:
    """Look whether nodes have worked in their own scratch folders, so many with tables there, and none has opened a
    file of another's."""
    folders = {node: study.folder / node for node in NODES}
    strays = [
        path for folder in folders.values() for path in folder.rglob("*")
        if path.is_symlink() or not path.resolve().is_relative_to(folder)
    ]  # fmt: skip
    mine = name_of(study.environment["TRAPS_WORKSPACE"])  # nodes may have made other studies before
    made = {node: len([*(folder / mine).rglob("*.parquet")]) for node, folder in folders.items()}
    enough = sum(count > 0 for count in made.values()) >= least
    study.require(not strays and enough, f"at least {least} nodes have tables in their own folders: {made}")
    if not opens.is_on:
        if least == len(NODES):
            study.require(os.geteuid() != 0, "root sees which files nodes open")
        print("  not looked at: which files nodes open (that needs root, and mounts)", flush=True)
        return
    own = {node: opens.counts.get((node, node), 0) for node in NODES}
    study.require(all(own.values()), f"each node opens files of its own folder: {own}")
    study.require(not opens.strangers(), f"and no files of the other's: {opens.strangers()}")


def fetch(study: Study, to: Path) -> Path:
    """Bring the study's tables and clips into a folder."""
    with study.opened() as workspace:
        for name in ("tables", "clips", "states"):
            workspace.bring_folder(workspace.root / name)
            for path in workspace.store.below(workspace.root / name):
                copy = to / path.relative_to(workspace.root)
                copy.parent.mkdir(parents=True, exist_ok=True)
                copy.write_bytes(path.read_bytes())
    return to


def compare_with_one_process(study: Study, common: dict[str, str], code: int) -> None:
    """Make the study once more in a folder, in one process, and compare. code: how the cluster's command ended."""
    alone = study.folder / "alone"
    fetched, began = fetch(study, study.folder / "fetched"), time.monotonic()
    local = subprocess.run(
        [sys.executable, "-m", "traps_pipeline.cli", "run", str(study.experiment), "--until", study.until],
        env=common | {"TRAPS_WORKSPACE": str(alone)}, cwd=ROOT, text=True, capture_output=True, check=False,
    )  # fmt: skip
    study.require(local.returncode == code, f"one process makes it too: {local.stderr[-500:]}")
    print(f"  one process took {time.monotonic() - began:.0f} s: {local.stdout.strip().splitlines()[-2]}", flush=True)
    tables_are_equal(study, alone, fetched)


def tables_are_equal(study: Study, alone: Path, fetched: Path) -> None:
    """Look whether tables and clips are those of one process."""
    from bench.equality import main as compare

    study.require(compare(alone, fetched) == 0, "tables are equal, byte for byte but for times")
    clips = {path.relative_to(fetched): path.read_bytes() for path in (fetched / "clips").rglob("*.mp4")}
    same = all((alone / name).is_file() and (alone / name).read_bytes() == content for name, content in clips.items())
    study.require(bool(clips) and same, f"{len(clips)} clips have the same bytes")
    extracted, there = ({path.relative_to(root) for path in (root / "states").rglob("*.safetensors")}
                        for root in (fetched, alone))  # fmt: skip
    found = {name: _states(fetched / name) for name in extracted}
    same = all(tensors is not None and tensors == _states(alone / name) for name, tensors in found.items())
    count = sum(len(one[0]) for one in found.values() if one is not None)
    looked = bool(extracted) == bool(there)  # none fetched of those that one process has would be no look at all
    study.require(looked and same, f"{len(extracted)} files of hidden states hold the same {count} tensors and digests")


def _states(path: Path) -> tuple[dict[str, bytes], dict[str, str]] | None:
    """Return tensors and what is said of them: a file has them in an order of its own."""
    from safetensors import safe_open

    if not path.is_file():
        return None
    with safe_open(path, "np") as file:
        return {name: file.get_tensor(name).tobytes() for name in file.keys()}, file.metadata()  # noqa: SIM118


if __name__ == "__main__":
    main()
