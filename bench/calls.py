"""Answers a second and CPU an answer, through our backend, ledger and limits against bare `litellm.acompletion` in a
loop, on the same server (50 ms latency), in one run; with `--inspect PYTHON` also against inspect_ai, with `--database`
also with the ledger in a PostgreSQL that syncs to the disk. Ours are laid out as a study is: cells of 1,000 items (500
pairs), each finished before the next.

python bench/calls.py [--answers 2000] [--times 1] [--memory] [--database] [--inspect /path/to/python]
"""

from __future__ import annotations

import argparse
import asyncio
import json
import math
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))
from bench.quick import parse  # noqa: E402

PARAMS = {"temperature": 0.8, "top_p": 0.95, "max_tokens": 8000}
SYSTEM, QUESTION = "You watch a clip. " * 90, "Does the ball clear the barrier {number}, yes or no?"  # 2 KB in all
CONNECTIONS = (24, 200)
CELL_ITEMS = 1000
KEY, DATABASE = "BENCH_KEY", "BENCH_DATABASE"


def ours(url: str, connections: int, answers: int) -> dict[str, float]:
    """Return requests through `ask`: backend, retries, pace, budget and the ledger, on disk or in a database."""
    from traps_cluster.postgres import open_ledger
    from traps_pipeline.ledger.ledger import Ledger
    from traps_pipeline.ledger.sqlite import SqliteDatabase
    from traps_pipeline.models.asking.ask import Call, Work, run_work
    from traps_pipeline.models.asking.participants import Participants
    from traps_pipeline.models.money.budget import Budget
    from traps_pipeline.models.registry.accounts import Account, Limits
    from traps_pipeline.models.registry.entries import Entry
    from traps_pipeline.models.request import Request
    from traps_pipeline.models.wire.api import ApiBackend, load_litellm
    from traps_pipeline.protocol.cells import Cell, Evaluation
    from traps_pipeline.protocol.datasets import DATASETS
    from traps_pipeline.protocol.regimes import REGIMES
    from traps_pipeline.storage.study import Study

    account = Account(key=KEY, base_url=f"{url}/v1")
    fields: dict[str, Any] = {"id": "m", "backend": "api", "account": "a", "provider_id": "openai/m", "params": PARAMS}
    fields["limits"] = Limits(concurrency=connections)
    entry = Entry.model_validate(fields, context={"accounts": {"a": account}})
    evaluations = [Evaluation("m", regime, run) for run in range(1, 10) for regime in REGIMES]
    cells = [Cell(dataset, evaluation) for evaluation in evaluations for dataset in DATASETS]
    cells = cells[: math.ceil(answers / CELL_ITEMS)]

    def calls(cell: Cell) -> list[Call]:
        first = cells.index(cell) * CELL_ITEMS
        numbers = range(first, min(first + CELL_ITEMS, answers))
        asked = [(QUESTION.format(number=n), {"item_id": str(n), **cell.partition}) for n in numbers]
        return [Call(Request("m", "openai/m", PARAMS, SYSTEM, question, about)) for question, about in asked]

    load_litellm()
    with tempfile.TemporaryDirectory() as folder:
        free = Study(allow_unknown_prices=True)
        participants = Participants({"m": entry}, lambda e: ApiBackend(e, account), free, {"a": account})
        name = f"bench-{os.getpid()}"
        database = open_ledger(DATABASE, name) if DATABASE in os.environ else SqliteDatabase(Path(folder), name)
        ledger = Ledger(database, "answers")
        work = Work("responses", ledger, participants, Budget(0, {}), "1", calls, lambda _: None)
        return _measured(lambda: list(run_work(work, cells)), answers)


def bare(url: str, connections: int, answers: int) -> dict[str, float]:
    """Return the least that a script would do: acompletion under a semaphore, answers kept in a list."""
    from traps_pipeline.models.wire.api import load_litellm

    litellm = load_litellm()

    async def loop() -> None:
        free = asyncio.Semaphore(connections)

        async def one(number: int) -> str:
            messages = [{"role": "system", "content": SYSTEM}]
            messages += [{"role": "user", "content": QUESTION.format(number=number)}]
            async with free:
                response = await litellm.acompletion(
                    model="openai/m", messages=messages, api_base=f"{url}/v1", api_key="k", max_retries=0, **PARAMS
                )
            return response.choices[0].message.content

        await asyncio.gather(*(one(number) for number in range(answers)))

    return _measured(lambda: asyncio.run(loop()), answers)


