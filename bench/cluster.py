"""What a cluster costs and gains, against what a user would otherwise use: one machine, its files, and its processes.

python bench/cluster.py [rendering] [calls] [asking] [ledger] [first-call] [pages]
(needs the packages of the extra `cluster`, and moto; `pages` also Chromium)

rendering: two nodes against one, each bound to a core of its own, from the first run's start to the last one's end, and
as a whole; and what two such cores give processes without a cluster that share the same clips. calls: 2,000 calls of
50 ms with the ledger in PostgreSQL against one in a folder. asking: the same by a whole study on a node against one
process. ledger: rows a second, against files. first-call: of a study in an object store whose ledger holds 10^6 rows.
pages: Dagster's, of studies of 10,000 and 50,000 cells whose history lies in PostgreSQL, against a stock project's.
"""

from __future__ import annotations

import argparse
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterable, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from dagster import DagsterInstance

from bench.cluster_gate import Cluster
from bench.cluster_study import NODES, Study
from tests.objectstore import S3
from tests.postgres import Postgres

ROOT = Path(__file__).resolve().parents[1]
# A category is the least that a run renders, so there are as many runs as categories here: of some 45 s each, since a
# run costs ten before it renders anything.
FAMILIES = {
    "ramps_rolling": "slide", "pendulums_levers": "pendulum", "trajectories_drops": "bounce", "collisions": "chain",
    "dominoes": "domino_chain", "pachinko_waterfall": "pachinko_waterfall", "plinko": "plinko",
    "tumbling_dice": "tumbling_dice",
}  # fmt: skip
SCENARIOS = 8  # of each
EXPERIMENT = """
name: rendering
description: Clips of eight categories.
models: [oracle]
regimes: [standard]
panel: rules
scenarios: [{scenarios}]
"""
Run = tuple[float, float, str]  # when it began and ended, and its category
OTHERS = {
    "calls": ["bench/calls.py", "--database", "--times", "3"],
    "asking": ["bench/cluster_asking.py"],
    "ledger": ["bench/ledger.py", "--database"],
    "first-call": ["bench/first_call.py", "--rows", "1000000", "--store"],
    "pages": ["bench/ui.py", "--database", "--cells", "10000", "50000"],
}


def experiment(categories: Iterable[str]) -> str:
    """The file that asks for clips of these categories."""
    names = [f"{FAMILIES[one]}-{n:04d}" for one in categories for n in range(1, SCENARIOS + 1)]
    return EXPERIMENT.format(scenarios=", ".join(names))


def rendered(study: Study) -> tuple[float, list[Run]]:
    """Make the clips of a study on the cluster: seconds in all, and its runs in the order in which they began."""
    began = time.monotonic()
    made = study.run_to_end("--runs", str(len(FAMILIES)))
    seconds = time.monotonic() - began
    if made.returncode:
        raise SystemExit(made.stdout + made.stderr)
    with study.opened() as workspace:
        instance = DagsterInstance.from_config(str(workspace.dagster_home))
        stats = [(instance.get_run_stats(run.run_id), run.tags) for run in instance.get_runs()]
        instance.dispose()
    tag = "dagster/asset_partition_range_start"
    return seconds, sorted((one.start_time or 0.0, one.end_time or 0.0, tags[tag]) for one, tags in stats)


def without_cluster(parts: Sequence[Sequence[str]], cores: Sequence[int], plain: Mapping[str, str]) -> float:
    """Seconds that processes of `traps run` take to render these categories side by side, each bound to a core."""
    with tempfile.TemporaryDirectory(prefix="scale-") as name:
        processes, began = list[subprocess.Popen[bytes]](), time.monotonic()
        for number, (part, core) in enumerate(zip(parts, cores, strict=False)):
            path = Path(name) / f"part{number}.yaml"
            path.write_text(experiment(part))
            os.sched_setaffinity(0, {core})
            command = [sys.executable, "-m", "traps_pipeline.cli", "run", str(path), "--until", "videos"]
            own = {"PYTHONPATH": str(ROOT), "TRAPS_WORKSPACE": str(Path(name) / f"study{number}")}
            processes.append(subprocess.Popen(command, cwd=ROOT, env={**plain, **own}, stdout=subprocess.DEVNULL))
            os.sched_setaffinity(0, cores)
        codes = [process.wait() for process in processes]
        if any(codes):
            raise SystemExit("a process of `traps run` failed")
        return time.monotonic() - began


