"""What Dagster's run queue and dagster-ray's launcher do when things are killed: PostgreSQL for the history, a Ray head
without CPUs, two nodes with a scratch folder each, all on this machine. Prints what became of each run and when.

python bench/cluster_launcher.py [run] [node] [head] [stopped] [postgres]    (needs the packages of the extra `cluster`)
"""

from __future__ import annotations

import argparse
import os
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, LiteralString

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))
POLL_S, WATCH_S, STEPS = 15, 240, 60
# As `deploy/` sets them: a node that does not answer is dead after 24 s; as Ray has them (5 times 10 s), after 65.
HEALTH = {"RAY_health_check_timeout_ms": "5000", "RAY_health_check_failure_threshold": "3"}
ENDED = ("SUCCESS", "FAILURE", "CANCELED")
DAGSTER_YAML = """
telemetry: {{enabled: false}}
storage: {{postgres: {{postgres_url: {{env: TRAPS_LAUNCHER_HISTORY}}}}}}
run_launcher:
  module: dagster_ray
  class: RayRunLauncher
  config: {{ray: {{address: "http://127.0.0.1:{dashboard}", num_cpus: 1}}}}
run_monitoring: {{enabled: true, poll_interval_seconds: {poll}, max_resume_run_attempts: 3, start_timeout_seconds: 90}}
concurrency: {{runs: {{max_concurrent_runs: 2}}}}
"""


def free_port() -> int:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        return free.getsockname()[1]


class Cluster:
    """A Ray head and two nodes of this machine, each recognised by its scratch folder in the environment of its
    processes: a machine may have several clusters."""

    def __init__(
        self,
        folder: Path,
        environment: dict[str, str],
        own: dict[str, dict[str, str]] | None = None,
        within: dict[str, list[str]] | None = None,
    ) -> None:
        """own: variables of a node; within: words before the command that starts it."""
        self.folder, self.environment, self.own, self.within = folder, environment, own or {}, within or {}
        self.port, self.dashboard = free_port(), free_port()

    def start_head(self) -> None:
        self._start("head", "--head", f"--port={self.port}", "--num-cpus=0", "--include-dashboard=true",
                    "--dashboard-host=127.0.0.1", f"--dashboard-port={self.dashboard}",
                    f"--temp-dir={self.folder / 'ray'}")  # fmt: skip

    def start_node(self, name: str) -> None:
        self._start(name, f"--address=127.0.0.1:{self.port}", "--num-cpus=1")

    def mend(self, *names: str) -> None:
        """Start those again that are not whole, as an init system would: a node that was taken for dead ends itself."""
        for name in ("head", *names):
            if not any(b"/raylet" in Path(f"/proc/{pid}/cmdline").read_bytes() for pid in self.processes(name)):
                print(f"{name} is no part of the cluster any more, and is started again", flush=True)
                self.signal(name, signal.SIGKILL)
                self.start_head() if name == "head" else self.start_node(name)

    def _start(self, name: str, *options: str) -> None:
        scratch = self.folder / name
        scratch.mkdir(exist_ok=True)
        ports = ("--dashboard-agent-listen-port", "--metrics-export-port", "--runtime-env-agent-port")
        fixed = ["--node-ip-address=127.0.0.1", "--disable-usage-stats", "--object-store-memory=80000000"]
        fixed += [f"{port}={free_port()}" for port in ports]
        command = [*self.within.get(name, []), sys.executable, "-m", "ray.scripts.scripts", "start", *fixed, *options]
        own = {"TRAPS_NODE": name, "TRAPS_SCRATCH": str(scratch)} | HEALTH | self.own.get(name, {})
        began = time.monotonic()
        with (self.folder / f"{name}.log").open("ab") as log:
            subprocess.run(command, env=self.environment | own, check=True, stdout=log, stderr=log)
        print(f"{name} up after {time.monotonic() - began:.1f} s", flush=True)

    def processes(self, name: str) -> list[int]:
        """Return the processes of a node, and those that they started."""
        mark, found = f"\0TRAPS_SCRATCH={self.folder / name}\0".encode(), list[int]()
        for entry in Path("/proc").iterdir():
            if entry.name.isdigit() and int(entry.name) != os.getpid():
                try:
                    if mark in b"\0" + (entry / "environ").read_bytes() + b"\0":
                        found.append(int(entry.name))
                except OSError:
                    continue
        return found

    def signal(self, name: str, number: signal.Signals) -> int:
        """Send a signal to every process of a node; how many there were."""
        sent = 0
        while (found := self.processes(name)) and (number == signal.SIGKILL or not sent):
            for pid in found:
                try:
                    os.kill(pid, number)
                    sent += 1
                except ProcessLookupError:
                    continue
            if number == signal.SIGKILL:
                time.sleep(0.1)
                found = [pid for pid in found if not _is_dead(pid)]
                if not found:
                    break
        return sent


