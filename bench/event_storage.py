"""What an event of a run costs in this project's storage, and in Dagster's own, in one run.

python -m bench.event_storage --runs 4
"""

import argparse
import os
import statistics
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import dagster as dg
import yaml

from bench.quick import parse
from traps_pipeline.base.paths import ASSETS

KEYS = [str(number) for number in range(100)]


@dg.asset(
    partitions_def=dg.StaticPartitionsDefinition(KEYS),
    backfill_policy=dg.BackfillPolicy.single_run(),
    output_required=False,
)
def partitions(context: dg.AssetExecutionContext) -> Iterator[dg.AssetMaterialization]:
    """Report a materialization and a line for each partition, as a stage does."""
    for key in context.partition_keys:
        context.log.info(f"partition {key}")
        yield dg.AssetMaterialization("partitions", partition=key)


def milliseconds(*, plain: bool) -> tuple[float, float]:
    """Return CPU and wall milliseconds an event of a run of 100 partitions."""
    settings = yaml.safe_load((ASSETS / "dagster.yaml").read_text(encoding="utf-8"))
    if plain:
        del settings["storage"]
    with tempfile.TemporaryDirectory() as home:
        os.environ["DAGSTER_HOME"] = home
        Path(home, "dagster.yaml").write_text(yaml.safe_dump(settings), encoding="utf-8")
        with dg.DagsterInstance.from_config(home) as instance:
            cpu, wall = time.process_time(), time.perf_counter()
            ends = {"dagster/asset_partition_range_start": KEYS[0], "dagster/asset_partition_range_end": KEYS[-1]}
            run = dg.materialize([partitions], instance=instance, tags=ends)
            cpu, wall = time.process_time() - cpu, time.perf_counter() - wall
            count = len(instance.all_logs(run.run_id))
    return 1e3 * cpu / count, 1e3 * wall / count


def main() -> None:
    """Print both, and the ratio."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=4, help="pairs of runs, alternately")
    count = parse(parser, runs=1).runs
    pairs = [(milliseconds(plain=False), milliseconds(plain=True)) for _ in range(count)]
    for place, kind in enumerate(("CPU", "wall")):
        ours, theirs = (statistics.median(pair[side][place] for pair in pairs) for side in (0, 1))
        print(f"{kind}: {ours:.2f} ms an event, plain Dagster {theirs:.2f} ms: {theirs / ours:.1f} times")


if __name__ == "__main__":
    main()
