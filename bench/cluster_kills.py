"""What a study on a cluster may lose when something is killed while models are asked: each kind of `KILLS` with a study
of its own, against one run of one process in a folder.

python -m bench.cluster_kills KIND [KIND ...] [--log FILE]
(needs the packages of the extra `cluster`, and moto)

Two models at a provider that counts its calls and bills them, 64 questions on four scenarios. The clips are those of
the run of one process, but for `store`, which loses them.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
import urllib.request
from collections.abc import Callable, Mapping
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory

from bench.cluster_gate import Cluster, free_port
from bench.cluster_study import Study, fetch, runs_of, tables_are_equal
from tests.objectstore import S3
from tests.postgres import Postgres
from tests.providers.server import Provider

MODELS, CONNECTIONS, WANTED, BUDGET_USD = (
    ("seer-a", "seer-b"),
    2,
    64,
    6.0,
)  # two dead blocks of 16 worst cases are $2.84
LATENCY_S, CUT_S, STOP_S, DOWN_S = 1.5, 45, 90, 5
CODE = "traps_pipeline.definitions"
LATE_S = 60  # no run may be STARTED for longer without a process that executes it
NODES = ("one", "two")
EXPERIMENT = f"""
name: kills
description: Two models at a provider, on one scenario of four families.
models: [{", ".join(MODELS)}]
regimes: [standard, json]
runs: [1]
panel: rules
judged_by_rules: true
scenarios: [plinko-0001, tumbling_dice-0001, domino_chain-0001, hidden_race-0001]
"""


class Proxy:
    """A way to a port of this machine that can be cut: connections break, and new ones are refused."""

    def __init__(self, port: int) -> None:
        self._to, self._open, self.is_cut = port, set[asyncio.StreamWriter](), False
        self._loop = asyncio.new_event_loop()
        threading.Thread(target=self._loop.run_forever, daemon=True).start()
        server = asyncio.run_coroutine_threadsafe(asyncio.start_server(self._serve, "127.0.0.1", 0), self._loop)
        self.port = int(server.result().sockets[0].getsockname()[1])

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        if self.is_cut:
            writer.transport.abort()
            return
        try:
            there, onward = await asyncio.open_connection("127.0.0.1", self._to)
        except OSError:
            writer.transport.abort()
            return
        both = {writer, onward}
        self._open |= both
        await asyncio.gather(self._copy(reader, onward), self._copy(there, writer))
        self._open -= both

    @staticmethod
    async def _copy(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        with suppress(OSError):
            while some := await reader.read(65536):
                writer.write(some)
                await writer.drain()
        writer.close()

    def cut(self) -> None:
        """Break all connections and take no other."""
        self.is_cut = True
        self._loop.call_soon_threadsafe(lambda: [writer.transport.abort() for writer in self._open])

    def mend(self) -> None:
        """Take connections again."""
        self.is_cut = False


def executing() -> dict[int, tuple[str, str]]:
    """The processes that execute a run of Dagster: the run's id and the node."""
    found = dict[int, tuple[str, str]]()
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            with suppress(OSError, IndexError):
                said = (entry / "cmdline").read_bytes()
                is_stopped = (entry / "stat").read_text().rsplit(")", 1)[1].split()[0] in "TZ"
                if is_stopped or b"python" not in said[:200] or not (b"execute_run" in said or b"resume_run" in said):
                    continue
                environ = dict(
                    part.split(b"=", 1) for part in (entry / "environ").read_bytes().split(b"\0") if b"=" in part
                )
                found[int(entry.name)] = said.decode(errors="replace"), environ.get(b"TRAPS_NODE", b"").decode()
    return found


@dataclass
class Orphans(threading.Thread):
    """Looks every second how long runs are STARTED that no process executes, and remembers the longest time."""

    address: str
    longest_s: float = 0.0
    ended: threading.Event = field(default_factory=threading.Event)

    def __post_init__(self) -> None:
        super().__init__(daemon=True)

    def __hash__(self) -> int:
        return id(self)

    def run(self) -> None:
        import psycopg

        since = dict[str, float]()
        while not self.ended.wait(1.0):
            try:
                with psycopg.connect(self.address, autocommit=True, connect_timeout=5) as opened:
                    rows = opened.execute("select run_id from runs where status = 'STARTED'").fetchall()
            except psycopg.Error:
                continue  # PostgreSQL is one of those that are killed
            alive, now = [said for said, _ in executing().values()], time.monotonic()
            orphans = {run for (run,) in rows if not any(run in said for said in alive)}
            since = {run: since.get(run, now) for run in orphans}
            self.longest_s = max([self.longest_s, *(now - began for began in since.values())])


