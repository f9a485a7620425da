"""When the first call of a run goes out: `traps run` on a ledger of 100,000 rows, from the command to the request's
arrival at the server; CPU seconds too, which a loaded machine does not stretch. Then `traps plan` on the same ledger.
The first of either reads every row once and keeps totals beside the segments.

python bench/first_call.py [--rows 100000] [--database]        (1600000: a large lab's year; the ledger in PostgreSQL)
"""

from __future__ import annotations

import argparse
import os
import signal
import sys
import tempfile
import time
from contextlib import ExitStack
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))
EVALUATION_ROWS = 4000  # four datasets of 500 pairs
RUNS, DATABASE = 3, "BENCH_DATABASE"


def fill(root: Path, rows: int) -> None:
    """A ledger as a study leaves it: the evaluation that will be asked has rows of other keys too."""
    from traps_pipeline.models.participants import ledger_row
    from traps_pipeline.models.request import Outcome, Request
    from traps_pipeline.orchestration.wanted import Wanted
    from traps_pipeline.partitions import Evaluation
    from traps_pipeline.storage.segments import SegmentLedger

    params, text = {"temperature": 0.8, "top_p": 0.95, "max_tokens": 8000}, "The ball comes to rest on the left. " * 15
    outcome = Outcome("answer", text, None, "stop", None, "m-2026", 6500, 150, 20, 0.0002)
    asked = Evaluation("image-model", "standard", 1)
    evaluations = [asked, *(e for e in Wanted(None).evaluations if e.model != asked.model)]
    for start in range(0, rows, EVALUATION_ROWS):
        evaluation = evaluations[start // EVALUATION_ROWS % len(evaluations)]
        with SegmentLedger(root, "answers").writer(evaluation.key) as writer:
            for n in range(start, min(start + EVALUATION_ROWS, rows)):
                about = {
                    "item_id": f"occlusion:old-{n}:void",
                    "model": evaluation.model,
                    "regime": "standard",
                    "run": 1,
                }
                request = Request(
                    evaluation.model, "openai/m", params, "system", "Which way?", about, None, None, "0" * 64
                )
                writer.append(*ledger_row(request, outcome, 1, 2.5, "1"))


def _cpu_s(pid: int) -> float:
    """CPU seconds of a process that runs."""
    fields = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def main() -> None:
    from tests.conftest import KEY, SECRET, Checkout, make_checkout
    from tests.integration.test_network import entry, experiment, register
    from tests.postgres import Postgres
    from tests.providers.server import Provider

    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rows", type=int, default=100_000)
    parser.add_argument("--database", action="store_true", help="move the ledger into PostgreSQL first")
    arguments = parser.parse_args()
    os.environ |= {KEY: SECRET, "MUJOCO_GL": os.environ.get("MUJOCO_GL", "osmesa")}
    with ExitStack() as opened:
        name, provider = opened.enter_context(tempfile.TemporaryDirectory()), opened.enter_context(Provider.start())
        study = Checkout(make_checkout(Path(name) / "checkout"), Path(name) / "study")
        register(study, provider, entry("image-model", "images"))
        free = experiment(study, ["oracle"], regimes=["standard"])
        made = study.traps("run", free)  # clips, items and a Dagster history, as before any paid run
        assert made.code == 0, made.err
        began = time.perf_counter()
        fill(study.workspace / "ledger", arguments.rows)
        print(f"{arguments.rows} rows written in {time.perf_counter() - began:.1f} s")
        if arguments.database:
            os.environ[DATABASE] = opened.enter_context(Postgres.running(durable=True)).address()
            began = time.perf_counter()
            moved = study.traps("ledger", "move", "--to", DATABASE)
            assert moved.code == 0, moved.err
            print(f"moved into PostgreSQL in {time.perf_counter() - began:.1f} s", flush=True)
        path = experiment(study, ["image-model"], regimes=["standard"])
        for run in range(1, RUNS + 1):
            provider.reset()
            began = time.perf_counter()
            process = study.start(sys.executable, "-m", "traps_pipeline.cli", "run", path, "--budget-usd", "100000")
            while not provider.stats()["requests"]:
                if process.poll() is not None:
                    raise SystemExit(f"no call was made: {process.communicate()}")
                time.sleep(0.02)
            first_s, first_cpu_s = time.perf_counter() - began, _cpu_s(process.pid)
            os.killpg(process.pid, signal.SIGKILL)
            process.communicate()
            print(f"run {run}: first call {first_s:.1f} s after the command ({first_cpu_s:.1f} s of CPU)", flush=True)
        for run in range(1, RUNS + 1):
            began = time.perf_counter()
            planned = study.traps("plan", path)
            assert planned.code == 0, planned.err
            print(f"plan {run}: {time.perf_counter() - began:.1f} s", flush=True)


if __name__ == "__main__":
    main()
