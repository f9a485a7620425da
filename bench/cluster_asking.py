"""What it costs calls that a study is made on a cluster: the same cells asked by one process with a folder, and by one
run on one node, with the study in PostgreSQL and an object store; 2,016 calls of 50 ms over 24 connections, in cells of
48 calls.

python bench/cluster_asking.py [--times 2]
(needs the packages of the extra `cluster`, and moto)

Seconds from the first call to the last, at the provider, and of the whole command; each is measured several times, in
turn, and the fastest counts.
"""

from __future__ import annotations

import argparse
import os
import shutil
import signal
import sys
import time
from contextlib import ExitStack
from pathlib import Path
from tempfile import TemporaryDirectory

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from bench.cluster_launcher import Cluster
from bench.cluster_study import Study
from tests.build.network import entry, register
from tests.conftest import KEY, SECRET, Checkout, make_checkout
from tests.objectstore import S3
from tests.postgres import Postgres
from tests.providers.server import Provider
from traps_pipeline.storage.place import scratch_of

MODELS, CONNECTIONS, LATENCY_S = [f"seer-{letter}" for letter in "abc"], 8, 0.05
RUNS = list(range(1, 8))
SCENARIOS = [f"{family}-{number:04d}" for family in ("slide", "bounce", "launch") for number in range(1, 9)]
ITEMS = len(SCENARIOS) * 2 * 2  # two datasets, two sides
CALLS = ITEMS * len(RUNS) * len(MODELS)
EXPERIMENT = f"""
name: asking
description: Models at a provider.
models: {MODELS}
regimes: [standard]
runs: {RUNS}
panel: rules
judged_by_rules: true
scenarios: {SCENARIOS}
""".replace("'", "")
MORE = f"prices: {{input: 1.0, output: 10.0, as_of: 2026-11-01}}\n    runs: {len(RUNS)}"  # of an entry
BUDGET = ("--no-preflight", "--budget-usd", "100000")


def asked(study: Study, provider: Provider, *more: str) -> tuple[float, float]:
    """Ask all cells; seconds from the first call to the last, and of the command."""
    provider.reset()
    began = time.monotonic()
    process, first, last = study.start_run(*more, *BUDGET), 0.0, 0.0
    while process.poll() is None and not last:
        stats = provider.stats()
        first = first or (time.monotonic() if stats["requests"] else 0.0)
        last = time.monotonic() if stats["answered_in_full"] == CALLS else 0.0
        time.sleep(0.05)
    said = process.communicate()[0]
    if process.returncode or not last:
        raise SystemExit(f"{said}\nafter {provider.stats()}")
    return last - first, time.monotonic() - began


class Alone(Study):
    """A study in a folder that this process's host makes by itself."""

    def _run(self, *more: str) -> list[str]:
        return ["run", str(self.experiment), "--until", self.until, *more]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--times", type=int, default=2)
    times = parser.parse_args().times
    foreign = ("TRAPS_", "DAGSTER_", "RAY_", "AWS_")
    plain = {key: value for key, value in os.environ.items() if not key.startswith(foreign)} | {KEY: SECRET}
    with ExitStack() as opened:
        name = opened.enter_context(TemporaryDirectory(prefix="asking-", ignore_cleanup_errors=True))
        database, store = opened.enter_context(Postgres.running(durable=True)), opened.enter_context(S3.running())
        provider = opened.enter_context(Provider.start({"latency_s": LATENCY_S}, keeps_records=False))
        folder = Path(name)
        checkout = Checkout(make_checkout(folder / "checkout"), folder / "clips")
        limits = f"limits: {{concurrency: {CONNECTIONS}, timeout_s: 36, backoff_s: 0.05}}"
        entries = [
            entry(one, "images", MORE).replace("limits: {timeout_s: 36, backoff_s: 0.05}", limits) for one in MODELS
        ]
        register(checkout, provider, *entries)
        experiment = checkout.root / "asking.yaml"
        experiment.write_text(EXPERIMENT)
        path = f"{Path(sys.executable).parent}:{os.environ['PATH']}"
        common = plain | {"PYTHONPATH": str(checkout.root), "TMPDIR": name, "PATH": path}
        shared = common | store.environment | {"TRAPS_DATABASE": database.address()}
        rendered = Alone(
            folder, common | {"TRAPS_WORKSPACE": str(checkout.workspace)}, experiment, checkout.root, "items"
        )
        made = rendered.run_to_end(*BUDGET)
        if made.returncode:
            raise SystemExit(made.stdout + made.stderr)
        cluster, found = Cluster(folder, shared), dict[str, list[tuple[float, float]]]()
        shared["TRAPS_RAY"] = f"http://127.0.0.1:{cluster.dashboard}"
        try:
            cluster.start_head()
            cluster.start_node("one")
            for turn in range(times):
                here = {"TRAPS_WORKSPACE": str(folder / f"alone-{turn}")}
                alone = Alone(folder, common | here, experiment, checkout.root, "responses")
                shutil.copytree(checkout.workspace / "clips", folder / f"alone-{turn}" / "clips")
                there = {"TRAPS_WORKSPACE": f"s3://lab/asking-{turn}", "TRAPS_SCRATCH": str(folder / f"here-{turn}")}
                study = Study(folder, shared | there, experiment, checkout.root, "responses")
                with study.exported():
                    scratch = scratch_of(there["TRAPS_WORKSPACE"])
                shutil.copytree(checkout.workspace / "clips", scratch / "clips")
                for one in (alone, study):  # clips and items, so that only calls are left
                    said = one.traps("run", str(experiment), "--until", "items")
                    if "\n0 frames rendered" not in said.stdout:
                        raise SystemExit(said.stdout + said.stderr)
                study.start_daemon()
                for kind, one, more in (("folder", alone, ()), ("cluster", study, ("--runs", "1"))):
                    took = asked(one, provider, *more)
                    found.setdefault(kind, []).append(took)
                    print(f"{kind}: {CALLS} calls in {took[0]:.1f} s, the command {took[1]:.1f} s", flush=True)
                study.stop()
        finally:
            for node in ("one", "head"):
                cluster.signal(node, signal.SIGKILL)
        calls, whole = ([min(one[n] for one in found[kind]) for kind in ("cluster", "folder")] for n in (0, 1))
        print(f"calls, cluster / folder: {calls[0] / calls[1]:.2f}; the command: {whole[0] - whole[1]:.1f} s longer")


if __name__ == "__main__":
    main()
