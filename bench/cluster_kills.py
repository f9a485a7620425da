"""What a study on a cluster may lose when something is killed while models are asked: each kind of `KILLS` with a study
of its own, against one run of one process in a folder.

python -m bench.cluster_kills KIND [KIND ...] [--log FILE]
(needs the packages of the extra `cluster`, and moto)

Two models at a provider that counts its calls and bills them, 64 questions on four scenarios. The clips are those of
the run of one process, but for `store`, which loses them.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import threading
import time
import urllib.request
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

from bench.cluster_launcher import Cluster, free_port
from bench.cluster_study import NODES, Study, asked, failures_of, fetch, nodes_are_apart, runs_of, tables_are_equal
from bench.cluster_watch import Opened, Orphans, Proxy, executing
from tests.objectstore import S3
from tests.postgres import Postgres
from tests.providers.server import Provider
from traps_cluster.bucket import object_name
from traps_cluster.objects import ObjectStore
from traps_pipeline.cli.command import OVER_BUDGET
from traps_pipeline.ledger.money import Money

MODELS, CONNECTIONS = ("seer-a", "seer-b"), 2
BUDGET_USD = 6.0  # far above the study's $0.40, and what calls lost in flight may have cost: $0.09 each at most
CAP_USD = 0.68  # half for each model: enough for its 32 calls ($0.20), one more in flight, and none that was lost
CUT_S, STOP_S, DOWN_S = 45, 90, 5
CODE = "traps_pipeline.definitions"
LATE_S = 60  # no run may be STARTED for longer without a process that executes it


@dataclass(frozen=True)
class Size:
    """How large the studies are. wanted: calls, counted by hand: scenarios x datasets of a taxonomy (2) x sides (2) x
    regimes x models; until: the last stage; latency_s: of each call, long enough for a kill to come in between."""

    scenarios: Sequence[str]
    regimes: Sequence[str]
    wanted: int
    until: str
    latency_s: float

    @property
    def experiment(self) -> str:
        """The file."""
        return f"""
name: kills
description: Two models at a provider.
models: [{", ".join(MODELS)}]
regimes: [{", ".join(self.regimes)}]
runs: [1]
panel: rules
judged_by_rules: true
scenarios: [{", ".join(self.scenarios)}]
"""


FAMILIES = ("plinko-0001", "tumbling_dice-0001", "domino_chain-0001", "hidden_race-0001")
FULL = Size(FAMILIES, ("standard", "json"), 64, "leaderboard", 3.0)
SMALL = Size(FAMILIES[:1], ("standard",), 8, "verdicts", 4.0)


@dataclass
class Scene:
    """What is there to be killed."""

    cluster: Cluster
    database: Postgres
    store: S3
    proxies: Mapping[str, Proxy]
    study: Study
    size: Size
    opens: Opened
    provider: Provider

    def busy(self) -> tuple[str, list[int]]:
        """Return a node that executes a run, and the processes that do."""
        here = {pid for node in NODES for pid in self.cluster.processes(node)}
        found = {pid: told for pid, told in executing().items() if pid in here}
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


def kill_at_cap(scene: Scene) -> None:
    """kill -9 of the process that executes a run, under a budget that its death uses up: calls to its model stop, and
    the command ends with 4. A second one with a higher budget asks what is missing."""
    kill_run(scene)


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


def silence_network(scene: Scene) -> None:
    """Nothing passes between a node and PostgreSQL for longer than a session may be silent, though no connection
    breaks; then it passes again."""
    node = scene.busy()[0]
    scene.proxies[node].fall_silent()
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
    other = Study(
        study.folder, study.environment | {"TRAPS_SCRATCH": str(study.folder / "other")}, path, study.root, study.until
    )
    with (study.folder / "webserver.log").open("ab") as log:
        pages = subprocess.Popen(command, stdout=log, stderr=log, cwd=study.root, env=study.dagster)
    try:
        began = time.monotonic()
        second = other.start_run(*paying(BUDGET_USD))
        said = _launched(port, name_of(study))
        print(f"  {time.monotonic() - began:6.1f} s  the page says {said}", flush=True)
        asked_by_now = scene.provider.stats()["answered_in_full"]
        study.require(asked_by_now < scene.size.wanted, f"all three want them at once: {asked_by_now} calls by now")
        lines = _shown(second, began)
        study.require(second.wait() == 0 and "LaunchBackfillSuccess" in said, "both others end well")
        print(f"  the other command: {lines[-2].strip()}", flush=True)
        while {"QUEUED", "STARTING", "STARTED", "NOT_STARTED"} & {*(ended := runs_of(study))}:
            time.sleep(2)
        failed = sum(one != "SUCCESS" for one in ended)
        said = f"all {len(ended)} runs end well, those of the backfill too ({failed} do not)"
        study.require(bool(ended) and not failed, said)
        if failed:
            print(failures_of(study), flush=True)
    finally:
        pages.terminate()
        pages.wait()


def _launched(port: int, study: str) -> str:
    """Return what Dagster's web server answers to what its page sends when answers of all cells are to be made."""
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
    "run": kill_run, "cap": kill_at_cap, "node": kill_node, "head": kill_head, "postgres": kill_postgres,
    "stopped": stop_node,
    "network": cut_network, "silent": silence_network, "store": empty_store, "together": want_together,
}  # fmt: skip


