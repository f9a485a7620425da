"""A cell of 100,000 items: time and peak memory of each stage from answers to metrics, and of the explorer.

The items are those of a small study many times over, under names of their own, so that nothing is rendered; a reference
model answers and rules judge. Each stage is a process of its own, and so is what multiplies: a child's peak as the
kernel counts it begins with its parent's.

python bench/large_cell.py [--items 100000]
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
import time
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))
from bench.quick import parse  # noqa: E402

CELL = "chaotic|random-50__standard__run1"
STAGES = {"responses": CELL, "votes": CELL, "verdicts": CELL, "metrics": "chaotic"}
SITE = """
import os
from pathlib import Path
from traps_pipeline.report.explorer.site import site_files
from traps_pipeline.storage.workspace import Workspace
files = site_files(Workspace.open(Path(os.environ["TRAPS_WORKSPACE"])))
print(f"{len(files)} files, {sum(map(len, files.values())) / 1e6:.0f} MB")
"""


def multiply(workspace: Path, items: int) -> None:
    """Put so many items in the place of the dataset's own, with what they were made from."""
    import pandas as pd

    from traps_pipeline.storage.benchmark_tables import ITEMS
    from traps_pipeline.storage.workspace import Workspace

    tables, partition = Workspace.open(workspace).tables, {"dataset": "chaotic"}
    rows, state = tables.read(ITEMS, partition), tables.state(ITEMS, partition)
    assert state is not None
    copies = []
    for n in range(items // len(rows)):
        names = rows["scenario_id"] + f"x{n}"
        copy = rows.assign(scenario_id=names, pair_id="chaotic:" + names)
        copies.append(copy.assign(item_id=copy["pair_id"] + ":" + copy["side"]))
    tables.write(ITEMS, partition, pd.concat(copies, ignore_index=True), state.inputs, code=state.code)


def run(study_environment: dict[str, str], *command: str | Path) -> tuple[float, float]:
    """Return the seconds and peak GB of a command and its children."""
    began = time.perf_counter()
    pid = os.posix_spawn(sys.executable, [sys.executable, *map(str, command)], study_environment)
    _, status, used = os.wait4(pid, 0)
    if status:
        raise SystemExit(f"{command}: exit {os.waitstatus_to_exitcode(status)}")
    return time.perf_counter() - began, used.ru_maxrss / 2**20


def main() -> None:
    from tests.conftest import Checkout, make_checkout

    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--items", type=int, default=100_000)
    arguments = parse(parser, items=1_000)
    with tempfile.TemporaryDirectory() as name:
        study = Checkout(make_checkout(Path(name) / "checkout"), Path(name) / "study")
        path = study.root / "large.yaml"
        path.write_text(
            "name: large\nmodels: [random-50]\nregimes: [standard]\npanel: rules\ndatasets: [chaotic]\n"
            "scenarios: [plinko-0001, tumbling_dice-0001]\n"
        )
        made = study.traps("run", path, "--until", "items")
        assert made.code == 0, made.err
        with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
            pool.submit(multiply, study.workspace, arguments.items).result()
        print(f"{arguments.items} items in one cell", flush=True)
        os.chdir(study.root)
        for stage, key in STAGES.items():
            # `traps run` would see that the items are not those that it made.
            command = ("-m", "dagster", "asset", "materialize", "-m", "traps_pipeline.definitions", "--select", stage)
            seconds, gigabytes = run(study.environment, *command, "--partition", key)
            print(f"{stage:10s} {seconds:7.1f} s {gigabytes:5.2f} GB", flush=True)
        seconds, gigabytes = run(study.environment, "-c", SITE)
        print(f"{'explorer':10s} {seconds:7.1f} s {gigabytes:5.2f} GB")


if __name__ == "__main__":
    main()