def _is_dead(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] == "Z"
    except OSError:
        return True


def _of_run(run_id: str) -> list[int]:
    """Return the processes that execute a run: Dagster's, not Ray's."""
    found = []
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            try:
                said = (entry / "cmdline").read_bytes()
            except OSError:
                continue
            if (
                run_id.encode() in said
                and (b"execute_run" in said or b"resume_run" in said)
                and b"python" in said[:200]
            ):
                found.append(int(entry.name))
    return found


@contextmanager
def launcher() -> Iterator[Launcher]:
    from tests.postgres import Postgres

    with tempfile.TemporaryDirectory(prefix="runs-") as name, Postgres.running(durable=True) as database:
        folder = Path(name)
        foreign = ("TRAPS_", "DAGSTER_", "RAY_")
        environment = {key: value for key, value in os.environ.items() if not key.startswith(foreign)}
        environment |= {
            # SQLAlchemy 2.1 takes psycopg 3 for a plain postgresql://, and dagster-postgres's NOTIFY fails with it.
            "TRAPS_LAUNCHER_HISTORY": database.address().replace("postgresql:", "postgresql+psycopg2:"),
            "TRAPS_LAUNCHER_DATABASE": database.address(),
            "DAGSTER_HOME": str(folder / "home"),
            "PYTHONPATH": str(ROOT),
            "TMPDIR": str(folder),
            "PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}",  # the launcher calls `dagster`
        }
        os.environ.update(environment)
        cluster = Cluster(folder, environment)
        (folder / "home").mkdir()
        (folder / "home" / "dagster.yaml").write_text(DAGSTER_YAML.format(dashboard=cluster.dashboard, poll=POLL_S))
        (folder / "workspace.yaml").write_text("load_from: [{python_module: {module_name: bench.launcher_project}}]\n")
        running = Launcher(folder, cluster, database)
        try:
            cluster.start_head()
            for node in ("one", "two"):
                cluster.start_node(node)
            running.start()
            yield running
        finally:
            running.stop()
            for node in ("one", "two", "head"):
                cluster.signal(node, signal.SIGCONT)
                cluster.signal(node, signal.SIGKILL)


class Launcher:
    """The cluster with Dagster's daemon, and what is known of runs."""

    def __init__(self, folder: Path, cluster: Cluster, database: Any) -> None:
        self.folder, self.cluster, self.database = folder, cluster, database
        self.daemon: subprocess.Popen[bytes] | None = None
        self.failures: list[str] = []

    def start(self) -> None:
        import psycopg
        from dagster import DagsterInstance

        from bench.launcher_project import SCHEMA

        with psycopg.connect(self.database.address(), autocommit=True) as opened:
            opened.execute(SCHEMA)
        self.instance = DagsterInstance.get()
        with (self.folder / "daemon.log").open("ab") as log:
            command = [sys.executable, "-m", "dagster._daemon", "run", "-w", str(self.folder / "workspace.yaml")]
            self.daemon = subprocess.Popen(command, stdout=log, stderr=log, cwd=ROOT)

    def stop(self) -> None:
        if self.daemon is not None:
            self.daemon.terminate()
            self.daemon.wait()
        if keep := os.environ.get("TRAPS_LAUNCHER_LOG"):
            shutil.copy(self.folder / "daemon.log", keep)

    def submit(self, cell: str) -> str:
        """Put a run of one cell in the queue; its id."""
        said = subprocess.run(
            [sys.executable, "-m", "dagster", "job", "launch", "-w", self.folder / "workspace.yaml", "-j", "launcher",
             "--tags", f'{{"dagster/partition": "{cell}"}}'],
            capture_output=True, text=True, cwd=ROOT, check=False,
        )  # fmt: skip
        if said.returncode:
            raise SystemExit(f"not submitted:\n{said.stdout}\n{said.stderr}")
        from dagster import RunsFilter

        return self.instance.get_runs(RunsFilter(tags={"dagster/partition": cell}))[0].run_id

    def query(self, sql: LiteralString, *values: Any) -> list[Any]:
        import psycopg

        with psycopg.connect(self.database.address(), autocommit=True) as opened:
            return opened.execute(sql, values).fetchall()

    def node_of(self, cell: str) -> str:
        """Waits until a cell's steps are being made; where."""
        until = time.monotonic() + 120
        while time.monotonic() < until:
            if found := self.query("select node from tried where cell = %s order by at desc limit 1", cell):
                return found[0][0]
            time.sleep(0.5)
        raise SystemExit(f"{cell} did not begin")

    def status(self, run_id: str) -> str:
        try:
            run = self.instance.get_run_by_id(run_id)
        except Exception as error:  # noqa: BLE001 - PostgreSQL may be down at this moment
            return type(error).__name__
        return run.status.value if run else "gone"

    def watch(
        self,
        runs: dict[str, str],
        began: float,
        seconds: float = WATCH_S,
        may_go_on: bool = False,
        may_fail: bool = False,
    ) -> None:
        """Print each change of the runs' states, and of the nodes that make their steps, until all have ended. A run
        that does not succeed with all its steps is a failure, unless it `may_go_on` or `may_fail`."""
        seen: dict[str, tuple[str, str]] = {}
        while time.monotonic() - began < seconds:
            for cell, run_id in runs.items():
                status, at = self.status(run_id), time.monotonic() - began
                try:
                    made = self.query("select node from tried where cell = %s order by at desc limit 1", cell)
                    node = made[0][0] if made else "-"
                except Exception:  # noqa: BLE001
                    node = "?"
                if seen.get(cell) != (status, node):
                    print(f"  {at:6.1f} s  {cell} {status:9s} last step on {node}", flush=True)
                    seen[cell] = status, node
            if all(status in ENDED for status, _ in seen.values()):
                break
            time.sleep(0.5)
        for cell in runs:
            tried, steps = self.query("select count(*), count(distinct step) from tried where cell = %s", cell)[0]
            made = self.query("select count(*) from made where cell = %s", cell)[0][0]
            print(f"  {cell}: {made} steps made, {tried} tried, {tried - steps} twice", flush=True)
            status = seen[cell][0]
            if may_go_on or (status == "SUCCESS" and made == STEPS) or (status == "FAILURE" and may_fail):
                continue
            self.failures.append(f"{cell} is {status} with {made} of {STEPS} steps")