@dataclass
class Scene:
    """What is there to be killed."""

    cluster: Cluster
    database: Postgres
    store: S3
    proxies: Mapping[str, Proxy]
    study: Study

    def busy(self) -> tuple[str, list[int]]:
        """A node that executes a run, and the processes that do."""
        found = executing()
        node = next(node for _, node in found.values() if node)
        return node, [pid for pid, (_, where) in found.items() if where == node]

    def restart_daemon(self) -> None:
        self.study.stop()
        self.study.start_daemon()


def kill_run(scene: Scene) -> None:
    """kill -9 of the process that executes a run."""
    for pid in scene.busy()[1]:
        with suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)


def kill_node(scene: Scene) -> None:
    """kill -9 of every process of a node, which is then started again."""
    node = scene.busy()[0]
    scene.cluster.signal(node, signal.SIGKILL)
    scene.cluster.start_node(node)


def kill_head(scene: Scene) -> None:
    """kill -9 of every process of the head and of Dagster's daemon; it and the nodes are then started again."""
    scene.cluster.signal("head", signal.SIGKILL)
    if scene.study.daemon is not None:
        scene.study.daemon.kill()
    time.sleep(5)
    for node in NODES:
        scene.cluster.signal(node, signal.SIGKILL)
    scene.cluster.start_head()
    for node in NODES:
        scene.cluster.start_node(node)
    scene.restart_daemon()


def kill_postgres(scene: Scene) -> None:
    """Immediate stop of PostgreSQL, which is started again."""
    scene.database.stop()
    time.sleep(DOWN_S)
    scene.database.start()


def stop_node(scene: Scene) -> None:
    """SIGSTOP of every process of a node for longer than detection, then SIGCONT."""
    node = scene.busy()[0]
    scene.cluster.signal(node, signal.SIGSTOP)
    time.sleep(STOP_S)
    scene.cluster.signal(node, signal.SIGCONT)


def cut_network(scene: Scene) -> None:
    """The way from a node to PostgreSQL is cut for longer than a session may be silent, then mended."""
    node = scene.busy()[0]
    scene.proxies[node].cut()
    time.sleep(CUT_S)
    scene.proxies[node].mend()


def empty_store(scene: Scene) -> None:
    """After the study was made: every clip is removed from the store; the next run makes them again."""


def want_together(scene: Scene) -> None:
    """Nothing is killed: a second experiment on another host, and a backfill as Dagster's page launches it, want the
    same cells at once."""
    study, port = scene.study, free_port()
    command = [sys.executable, "-m", "dagster_webserver", "-h", "127.0.0.1", "-p", f"{port}", "-m", CODE]
    path = study.root / "again.yaml"
    path.write_text(study.experiment.read_text().replace("name: kills", "name: again"))
    other = Study(study.folder, study.environment | {"TRAPS_SCRATCH": str(study.folder / "other")}, path, study.root)
    with (study.folder / "webserver.log").open("ab") as log:
        environment = study.environment | {"DAGSTER_HOME": study.home}
        pages = subprocess.Popen(command, stdout=log, stderr=log, cwd=study.root, env=environment)
    try:
        began = time.monotonic()
        second = other.start_run("--no-preflight", "--budget-usd", f"{BUDGET_USD}")
        said = _launched(port, study.python(NAME).strip())
        print(f"  {time.monotonic() - began:6.1f} s  the page says {said}", flush=True)
        lines = _shown(second, began)
        study.require(second.wait() == 0 and "LaunchBackfillSuccess" in said, "both others end well")
        print(f"  the other command: {lines[-2].strip()}", flush=True)
        while {"QUEUED", "STARTING", "STARTED", "NOT_STARTED"} & {*(ended := runs_of(study))}:
            time.sleep(2)
        study.require({*ended} == {"SUCCESS"}, f"all runs, those of the backfill too: {ended}")
    finally:
        pages.terminate()
        pages.wait()


def _launched(port: int, study: str) -> str:
    """What Dagster's web server answers to what its page sends when answers of all cells are to be made."""
    query = f"""mutation {{ launchPartitionBackfill(backfillParams: {{
        allPartitions: true, assetSelection: [{{path: ["{study}", "responses"]}}]
    }}) {{ __typename ... on LaunchBackfillSuccess {{ backfillId }} ... on PythonError {{ message }} }} }}"""
    body, until = json.dumps({"query": query}).encode(), time.monotonic() + 180
    request = urllib.request.Request(f"http://127.0.0.1:{port}/graphql", body, {"Content-Type": "application/json"})
    while True:
        try:
            return urllib.request.urlopen(request, timeout=120).read().decode()
        except OSError:
            if time.monotonic() > until:
                raise
            time.sleep(0.5)


