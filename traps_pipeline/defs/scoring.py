"""The scoring group: metrics of cells, the leaderboard."""

from typing import Any

import dagster as dg

from traps_pipeline import progress
from traps_pipeline.defs import common
from traps_pipeline.defs.benchmark import items
from traps_pipeline.defs.common import DATASET, OWNERS, Checks, Events, by_dataset, check, table_metadata
from traps_pipeline.defs.evaluation import verdicts
from traps_pipeline.errors import TrapsError
from traps_pipeline.lineage import Lineage
from traps_pipeline.progress import Tally
from traps_pipeline.storage.workspace import Workspace
from traps_pipeline.tables import ITEMS, LEADERBOARD, METRICS, VERDICTS

GROUP = "scoring"


@dg.asset(
    partitions_def=DATASET,
    deps=[items, dg.AssetDep(verdicts, partition_mapping=by_dataset)],
    group_name=GROUP,
    kinds={"parquet"},
    owners=OWNERS,
    metadata=table_metadata("metrics"),
    output_required=False,
    check_specs=[
        check(
            "shares_are_shares",
            "metrics",
            "Acc, AbsRec and FalseAbs lie in [0, 1], PECS is Acc x max(0, J) and lies within its bounds.",
        )
    ],
)
def metrics(context: dg.AssetExecutionContext) -> Events:
    """Acc, FalseAbs, AbsRec, J and PECS of every cell of a dataset, by scope (`benchmark.md` section 5)."""
    from traps_pipeline.scoring.metrics import cell_metrics, wrong_figures

    workspace, dataset = Workspace.open(), context.partition_key
    provenance = common.provenance(context, workspace)
    inputs = Lineage(workspace).inputs("metrics", dataset)
    judged = workspace.tables.read_all(VERDICTS, dataset=dataset)
    # Cells that nobody has evaluated since a correction may still hold an item that was discarded.
    current = workspace.tables.read(ITEMS, {"dataset": dataset}, ["item_id"])["item_id"]
    judged = judged.loc[judged["item_id"].isin(current)]
    if judged.empty:
        raise TrapsError(f"metrics {dataset}: no verdicts yet; materialize verdicts for a cell of this dataset first")
    frame = cell_metrics(judged)
    wrong = wrong_figures(frame)
    checks = Checks(context, workspace)
    checks.record("shares_are_shares", dataset, f"{wrong} figures are wrong" if wrong else "")
    version = workspace.tables.write(METRICS, {"dataset": dataset}, frame, inputs)
    progress.current().partition("metrics", dataset, Tally())
    yield common.materialized(context, dataset, version, provenance, **{"dagster/partition_row_count": len(frame)})
    yield from checks.results()


@dg.asset(
    deps=[metrics, verdicts],
    group_name=GROUP,
    kinds={"parquet"},
    owners=OWNERS,
    metadata=table_metadata("leaderboard"),
    output_required=False,
    check_specs=[check("intervals_ordered", "leaderboard", "Every interval is ordered and lies in [0, 1].")],
)
def leaderboard(context: dg.AssetExecutionContext) -> Events:
    """Every model under every regime, per dataset and overall: mean and spread over runs, 95 % intervals."""
    from traps_pipeline.report.page import leaderboard_markdown
    from traps_pipeline.scoring.bootstrap import pecs_intervals
    from traps_pipeline.scoring.leaderboard import leaderboard as rank
    from traps_pipeline.scoring.leaderboard import wrong_intervals

    workspace = Workspace.open()
    provenance = common.provenance(context, workspace)
    inputs = Lineage(workspace).inputs("leaderboard", None)
    cells = workspace.tables.read_all(METRICS)
    if cells.empty:
        raise TrapsError("leaderboard: no metrics yet; materialize metrics for a dataset first")
    board = rank(cells, pecs_intervals(workspace.tables.read_all(VERDICTS)))
    wrong = wrong_intervals(board)
    checks = Checks(context, workspace)
    checks.record("intervals_ordered", None, f"{wrong} intervals are wrong" if wrong else "")
    version = workspace.tables.write(LEADERBOARD, {}, board, inputs)
    progress.current().partition("leaderboard", "", Tally())
    metadata: dict[str, Any] = {
        "dagster/row_count": len(board),
        "leaderboard": dg.MetadataValue.md(leaderboard_markdown(board)),
    }
    overall = board.loc[board["dataset"] == "overall", "pecs"].to_numpy(float)
    if len(overall):
        metadata["best overall PECS"] = float(overall.max())
    yield common.materialized(context, None, version, provenance, **metadata)
    yield from checks.results()
