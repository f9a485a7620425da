"""What a cluster costs and gains, against what a user would otherwise use: one machine, its files, and its processes.

python bench/cluster.py [rendering] [calls] [asking] [ledger] [first-call] [pages]
(needs the packages of the extra `cluster`, and moto; `pages` also Chromium)

rendering: two nodes against one, from the first run's start to the last one's end, and as a whole. First each node has
a fixed share of CPU that nothing else can take (as root), so that it stands for a host of its own; then each is bound
to a core, which Ray's head, Dagster's daemon, PostgreSQL and the store use, too. Last, what such cores give processes
of `traps run` without a cluster that share the clips of one study. calls: 2,000 calls of 50 ms with the ledger in
PostgreSQL against one in a folder. asking: the same by a whole study on a node against one process. ledger: rows a
second, against files. first-call: of a study in an object store whose ledger holds 10^6 rows. pages: Dagster's, of
studies of 10,000 and 50,000 cells whose history lies in PostgreSQL, against a stock project's.
"""

from __future__ import annotations

import argparse
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from dagster import DagsterInstance

from bench.cluster_launcher import Cluster
from bench.cluster_study import NODES, Study
from bench.cpu_share import is_there, of_cores
from tests.objectstore import S3
from tests.postgres import Postgres
from traps_cluster.history import export

ROOT = Path(__file__).resolve().parents[1]
# One run for each node, which goes through all categories and shares their clips with the other.
FAMILIES = (
    "slide", "pendulum", "bounce", "chain", "domino_chain", "pachinko_waterfall", "plinko", "tumbling_dice"
)  # fmt: skip
SCENARIOS = 8  # of each
EXPERIMENT = """
name: rendering
description: Clips of eight categories.
models: [oracle]
regimes: [standard]
panel: rules
scenarios: [{scenarios}]
"""
Run = tuple[float, float]  # when it began and ended
CORES = 0.6  # of each node, where that is fixed: of two cores 0.8 are left for all else
OTHERS = {
    "calls": ["bench/calls.py", "--database", "--times", "3"],
    "asking": ["bench/cluster_asking.py"],
    "ledger": ["bench/ledger.py", "--database"],
    "first-call": ["bench/first_call.py", "--rows", "1000000", "--store"],
    "pages": ["bench/ui.py", "--database", "--cells", "10000", "50000"],
}


def experiment() -> str:
    """Return the file that asks for the clips."""
    names = [f"{family}-{n:04d}" for family in FAMILIES for n in range(1, SCENARIOS + 1)]
    return EXPERIMENT.format(scenarios=", ".join(names))


def rendered(study: Study, runs: int) -> tuple[float, list[Run]]:
    """Make the clips of a study on the cluster, in so many runs: seconds in all, and when runs began and ended."""
    began = time.monotonic()
    made = study.run_to_end("--runs", str(runs))
    seconds = time.monotonic() - began
    if made.returncode:
        raise SystemExit(made.stdout + made.stderr)
    with study.opened() as workspace:
        export(workspace)
        instance = DagsterInstance.from_config(str(workspace.dagster_home))
        stats = [instance.get_run_stats(run.run_id) for run in instance.get_runs()]
        instance.dispose()
    return seconds, sorted((one.start_time or 0.0, one.end_time or 0.0) for one in stats)


def without_cluster(count: int, cores: Sequence[int], plain: Mapping[str, str]) -> float:
    """Return the seconds that so many processes of `traps run` take to render the clips of one study, each bound to a
    core.
    """
    with tempfile.TemporaryDirectory(prefix="scale-") as name:
        path = Path(name) / "rendering.yaml"
        path.write_text(experiment())
        environment = {**plain, "PYTHONPATH": str(ROOT), "TRAPS_WORKSPACE": str(Path(name) / "study")}
        traps = [sys.executable, "-m", "traps_pipeline.cli"]
        subprocess.run([*traps, "init", path], cwd=ROOT, env=environment, stdout=subprocess.DEVNULL, check=True)
        processes, began = list[subprocess.Popen[bytes]](), time.monotonic()
        for core in cores[:count]:
            os.sched_setaffinity(0, {core})
            command = [*traps, "run", str(path), "--until", "videos"]
            processes.append(subprocess.Popen(command, cwd=ROOT, env=environment, stdout=subprocess.DEVNULL))
            os.sched_setaffinity(0, cores)
        codes = [process.wait() for process in processes]
        if any(codes):
            raise SystemExit("a process of `traps run` failed")
        return time.monotonic() - began