def halves(runs: Sequence[Run]) -> tuple[list[str], list[str]]:
    """Two groups of categories that take as long as each other, as nearly as the runs say."""
    groups: tuple[list[str], list[str]] = [], []
    seconds = [0.0, 0.0]
    for begin, end, category in sorted(runs, key=lambda run: run[0] - run[1]):
        less = seconds.index(min(seconds))
        groups[less].append(category)
        seconds[less] += end - begin
    return groups


def rendering() -> None:
    """Print how long rendering takes on one node and on two."""
    cores = sorted(os.sched_getaffinity(0))[: len(NODES)]
    foreign = ("TRAPS_", "DAGSTER_", "RAY_", "AWS_")
    plain = {key: value for key, value in os.environ.items() if not key.startswith(foreign)}
    whole, runs = dict[int, float](), dict[int, list[Run]]()
    for count in (1, 2):
        with ExitStack() as opened:
            name = opened.enter_context(tempfile.TemporaryDirectory(prefix="scale-", ignore_cleanup_errors=True))
            database, store = opened.enter_context(Postgres.running()), opened.enter_context(S3.running())
            folder = Path(name)
            (folder / "rendering.yaml").write_text(experiment(FAMILIES))
            shared = plain | store.environment | {
                "PYTHONPATH": str(ROOT), "TMPDIR": name, "TRAPS_DATABASE": database.address(),
                "PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}",
            }  # fmt: skip
            cluster = Cluster(folder, shared)
            own = {
                "TRAPS_RAY": f"http://127.0.0.1:{cluster.dashboard}",
                "TRAPS_WORKSPACE": f"s3://lab/rendering-{count}",
            }
            environment = shared | own | {"TRAPS_SCRATCH": str(folder / "here")}
            study = Study(folder, environment, folder / "rendering.yaml", until="videos")
            try:
                cluster.start_head()
                for node, core in list(zip(NODES, cores, strict=True))[:count]:
                    os.sched_setaffinity(0, {core})
                    cluster.start_node(node)
                    os.sched_setaffinity(0, cores)
                study.start_daemon()
                whole[count], runs[count] = rendered(study)
            finally:
                study.stop()
                for node in (*NODES, "head"):
                    cluster.signal(node, signal.SIGKILL)
        each = ", ".join(f"{end - begin:.0f} s" for begin, end, _ in runs[count])
        print(f"rendering, {count} node(s) of one core: {whole[count]:.0f} s, with runs of {each}", flush=True)
    one, two = (max(end for _, end, _ in of) - min(begin for begin, *_ in of) for of in (runs[1], runs[2]))
    most = one / allowed(runs[1]) / 2
    alone = without_cluster([[*FAMILIES]], cores, plain), without_cluster(halves(runs[1]), cores, plain)
    print(f"without a cluster: {alone[0]:.0f} s by a process of one core, {alone[1]:.0f} s by two processes")
    print(
        f"two nodes against one, load {os.getloadavg()[0]:.0f}: {one / two:.2f} times as fast ({one / two / 2:.2f} of "
        f"twice, where runs of these sizes allow {most:.2f}, and {alone[1] * one / two / alone[0]:.2f} of what two "
        f"processes without a cluster gain); as a whole {whole[1] / whole[2]:.2f}"
    )


def allowed(runs: Sequence[Run]) -> float:
    """Seconds that two nodes need at the least for runs that one has made one after another, if each node takes the
    next of them when it is free and waits as long between two runs as the one did."""
    waits = [*(later[0] - run[1] for later, run in zip(runs[1:], runs, strict=False)), 0.0]
    free = [0.0] * len(NODES)
    for (begin, end, _), wait in zip(runs, waits, strict=True):
        free[free.index(min(free))] += end - begin + wait
    return max(free)


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