KILLS: dict[str, Callable[[Scene], None]] = {
    "run": kill_run, "node": kill_node, "head": kill_head, "postgres": kill_postgres, "stopped": stop_node,
    "network": cut_network, "store": empty_store, "together": want_together,
}  # fmt: skip
EMPTY = """
from traps_pipeline.storage.workspace import Workspace
w = Workspace.open()
w.store.look()
clips = w.store.below(w.root / "clips")
for path in clips:
    w.store.bucket.delete(w.store._current(path).digest)
print(len(clips))
"""
SPENT = """
from traps_pipeline.storage.workspace import Workspace
from traps_pipeline.storage.purse import Purse
purse = Purse(Workspace.open().session)
standing = purse.open()
print(sum(standing.spent.values()) + sum(standing.out.values()))
purse.close()
"""
NAME = "from traps_pipeline.storage.workspace import Workspace\nprint(Workspace.open().study.name)"
SEGMENTS = """
select count(distinct s.id), coalesce(sum(s.rows), 0),
       (select count(*) from traps.rows r join traps.evaluations e on e.id = r.evaluation where e.study = t.id)
from traps.studies t left join traps.evaluations e on e.study = t.id
left join traps.segments s on s.evaluation = e.id where t.name = %s group by t.id
"""


def kill_each(kinds: list[str], keep: Path | None) -> list[str]:
    """Make a study with each kind of kill; what did not hold. keep: a file for the daemon's log."""
    from tests.conftest import KEY, SECRET, Checkout, make_checkout
    from tests.integration.test_network import entry, register

    foreign = ("TRAPS_", "DAGSTER_", "RAY_", "AWS_")
    plain = {key: value for key, value in os.environ.items() if not key.startswith(foreign)} | {KEY: SECRET}
    failures = list[str]()
    with ExitStack() as opened:
        name = opened.enter_context(TemporaryDirectory(prefix="kills-", ignore_cleanup_errors=True))
        database, store = opened.enter_context(Postgres.running()), opened.enter_context(S3.running())
        provider = opened.enter_context(Provider.start({"usd_a_token": [1e-6, 1e-5]}))
        folder = Path(name)
        checkout = Checkout(make_checkout(folder / "checkout"), folder / "alone")
        limits = f"limits: {{concurrency: {CONNECTIONS}, timeout_s: 36, backoff_s: 0.05}}"
        entries = [
            entry(model, "images").replace("limits: {timeout_s: 36, backoff_s: 0.05}", limits) for model in MODELS
        ]
        register(checkout, provider, *entries)
        experiment = checkout.root / "kills.yaml"
        experiment.write_text(EXPERIMENT)
        common = plain | {"PYTHONPATH": str(checkout.root), "TMPDIR": name}
        alone = Study(folder, common | {"TRAPS_WORKSPACE": str(checkout.workspace)}, experiment, checkout.root)
        _alone(alone, provider)
        provider.configure(latency_s=LATENCY_S)
        shared = common | store.environment | {"PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}"}
        proxies = {node: Proxy(database.port) for node in NODES}
        own = {node: {"TRAPS_DATABASE": database.address(port=proxy.port)} for node, proxy in proxies.items()}
        shared["TRAPS_DATABASE"] = database.address()
        cluster = Cluster(folder, shared, own)
        shared["TRAPS_RAY"] = f"http://127.0.0.1:{cluster.dashboard}"
        try:
            cluster.start_head()
            for node in NODES:
                cluster.start_node(node)
            for kind in kinds:
                print(f"{kind}: {KILLS[kind].__doc__} Load {os.getloadavg()[0]:.0f}.", flush=True)
                environment = shared | {
                    "TRAPS_WORKSPACE": f"s3://lab/{kind}", "TRAPS_SCRATCH": str(folder / f"here-{kind}")
                }  # fmt: skip
                study = Study(folder, environment, experiment, checkout.root)
                scene = Scene(cluster, database, store, proxies, study)
                try:
                    _one(kind, scene, provider, checkout.workspace)
                except Exception as error:  # noqa: BLE001 - the other kinds are tried all the same
                    study.failures.append(f"{type(error).__name__}: {error}")
                    print(f"  DOES NOT HOLD: {study.failures[-1]}", flush=True)
                finally:
                    study.stop(keep)
                failures += [f"{kind}: {one}" for one in study.failures]
        finally:
            for node in (*NODES, "head"):
                cluster.signal(node, signal.SIGCONT)
                cluster.signal(node, signal.SIGKILL)
    return failures


def _alone(study: Study, provider: Provider) -> None:
    began = time.monotonic()
    made = study.traps("run", str(study.experiment), "--until", "leaderboard", "--no-preflight",
                       "--budget-usd", f"{BUDGET_USD}")  # fmt: skip
    if made.returncode:
        raise SystemExit(made.stdout + made.stderr)
    sent = provider.stats()["answered_in_full"]
    print(f"one process took {time.monotonic() - began:.0f} s, {sent} calls", flush=True)
    assert sent == WANTED, "what is wanted was counted by hand"


