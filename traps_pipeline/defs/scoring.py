"""The scoring group: metrics of cells, the leaderboard."""

from typing import Any

import dagster as dg

from traps_pipeline import progress
from traps_pipeline.defs import common
from traps_pipeline.defs.benchmark import items
from traps_pipeline.defs.common import DATASET, OWNERS, Checks, Events, by_dataset, check, table_asset, table_metadata
from traps_pipeline.defs.evaluation import verdicts
from traps_pipeline.errors import TrapsError
from traps_pipeline.lineage import Lineage
from traps_pipeline.progress import Tally
from traps_pipeline.scoring import Frame
from traps_pipeline.storage.workspace import Workspace
from traps_pipeline.tables import CONTRASTS, LEADERBOARD, METRICS, REGIME_TESTS, VERDICTS

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
    from traps_pipeline.judging.verdicts import current
    from traps_pipeline.scoring.metrics import cell_metrics, wrong_figures

    workspace, dataset = Workspace.open(), context.partition_key
    provenance = common.provenance(context, workspace)
    inputs = Lineage(workspace).inputs("metrics", dataset)
    judged = current(workspace, VERDICTS, dataset=dataset)
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


def _contrasts(workspace: Workspace) -> Frame:
    from traps_pipeline.scoring.bootstrap import resample
    from traps_pipeline.scoring.contrasts import contrasts as paired

    cells, judged = _scored(workspace, "contrasts")
    return paired(resample(judged), cells, judged)


def _regime_tests(workspace: Workspace) -> Frame:
    from traps_pipeline.scoring.contrasts import regime_tests as mcnemar

    return mcnemar(_scored(workspace, "regime_tests")[1])


def _leaderboard(workspace: Workspace) -> Frame:
    from traps_pipeline.scoring.bootstrap import intervals, resample
    from traps_pipeline.scoring.leaderboard import leaderboard as rank

    cells, judged = _scored(workspace, "leaderboard")
    return rank(cells, intervals(resample(judged)), workspace.tables.read(CONTRASTS, {}))


def _scored(workspace: Workspace, stage: str) -> tuple[Frame, Frame]:
    """All METRICS rows, and the VERDICTS rows that they are made of."""
    from traps_pipeline.judging.verdicts import current

    cells = workspace.tables.read_all(METRICS)
    if cells.empty:
        raise TrapsError(f"{stage}: no metrics yet; materialize metrics for a dataset first")
    return cells, current(workspace, VERDICTS)


def _told_apart(table: Frame) -> dict[str, Any]:
    told = table[table["separable"] & (table["dataset"] == "overall")]
    refused = int(table["refused"].notna().sum())
    return {"contrasts": common.rows_shown(told), "separable": int(table["separable"].sum()), "refused": refused}


def _shown(board: Frame) -> dict[str, Any]:
    from traps_pipeline.report.page import leaderboard_markdown

    overall = board.loc[board["dataset"] == "overall", "pecs"].to_numpy(float)
    best = {"best overall PECS": float(overall.max())} if len(overall) else {}
    return {"leaderboard": dg.MetadataValue.md(leaderboard_markdown(board))} | best


def _intervals_ordered(board: Frame) -> str:
    from traps_pipeline.scoring.leaderboard import wrong_intervals

    wrong = wrong_intervals(board)
    return f"{wrong} intervals are wrong" if wrong else ""


contrasts = table_asset(
    CONTRASTS,
    GROUP,
    "Paired differences between models and between regimes, with intervals and Holm's correction.",
    [metrics, verdicts],
    _contrasts,
    _told_apart,
)
regime_tests = table_asset(
    REGIME_TESTS,
    GROUP,
    "McNemar's exact test of every two regimes on the same items, by model, dataset, run and decision.",
    [metrics, verdicts],
    _regime_tests,
)
leaderboard = table_asset(
    LEADERBOARD,
    GROUP,
    "Every model under every regime, per dataset and overall: mean and spread over runs, 95 % intervals, ranks.",
    [metrics, verdicts, contrasts],
    _leaderboard,
    _shown,
    (
        check(
            "intervals_ordered", "leaderboard", "Every interval is ordered and lies in [0, 1], that of J in [-1, 1]."
        ),
        _intervals_ordered,
    ),
)
