"""When the first call of a run goes out: `traps run` on a ledger of 100,000 rows, from the command to the request's
arrival at the server; CPU seconds too, which a loaded machine does not stretch. Then `traps plan` on the same ledger.

python bench/first_call.py [--rows 100000] [--database | --store]    (1600000: a large lab's year)

--database: the ledger in PostgreSQL; --store: the study in an object store (moto's server).
"""

from __future__ import annotations

import argparse
import asyncio
import os
import signal
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import ExitStack
from hashlib import sha256
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from bench.quick import parse
from tests.conftest import Checkout
from tests.providers.server import Provider

EVALUATION_ROWS = 4000  # four datasets of 500 pairs
RUNS, DATABASE, ADDRESS = 3, "BENCH_DATABASE", "s3://lab/first-call"


class Remote(Checkout):
    """A checkout whose study lies in an object store."""

    @property
    def environment(self) -> dict[str, str]:
        """See `Checkout`."""
        plain = {name: value for name, value in os.environ.items() if name != "DAGSTER_HOME"}
        return plain | {"TRAPS_WORKSPACE": ADDRESS, "PYTHONPATH": str(self.root)}


def ledger_rows(rows: int) -> Iterator[tuple[str, list[Any]]]:
    """Yield a ledger as a study leaves it, in parts of an evaluation each, its key before them: the evaluation that
    will be asked has rows of other keys too."""
    from traps_pipeline.models.asking.participants import ledger_row
    from traps_pipeline.models.request import Outcome, Request
    from traps_pipeline.pipeline.wanted import StudyPartitions
    from traps_pipeline.protocol.cells import Evaluation

    params, text = {"temperature": 0.8, "top_p": 0.95, "max_tokens": 8000}, "The ball comes to rest on the left. " * 15
    outcome = Outcome(
        "answer", text, finish_reason="stop", served_model="m-2026", prompt_tokens=6500, completion_tokens=150,
        reasoning_tokens=20, cost_usd=0.0002,
    )  # fmt: skip
    asked = Evaluation("image-model", "standard", 1)
    evaluations = [asked, *(e for e in StudyPartitions(None).evaluations if e.model != asked.model)]
    for start in range(0, rows, EVALUATION_ROWS):
        evaluation = evaluations[start // EVALUATION_ROWS % len(evaluations)]
        about = {"item_id": f"occlusion:old-{start}:void", "model": evaluation.model, "regime": "standard", "run": 1}
        request = Request(evaluation.model, "openai/m", params, "system", "Which way?", about, None, None, "0" * 64)
        row, beside = ledger_row(request, outcome, 1, 2.5, "1")  # of all: making one takes longer than storing it
        keys = (sha256(b"%d" % n).hexdigest() for n in range(start, min(start + EVALUATION_ROWS, rows)))
        yield evaluation.key, [({**row, "key": key}, beside) for key in keys]


def fill(place: Path | str, rows: int) -> None:
    """Such a ledger in the study at a place."""
    from traps_pipeline.storage.workspace import Workspace

    ledger = Workspace.open(place).answers
    for evaluation, part in ledger_rows(rows):
        asyncio.run(ledger.store({evaluation: part}, print))


def _cpu_s(pid: int) -> float:
    """Return CPU seconds of a process that runs."""
    fields = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def in_store(opened: ExitStack, folder: Path) -> Remote:
    """Return a study in an object store of this machine, not made yet."""
    from tests.conftest import make_checkout
    from tests.objectstore import S3, exported
    from tests.postgres import Postgres

    opened.enter_context(exported(opened.enter_context(S3.running())))
    os.environ["TRAPS_DATABASE"] = opened.enter_context(Postgres.running(durable=True)).address()
    os.environ["TRAPS_SCRATCH"] = str(folder / "scratch")
    return Remote(make_checkout(folder / "checkout"), folder)


def first_calls(study: Checkout, provider: Provider, path: Path) -> None:
    """Print when the first call of runs goes out, and how long plans take."""
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


def main() -> None:
    from tests.build.network import entry, experiment
    from tests.conftest import KEY, SECRET, make_checkout
    from tests.postgres import Postgres

    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rows", type=int, default=100_000)
    where = parser.add_mutually_exclusive_group()
    where.add_argument("--database", action="store_true", help="bring the ledger into PostgreSQL first")
    where.add_argument("--store", action="store_true", help="the study in an object store")
    arguments = parse(parser, rows=2_000)
    os.environ |= {KEY: SECRET, "MUJOCO_GL": os.environ.get("MUJOCO_GL", "osmesa")}
    with ExitStack() as opened:
        name, provider = opened.enter_context(tempfile.TemporaryDirectory()), opened.enter_context(Provider.start())
        study = Checkout(make_checkout(Path(name) / "checkout"), Path(name) / "study")
        if arguments.store:
            study = in_store(opened, Path(name) / "shared")
        free = experiment(study, provider, ["oracle"], regimes=["standard"])
        until = ("--until", "items") if arguments.store else ()
        made = study.traps("run", free, *until)  # clips, items and a Dagster history, as before any paid run
        assert made.code == 0, made.err
        began = time.perf_counter()
        fill(ADDRESS if arguments.store else study.workspace, arguments.rows)
        print(f"{arguments.rows} rows written in {time.perf_counter() - began:.1f} s", flush=True)
        if arguments.database:
            os.environ[DATABASE] = opened.enter_context(Postgres.running(durable=True)).address()
            began = time.perf_counter()
            file = Path(name) / "moved.sqlite"
            study_yaml = study.workspace / "study.yaml"
            exported = study.traps("study", "export-ledger", str(file))
            study_yaml.write_text(f"{study_yaml.read_text()}database: {DATABASE}\n")
            moved = study.traps("study", "import-ledger", str(file))
            assert exported.code == moved.code == 0, exported.err + moved.err
            print(f"moved into PostgreSQL in {time.perf_counter() - began:.1f} s", flush=True)
        path = experiment(study, provider, [entry("image-model", "images")], regimes=["standard"])
        first_calls(study, provider, path)


if __name__ == "__main__":
    main()