def _one(kind: str, scene: Scene, provider: Provider, alone: Path) -> None:
    study = scene.study
    said = study.traps("init", str(study.experiment))
    if said.returncode:
        raise RuntimeError(said.stderr)
    (scratch,) = Path(study.environment["TRAPS_SCRATCH"]).iterdir()
    shutil.copytree(alone / "clips", scratch / "clips", dirs_exist_ok=True)
    said = study.traps("run", str(study.experiment), "--until", "items")
    study.require(" 0 frames rendered" in said.stdout, "clips that are there are not rendered again")
    study.start_daemon()
    provider.reset()
    orphans = Orphans(scene.database.address())
    orphans.start()
    began = time.monotonic()
    run = study.start_run("--no-preflight", "--budget-usd", f"{BUDGET_USD}")
    out = list[str]()
    reading = threading.Thread(target=lambda: out.extend(_shown(run, began)), daemon=True)
    reading.start()
    if kind == "together":
        want_together(scene)
    elif kind != "store":
        while provider.stats()["answered_in_full"] < WANTED // 8:
            if run.poll() is not None:
                raise RuntimeError("the run ended before anything was asked")
            time.sleep(0.2)
        at = time.monotonic()
        print(f"  {at - began:6.1f} s  {kind} now, after {provider.stats()['answered_in_full']} calls", flush=True)
        KILLS[kind](scene)
        print(f"  {time.monotonic() - began:6.1f} s  over", flush=True)
    code, tries = run.wait(), 1
    while code and tries < 4:
        tries += 1
        again = study.start_run("--no-preflight", "--budget-usd", f"{BUDGET_USD}")
        code = (_shown(again, began), again.wait())[1]
    orphans.ended.set()
    seconds, stats = time.monotonic() - began, provider.stats()
    calls, billed = stats["answered_in_full"], stats["billed_usd"]
    study.require(code == 0, f"the study is made, with {tries} command(s), in {seconds:.0f} s")
    most = WANTED + (CONNECTIONS * len(MODELS) if kind not in ("store", "together") else 0)
    study.require(WANTED <= calls <= most, f"{calls} calls at the provider, {WANTED} wanted, at most {most}")
    counted = float(study.python(SPENT).split()[-1])
    study.require(
        billed - 1e-9 <= counted <= BUDGET_USD, f"${billed:.4f} billed, ${counted:.4f} counted, ${BUDGET_USD} allowed"
    )
    limit = LATE_S + (STOP_S if kind == "stopped" else 0)  # a stopped host is not dead while it is stopped
    said = f"no run was STARTED without a process that went on for more than {orphans.longest_s:.0f} s, {limit} allowed"
    study.require(orphans.longest_s <= limit, said)
    if kind == "store":
        before = fetch(study, study.folder / f"before-{kind}")
        print(f"  {study.python(EMPTY).strip()} clips and notes removed from the store", flush=True)
        made = study.run_to_end("--no-preflight", "--budget-usd", f"{BUDGET_USD}")
        study.require(made.returncode == 0, "the study is made again")
        after = fetch(study, study.folder / f"after-{kind}")
        same = {p.relative_to(before): p.read_bytes() for p in before.rglob("*.mp4")} == {
            p.relative_to(after): p.read_bytes() for p in after.rglob("*.mp4")
        }  # fmt: skip
        study.require(same, "every clip was made again with the same bytes")
    made = study.run_to_end("--no-preflight", "--budget-usd", f"{BUDGET_USD}")
    study.require("0 answers asked (0 from" in made.stdout, "a second run asks nothing")
    study.require(provider.stats()["answered_in_full"] == calls, "and the provider saw no other call")
    tables_are_equal(study, alone, fetch(study, study.folder / f"fetched-{kind}"))
    import psycopg

    with psycopg.connect(scene.database.address(), autocommit=True) as connection:
        (found,) = connection.execute(SEGMENTS, [study.python(NAME).strip()]).fetchall()
    study.require(found[0] > 0 and found[2] == 0, f"{found[0]} segments hold {found[1]} rows, the database {found[2]}")


def _shown(run: subprocess.Popen[str], began: float) -> list[str]:
    lines = list[str]()
    assert run.stdout is not None
    for line in run.stdout:
        lines.append(line)
        print(f"  {time.monotonic() - began:6.1f} s  {line.rstrip()[:220]}", flush=True)
    return lines


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("kinds", nargs="+", choices=[*KILLS], metavar="KIND", help=", ".join(KILLS))
    parser.add_argument("--log", type=Path, help="a file for the log of Dagster's daemon")
    arguments = parser.parse_args()
    sys.exit("\n".join(kill_each(arguments.kinds, arguments.log)) or None)


if __name__ == "__main__":
    main()