def killed_run(launcher: Launcher) -> None:
    """kill -9 of the process that executes a run."""
    run_id = launcher.submit("c00")
    launcher.node_of("c00")
    time.sleep(3)
    began = time.monotonic()
    for pid in _of_run(run_id):
        os.kill(pid, signal.SIGKILL)
    launcher.watch({"c00": run_id}, began)


def killed_node(launcher: Launcher) -> None:
    """kill -9 of every process of a node; the other one stays."""
    run_id = launcher.submit("c01")
    node = launcher.node_of("c01")
    time.sleep(3)
    began = time.monotonic()
    print(f"  {launcher.cluster.signal(node, signal.SIGKILL)} processes of {node} killed")
    launcher.watch({"c01": run_id}, began)
    launcher.cluster.start_node(node)


def killed_head(launcher: Launcher) -> None:
    """kill -9 of every process of the head; it and the nodes are started again, as an init system would."""
    run_id = launcher.submit("c02")
    launcher.node_of("c02")
    time.sleep(3)
    began = time.monotonic()
    print(f"  {launcher.cluster.signal('head', signal.SIGKILL)} processes of the head killed")
    time.sleep(5)
    for node in ("one", "two"):
        launcher.cluster.signal(node, signal.SIGKILL)
    launcher.cluster.start_head()
    for node in ("one", "two"):
        launcher.cluster.start_node(node)
    launcher.watch({"c02": run_id}, began)


def stopped_node(launcher: Launcher) -> None:
    """SIGSTOP of every process of a node for 90 s, then SIGCONT."""
    run_id = launcher.submit("c03")
    node = launcher.node_of("c03")
    time.sleep(3)
    began = time.monotonic()
    print(f"  {launcher.cluster.signal(node, signal.SIGSTOP)} processes of {node} stopped")
    launcher.watch({"c03": run_id}, began, 90, may_go_on=True)
    launcher.cluster.signal(node, signal.SIGCONT)
    print("  continued")
    launcher.watch({"c03": run_id}, began)
    alive = launcher.cluster.processes(node)
    print(f"  {len(alive)} processes of {node} are left")
    if not alive:
        launcher.cluster.start_node(node)


def killed_postgres(launcher: Launcher) -> None:
    """Immediate stop of PostgreSQL, started again after 5 s."""
    run_id = launcher.submit("c04")
    launcher.node_of("c04")
    time.sleep(3)
    began = time.monotonic()
    launcher.database.stop()
    time.sleep(5)
    launcher.database.start()
    launcher.watch({"c04": run_id}, began, may_fail=True)


SCENARIOS: dict[str, Callable[[Launcher], None]] = {
    "run": killed_run, "node": killed_node, "head": killed_head, "stopped": stopped_node, "postgres": killed_postgres,
}  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scenarios", nargs="*", choices=[*SCENARIOS, []], default=[])
    chosen = parser.parse_args().scenarios or [*SCENARIOS]
    with launcher() as running:
        for name in chosen:
            print(f"{name}: {SCENARIOS[name].__doc__}", flush=True)
            SCENARIOS[name](running)
    if running.failures:
        sys.exit("\n".join(running.failures))


if __name__ == "__main__":
    main()