INSPECT = """
import json, resource, sys, time
from inspect_ai import Task, eval
from inspect_ai.dataset import MemoryDataset, Sample
from inspect_ai.model import GenerateConfig, get_model
from inspect_ai.solver import generate, system_message
url, connections, answers, system, question = json.loads(sys.argv[1])
samples = [Sample(input=question.format(number=n), target="yes") for n in range(answers)]
task = Task(dataset=MemoryDataset(samples), solver=[system_message(system), generate()])
model = get_model("openai/m", base_url=url + "/v1", api_key="k", responses_api=False,
    config=GenerateConfig(temperature=0.8, top_p=0.95, max_tokens=8000, max_connections=connections, max_retries=0))
began, cpu = time.perf_counter(), sum(resource.getrusage(resource.RUSAGE_SELF)[:2])
eval(task, model=model, display="none", max_samples=connections, log_dir=sys.argv[2])
used = sum(resource.getrusage(resource.RUSAGE_SELF)[:2]) - cpu
print(json.dumps({"rate": answers / (time.perf_counter() - began), "cpu_ms": 1000 * used / answers}))
"""


def _measured(work: Any, answers: int) -> dict[str, float]:
    began, cpu = time.perf_counter(), _cpu_s()
    work()
    seconds = time.perf_counter() - began
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    return {"rate": answers / seconds, "cpu_ms": 1000 * (_cpu_s() - cpu) / answers, "peak_mb": peak}


def _cpu_s() -> float:
    return sum(resource.getrusage(resource.RUSAGE_SELF)[:2])


def _in_a_process(command: Sequence[str], **more: str) -> dict[str, float]:
    environment = os.environ | {KEY: "k"} | more
    done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT, env=environment, check=False)
    if done.returncode:
        raise SystemExit(done.stderr)
    return json.loads(done.stdout.splitlines()[-1])


def _worker(name: str, url: str, connections: int, answers: int, **more: str) -> dict[str, float]:
    return _in_a_process([sys.executable, __file__, "--worker", name, url, str(connections), str(answers)], **more)


def _inspect(python: str, url: str, connections: int, answers: int) -> dict[str, float]:
    with tempfile.TemporaryDirectory() as logs:
        task = json.dumps([url, connections, answers, SYSTEM, QUESTION])
        return _in_a_process([python, "-c", INSPECT, task, logs])


def main() -> None:
    from tests.postgres import Postgres
    from tests.providers.server import Provider

    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--answers", type=int, default=2000)
    parser.add_argument("--times", type=int, default=1, help="each is measured so often, in turn; the best counts")
    parser.add_argument("--memory", action="store_true", help="peak memory after 4,000 and after 20,000 calls")
    parser.add_argument("--database", action="store_true", help="the ledger in PostgreSQL, too")
    parser.add_argument("--inspect", metavar="PYTHON", help="a Python that has inspect_ai and openai")
    arguments = parse(parser, answers=60)
    with ExitStack() as opened:
        provider = opened.enter_context(Provider.start({"latency_s": 0.05}, keeps_records=False))
        database = opened.enter_context(Postgres.running(durable=True)) if arguments.database else None
        print(f"{'connections':>11} {'':<18} {'answers/s':>10} {'CPU ms each':>12}")
        kinds: dict[str, tuple[str, dict[str, str]]] = {"ours": ("ours", {}), "bare": ("bare", {})}
        if database:
            kinds["ours, PostgreSQL"] = "ours", {DATABASE: database.address()}
        for connections in CONNECTIONS:
            found = dict[str, dict[str, float]]()
            for _ in range(arguments.times):  # in turn, so that what else the machine does meets all of them
                for name, (worker, where) in kinds.items():
                    new = _worker(worker, provider.url, connections, arguments.answers, **where)
                    found[name] = max(found.get(name, new), new, key=lambda one: one["rate"])
            if arguments.inspect:
                few = max(200, arguments.answers // 5)
                found["inspect_ai"] = _inspect(arguments.inspect, provider.url, connections, few)
            for name, measured in found.items():
                print(f"{connections:>11} {name:<18} {measured['rate']:>10.1f} {measured['cpu_ms']:>12.2f}")
            print(
                f"{connections:>11} CPU, ours / bare litellm: {found['ours']['cpu_ms'] / found['bare']['cpu_ms']:.2f}"
            )
            if database:
                longer = found["ours"]["rate"] / found["ours, PostgreSQL"]["rate"]
                print(f"{connections:>11} time, PostgreSQL / folder: {longer:.2f}")
            if arguments.inspect:
                ratio = found["ours"]["rate"] / found["inspect_ai"]["rate"]
                print(f"{connections:>11} answers a second, ours / inspect_ai: {ratio:.1f}")
        if arguments.memory:
            few, many = (_worker("ours", provider.url, 200, n)["peak_mb"] for n in (4000, 20000))
            print(f"peak memory after 4,000 calls {few:.0f} MB, after 20,000 {many:.0f} MB: {many / few:.2f}")


if __name__ == "__main__":
    if "--worker" in sys.argv:
        _, _, worker, server, width, count = sys.argv
        print(json.dumps({"ours": ours, "bare": bare}[worker](server, int(width), int(count))))
    else:
        main()
