"""The scoring group: metrics of cells, the leaderboard."""

import dagster as dg

from traps_pipeline import progress
from traps_pipeline.defs import common
from traps_pipeline.defs.common import DATASET, OWNERS, Events, by_dataset, check, table_metadata, verdict_of
from traps_pipeline.defs.evaluation import verdicts
from traps_pipeline.errors import TrapsError
from traps_pipeline.lineage import Lineage
from traps_pipeline.progress import Tally
from traps_pipeline.storage.workspace import Workspace
from traps_pipeline.tables import ITEMS, LEADERBOARD, METRICS, VERDICTS

GROUP = "scoring"


@dg.asset(
    partitions_def=DATASET,
    deps=[dg.AssetDep(verdicts, partition_mapping=by_dataset)],
    group_name=GROUP,
    kinds={"parquet"},
    owners=OWNERS,
    metadata=table_metadata("metrics"),
    output_required=False,
    check_specs=[check("shares_are_shares", "metrics", "Acc, AbsRec and FalseAbs lie in [0, 1], PECS is Acc x max(0, J).")],
)
def metrics(context: dg.AssetExecutionContext) -> Events:
    """Acc, FalseAbs, AbsRec, J and PECS of every cell of a dataset, by scope (`benchmark.md` section 5)."""
    from traps_pipeline.scoring.metrics import cell_metrics

    workspace, dataset = Workspace.open(), context.partition_key
    provenance = common.provenance(context, workspace)
    inputs = Lineage(workspace).inputs("metrics", dataset)
    judged = workspace.tables.read_all(VERDICTS, dataset=dataset)
    if judged.empty:
        raise TrapsError(f"metrics {dataset}: no verdicts yet; materialize verdicts for a cell of this dataset first")
    benchmark_version = workspace.tables.read(ITEMS, {"dataset": dataset}, ["benchmark_version"])["benchmark_version"].iloc[0]
    frame = cell_metrics(judged, benchmark_version)
    version = workspace.tables.write(METRICS, {"dataset": dataset}, frame, inputs)
    progress.current().partition("metrics", dataset, Tally())
    yield common.materialized(context, dataset, version, provenance, **{"dagster/partition_row_count": len(frame)})
    shares = frame[["acc", "abs_rec", "false_abs"]].stack()
    product = frame["acc"] * (frame["abs_rec"] - frame["false_abs"]).clip(lower=0)
    wrong = int((~shares.between(0, 1)).sum()) + int(((frame["pecs"] - product).abs() > 1e-12).sum())
    yield verdict_of("shares_are_shares", context, wrong == 0, cells=len(frame), wrong=wrong)


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

    workspace = Workspace.open()
    provenance = common.provenance(context, workspace)
    inputs = Lineage(workspace).inputs("leaderboard", None)
    cells = workspace.tables.read_all(METRICS)
    if cells.empty:
        raise TrapsError("leaderboard: no metrics yet; materialize metrics for a dataset first")
    board = rank(cells, pecs_intervals(workspace.tables.read_all(VERDICTS)))
    version = workspace.tables.write(LEADERBOARD, {}, board, inputs)
    progress.current().partition("leaderboard", "", Tally())
    overall = board[board["dataset"] == "overall"]
    metadata = {
        "dagster/row_count": len(board),
        "leaderboard": dg.MetadataValue.md(leaderboard_markdown(board)),
        "best overall PECS": float(overall["pecs"].max()) if len(overall) else 0.0,
    }
    yield common.materialized(context, None, version, provenance, **metadata)
    known = board.dropna(subset=["pecs_ci_low", "pecs_ci_high"])
    ordered = (known["pecs_ci_low"] >= 0) & (known["pecs_ci_low"] <= known["pecs_ci_high"]) & (known["pecs_ci_high"] <= 1)
    yield verdict_of("intervals_ordered", context, ordered.all(), rows=len(known), wrong=int((~ordered).sum()))