def spent_usd(study: Study) -> dict[str, float]:
    """Return what the study has spent by its own count on each model: rows, and calls in flight."""
    with study.opened() as workspace, workspace.ledger.writing():
        spent = Money(workspace.ledger).spent()
        return {model: spent.get(model, 0.0) for model in MODELS}


def paying(usd: float, *, each: bool = False) -> list[str]:
    """Return options of `traps run`: a budget, and with `each` an equal part of it for each model."""
    parts = [f"{usd}", *(f"{model}={usd / len(MODELS)}" for model in MODELS if each)]
    return ["--no-preflight", *(word for part in parts for word in ("--budget-usd", part))]


def lose_clips(study: Study) -> int:
    """Remove every clip from the store; how many files."""
    with study.opened() as workspace:
        store = workspace.store
        assert isinstance(store, ObjectStore)
        store.look()
        clips = store.below(workspace.root / "clips")
        store.bucket.delete([object_name(bytes.fromhex(digest)) for digest in {*store.digests(clips).values()}])
        return len(clips)


def name_of(study: Study) -> str:
    """Return the study's name."""
    with study.opened() as workspace:
        return workspace.study.name


def kill_each(
    kinds: Sequence[str],
    keep: Path | None = None,
    size: Size = FULL,
    clips: Path | None = None,
    *,
    in_folder: bool = False,
) -> list[str]:
    """Make a study with each kind of kill; what did not hold. keep: a file for the daemon's log; clips: a folder of
    scenarios' clips that need not be rendered; in_folder: the study lies in a folder that all hosts see, not in a
    bucket."""
    from tests.build.network import entry, register
    from tests.conftest import KEY, SECRET, Checkout, make_checkout

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
        experiment.write_text(size.experiment)
        common = plain | {"PYTHONPATH": str(checkout.root), "TMPDIR": name}
        if clips is not None:
            for name in size.scenarios:
                shutil.copytree(clips / name, checkout.workspace / "clips" / name)
        environment = common | {"TRAPS_WORKSPACE": str(checkout.workspace)}
        _alone(Study(folder, environment, experiment, checkout.root, size.until), provider, size)
        provider.configure(latency_s=size.latency_s)
        shared = common | store.environment | {"PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}"}
        proxies = {node: Proxy(database.port) for node in NODES}
        own = {node: {"TRAPS_DATABASE": database.address(port=proxy.port)} for node, proxy in proxies.items()}
        shared["TRAPS_DATABASE"] = database.address()
        opens = Opened({node: folder / node for node in NODES})
        opened.callback(opens.let_go)
        cluster = Cluster(folder, shared, own)
        shared["TRAPS_RAY"] = f"http://127.0.0.1:{cluster.dashboard}"
        try:
            cluster.start_head()
            for node in NODES:
                cluster.start_node(node)
            for kind in kinds:
                cluster.mend(*NODES)
                print(f"{kind}: {KILLS[kind].__doc__} Load {os.getloadavg()[0]:.0f}.", flush=True)
                place = str(folder / "shared" / kind) if in_folder else f"s3://lab/{kind}"
                environment = shared | {"TRAPS_WORKSPACE": place, "TRAPS_SCRATCH": str(folder / f"here-{kind}")}
                study = Study(folder, environment, experiment, checkout.root, size.until)
                scene = Scene(cluster, database, store, proxies, study, size, opens, provider)
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


def _alone(study: Study, provider: Provider, size: Size) -> None:
    began = time.monotonic()
    made = study.traps("run", str(study.experiment), "--until", size.until, *paying(BUDGET_USD))
    if made.returncode:
        raise SystemExit(made.stdout + made.stderr)
    sent = provider.stats()["answered_in_full"]
    print(f"one process took {time.monotonic() - began:.0f} s, {sent} calls", flush=True)
    assert sent == size.wanted, "what is wanted was counted by hand"