def on_nodes(count: int, cores: Sequence[int], plain: Mapping[str, str], *, fixed: bool) -> tuple[float, float]:
    """Return seconds that so many nodes take to render the clips: from the first run's start to the last one's end, and
    as a whole. fixed: each has CORES of CPU; else it is bound to a core."""
    with ExitStack() as opened:
        name = opened.enter_context(tempfile.TemporaryDirectory(prefix="scale-", ignore_cleanup_errors=True))
        database, store = opened.enter_context(Postgres.running()), opened.enter_context(S3.running())
        folder, nodes = Path(name), NODES[:count]
        (folder / "rendering.yaml").write_text(experiment())
        shared = {**plain, **store.environment} | {
            "PYTHONPATH": str(ROOT), "TMPDIR": name, "TRAPS_DATABASE": database.address(),
            "PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}",
        }  # fmt: skip
        within = {node: opened.enter_context(of_cores(node, CORES)) for node in nodes if fixed}
        cluster = Cluster(folder, shared, within=within)
        study_at = f"s3://lab/rendering-{count}-{'fixed' if fixed else 'plain'}"  # this process keeps each one's server
        own = {"TRAPS_RAY": f"http://127.0.0.1:{cluster.dashboard}", "TRAPS_WORKSPACE": study_at}
        environment = shared | own | {"TRAPS_SCRATCH": str(folder / "here")}
        study = Study(folder, environment, folder / "rendering.yaml", until="videos")
        try:
            cluster.start_head()
            for node, core in zip(nodes, cores, strict=False):
                os.sched_setaffinity(0, cores if fixed else {core})
                cluster.start_node(node)
                os.sched_setaffinity(0, cores)
            study.start_daemon()
            whole, runs = rendered(study, count)
        finally:
            study.stop()
            for node in (*NODES, "head"):
                cluster.signal(node, signal.SIGKILL)
    share = f"{CORES} of a core" if fixed else "one core"
    each = ", ".join(f"{end - begin:.0f} s" for begin, end in runs)
    print(f"rendering, {count} node(s) of {share}: {whole:.0f} s, with runs of {each}", flush=True)
    return max(end for _, end in runs) - min(begin for begin, _ in runs), whole


def rendering() -> None:
    """Print how long rendering takes on one node and on two."""
    cores = sorted(os.sched_getaffinity(0))[: len(NODES)]
    foreign = ("TRAPS_", "DAGSTER_", "RAY_", "AWS_")
    plain = {key: value for key, value in os.environ.items() if not key.startswith(foreign)}
    if not is_there():
        print("not measured: nodes with a fixed share of CPU (that needs root, and control groups that can be made)")
    for fixed in (True, False) if is_there() else (False,):
        (one, whole), (two, both) = (on_nodes(count, cores, plain, fixed=fixed) for count in (1, 2))
        share = f"{CORES} of a core each, whatever else runs" if fixed else "a core each, shared with all else"
        print(
            f"two nodes against one, {share}, load {os.getloadavg()[0]:.0f}: {one / two:.2f} times as fast "
            f"({one / two / 2:.2f} of twice); as a whole {whole / both:.2f}",
            flush=True,
        )
    one, two = (without_cluster(count, cores, plain) for count in (1, 2))
    print(f"without a cluster: {one:.0f} s by a process of one core, {two:.0f} s by two that share ({one / two:.2f})")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", nargs="*", choices=["rendering", *OTHERS, []], default=[])
    for what in parser.parse_args().what or ["rendering", *OTHERS]:
        if what == "rendering":
            rendering()
        else:
            print(f"{what}: python {' '.join(OTHERS[what])}; load {os.getloadavg()[0]:.0f}", flush=True)
            subprocess.run([sys.executable, *OTHERS[what]], cwd=ROOT, check=True)


if __name__ == "__main__":
    main()