def _one(kind: str, scene: Scene, provider: Provider, alone: Path) -> None:
    study, wanted = scene.study, scene.size.wanted
    study.traps("init", str(study.experiment), "--database", "TRAPS_DATABASE")
    with study.opened() as workspace:
        in_bucket = workspace.is_shared
        shutil.copytree(alone / "clips", workspace.root / "clips", dirs_exist_ok=True)
    said = study.traps("run", str(study.experiment), "--until", "items")
    study.require(
        bool(re.search(r"(?m)^0 frames rendered", said.stdout)), "clips that are there are not rendered again"
    )
    study.start_daemon()
    scene.opens.counts.clear()  # what nodes open for this study, not for the one before
    provider.reset()
    orphans = Orphans(scene.database.address())
    orphans.start()
    began, is_capped = time.monotonic(), kind == "cap"
    run = study.start_run(*paying(CAP_USD if is_capped else BUDGET_USD, each=is_capped))
    out = list[str]()
    reading = threading.Thread(target=lambda: out.extend(_shown(run, began)), daemon=True)
    reading.start()
    if kind == "together":
        want_together(scene)
    elif kind != "store":
        # A kill between two cells would lose no call.
        while (stats := provider.stats())["answered_in_full"] < wanted // 8 or not stats["in_flight"]:
            if run.poll() is not None:
                raise RuntimeError("the run ended before anything was asked")
            time.sleep(0.2)
        at = time.monotonic()
        print(f"  {at - began:6.1f} s  {kind} now, after {stats['answered_in_full']} calls", flush=True)
        KILLS[kind](scene)
        print(f"  {time.monotonic() - began:6.1f} s  over", flush=True)
    code, tries = run.wait(), 1
    reading.join()
    if is_capped:
        _look_at_cap(study, provider, code, out, wanted)
    while code and tries < 4:
        tries += 1
        again = study.start_run(*paying(BUDGET_USD, each=is_capped))
        code = (_shown(again, began), again.wait())[1]
    orphans.ended.set()
    seconds, stats = time.monotonic() - began, provider.stats()
    calls, billed = stats["answered_in_full"], stats["billed_usd"]
    study.require(code == 0, f"the study is made, with {tries} command(s), in {seconds:.0f} s")
    most = wanted + (CONNECTIONS * len(MODELS) if kind not in ("store", "together") else 0)
    study.require(wanted <= calls <= most, f"{calls} calls at the provider, {wanted} wanted, at most {most}")
    counted = sum(spent_usd(study).values())
    study.require(
        billed - 1e-9 <= counted <= BUDGET_USD, f"${billed:.4f} billed, ${counted:.4f} counted, ${BUDGET_USD} allowed"
    )
    said = f"no run was STARTED without a process that went on for more than {orphans.longest_s:.0f} s"
    study.require(orphans.longest_s <= LATE_S, f"{said}, {LATE_S} allowed")
    if kind == "store":
        before = fetch(study, study.folder / f"before-{kind}")
        print(f"  {lose_clips(study)} clips and notes removed from the store", flush=True)
        made = study.run_to_end(*paying(BUDGET_USD))
        study.require(made.returncode == 0, "the study is made again")
        after = fetch(study, study.folder / f"after-{kind}")
        same = {p.relative_to(before): p.read_bytes() for p in before.rglob("*.mp4")} == {
            p.relative_to(after): p.read_bytes() for p in after.rglob("*.mp4")
        }  # fmt: skip
        study.require(same, "every clip was made again with the same bytes")
    made = study.run_to_end(*paying(BUDGET_USD))
    study.require(asked(made.stdout) == 0, "a second run asks nothing")
    study.require(provider.stats()["answered_in_full"] == calls, "and the provider saw no other call")
    tables_are_equal(study, alone, fetch(study, study.folder / f"fetched-{kind}"))
    if not in_bucket:
        return
    # With eight calls one node may make all that is left, where the other's run was killed before it wrote a table.
    nodes_are_apart(study, scene.opens, least=1 if scene.size is SMALL else len(NODES))
    with study.opened() as workspace:
        assert isinstance(workspace.store, ObjectStore)
        logged = {name.split("/")[1] for name, size, _ in workspace.store.bucket.names("logs") if size}
    study.require(bool(logged), f"the store has what {len(logged)} runs printed")


def _look_at_cap(study: Study, provider: Provider, code: int, said: Sequence[str], wanted: int) -> None:
    """Look whether a command ended at its budget, and no more was spent."""
    stats, counted = provider.stats(), spent_usd(study)
    calls, billed, each = stats["answered_in_full"], stats["billed_usd"], CAP_USD / len(MODELS)
    reached = [line.strip()[:160] for line in said if "budget" in line and "is reached" in line]
    study.require(code == OVER_BUDGET and bool(reached), f"the command ends with {code} and says {reached[:1]}")
    study.require(calls < wanted, f"{calls} calls by then, {wanted} wanted")
    shown = ", ".join(f"${usd:.4f} of {model}" for model, usd in counted.items())
    least = billed - 1e-9 <= sum(counted.values())
    study.require(
        least and max(counted.values()) <= each + 1e-9, f"${billed:.4f} billed, {shown}, ${each} allowed each"
    )


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
    parser.add_argument("--in-folder", action="store_true", help="the study lies in a folder that all hosts see")
    arguments = parser.parse_args()
    sys.exit("\n".join(kill_each(arguments.kinds, arguments.log, in_folder=arguments.in_folder)) or None)


if __name__ == "__main__":
    main()
