"""The scoring group: metrics of cells, contrasts, the leaderboard."""

from typing import TYPE_CHECKING

from traps_pipeline.base.errors import TrapsError
from traps_pipeline.judging.judging_rows import VERDICTS
from traps_pipeline.pipeline.graph import Check
from traps_pipeline.pipeline.previews import Markdown
from traps_pipeline.pipeline.schemes import DATASET, by_dataset
from traps_pipeline.pipeline.stage import of, stage
from traps_pipeline.pipeline.stages.benchmark_stages import items
from traps_pipeline.pipeline.stages.evaluation_stages import judges, verdicts
from traps_pipeline.pipeline.stages.tables_shown import made_of, rows_shown
from traps_pipeline.protocol.datasets import ARMS, DATASETS
from traps_pipeline.scoring.score_rows import CONTRASTS, HYPOTHESES, LEADERBOARD, METRICS, REGIME_TESTS, ROBUST
from traps_pipeline.storage.parquet import StageOutput
from traps_pipeline.storage.workspace import Workspace

if TYPE_CHECKING:
    import pandas as pd

GROUP = "scoring"


def _make_metrics(workspace: Workspace, dataset: str) -> StageOutput:
    """Return Acc, FalseAbs, AbsRec, J and PECS of every cell of a dataset, by scope (docs/spec.md 5.1)."""
    from traps_pipeline.scoring.metrics import cell_metrics
    from traps_pipeline.storage.benchmark_tables import current_rows

    judged = current_rows(workspace, VERDICTS, dataset=dataset)
    if judged.empty:
        raise TrapsError(f"metrics {dataset}: no verdicts yet; materialize verdicts for a cell of this dataset first")
    return StageOutput(cell_metrics(judged))


def _wrong_figures(workspace: Workspace, key: str | None, output: StageOutput) -> str:
    from traps_pipeline.scoring.metrics import wrong_figures

    wrong = wrong_figures(output.frame)
    return f"{wrong} figures are wrong" if wrong else ""


metrics = stage(
    METRICS,
    _make_metrics,
    group=GROUP,
    parents=[items, of(verdicts, by_dataset, need="some"), judges],
    scheme=DATASET,
    checks=[
        Check(
            "shares_are_shares",
            "Acc, AbsRec and FalseAbs lie in [0, 1], PECS is Acc x max(0, J) and lies within its bounds.",
            _wrong_figures,
        )
    ],
)


def _scored(workspace: Workspace, name: str) -> "tuple[pd.DataFrame, pd.DataFrame]":
    """Return all METRICS rows of the pairs, and the VERDICTS rows from which they are made, without arms."""
    from traps_pipeline.storage.benchmark_tables import current_rows

    cells = workspace.tables.read_all(METRICS, dataset=DATASETS)
    if cells.empty:
        raise TrapsError(f"{name}: no metrics yet; materialize metrics for a dataset first")
    return cells, current_rows(workspace, VERDICTS)


def _make_contrasts(workspace: Workspace, _: None) -> StageOutput:
    """Return paired differences between models and between regimes, with intervals and Holm's correction."""
    from traps_pipeline.scoring.bootstrap import resample
    from traps_pipeline.scoring.contrasts import contrasts as paired

    cells, judged = _scored(workspace, "contrasts")
    table = paired(resample(judged), cells, judged)
    separable, refused = table["separable"].to_numpy(bool, na_value=False), len(table.loc[table["refused"].notna()])
    separable_overall = table.loc[separable & (table["dataset"] == "overall")]
    figures = {"contrasts": rows_shown(separable_overall), "separable": int(separable.sum()), "refused": refused}
    return StageOutput(table, shown=figures)


def _make_regime_tests(workspace: Workspace, _: None) -> StageOutput:
    """Return McNemar's exact test of any two regimes on the same items, by model, dataset, run and decision."""
    from traps_pipeline.scoring.contrasts import regime_tests as mcnemar

    return made_of("regime tests", REGIME_TESTS, mcnemar(_scored(workspace, "regime_tests")[1]))


def _make_leaderboard(workspace: Workspace, _: None) -> StageOutput:
    """Return every model under every regime, per dataset and overall: mean and spread over runs, 95 % intervals,
    ranks.
    """
    from traps_pipeline.report.leaderboard_page import leaderboard_markdown
    from traps_pipeline.scoring.bootstrap import intervals, resample
    from traps_pipeline.scoring.standings import leaderboard as rank

    cells, judged = _scored(workspace, "leaderboard")
    board = rank(cells, intervals(resample(judged)), workspace.tables.read(CONTRASTS, {}))
    overall = board.loc[board["dataset"] == "overall", "pecs"].to_numpy(float)
    best = {"best overall PECS": float(overall.max())} if len(overall) else {}
    return StageOutput(board, shown={"leaderboard": Markdown(leaderboard_markdown(board))} | best)


def _wrong_intervals(workspace: Workspace, key: str | None, output: StageOutput) -> str:
    from traps_pipeline.scoring.standings import wrong_intervals

    wrong = wrong_intervals(output.frame)
    return f"{wrong} intervals are wrong" if wrong else ""


def _make_robust(workspace: Workspace, _: None) -> StageOutput:
    """Return conjunction, robust figure and inference of every model and regime with all four datasets and an arm;
    empty if no arm was run."""
    from traps_pipeline.scoring.robust import robust as without_shortcuts
    from traps_pipeline.storage.benchmark_tables import current_rows

    judged = current_rows(workspace, VERDICTS, dataset=(*DATASETS, *ARMS))
    if judged.empty:
        raise TrapsError("robust: no verdicts yet; materialize verdicts for a cell first")
    return made_of("conjunction", ROBUST, without_shortcuts(judged))


def _wrong_robust(workspace: Workspace, key: str | None, output: StageOutput) -> str:
    from traps_pipeline.scoring.robust import wrong_rows

    wrong = wrong_rows(output.frame)
    return f"{wrong} rows are wrong" if wrong else ""


def _make_hypotheses(workspace: Workspace, _: None) -> StageOutput:
    """Abstention and accuracy as one thing of the pairs is changed step by step, beside what rules get; empty if no
    variation was run."""
    from traps_pipeline.scoring.doses import DATASETS_READ
    from traps_pipeline.scoring.doses import hypotheses as by_dose
    from traps_pipeline.storage.benchmark_tables import ITEMS, current_rows

    judged = current_rows(workspace, VERDICTS, dataset=DATASETS_READ)
    items = workspace.tables.read_all(ITEMS, ["item_id", "labels"], dataset=DATASETS_READ)
    offered = {str(id_): len(labels) for id_, labels in zip(items["item_id"], items["labels"], strict=True)}
    return made_of("doses", HYPOTHESES, by_dose(judged, offered))


def _wrong_doses(workspace: Workspace, key: str | None, output: StageOutput) -> str:
    from traps_pipeline.scoring.doses import wrong_rows

    wrong = wrong_rows(output.frame)
    return f"{wrong} rows are wrong" if wrong else ""


# The panel is an input of all that is counted from its verdicts: after a change of it they are stale at once, and not
# only when its votes are made again.
_SCORED = (of(metrics, need="some"), of(verdicts, need="some"), judges)
contrasts = stage(CONTRASTS, _make_contrasts, group=GROUP, parents=_SCORED)
regime_tests = stage(REGIME_TESTS, _make_regime_tests, group=GROUP, parents=_SCORED)
leaderboard = stage(
    LEADERBOARD,
    _make_leaderboard,
    group=GROUP,
    parents=[*_SCORED, contrasts],
    checks=[
        Check(
            "intervals_ordered",
            "Every interval is ordered and lies in [0, 1], or for J in [-1, 1].",
            _wrong_intervals,
        )
    ],
)
robust = stage(
    ROBUST,
    _make_robust,
    group=GROUP,
    parents=_SCORED,
    checks=[
        Check(
            "robust_rows_hold",
            "Figures lie in [0, 1] and in their intervals.",
            _wrong_robust,
        )
    ],
)
hypotheses = stage(
    HYPOTHESES,
    _make_hypotheses,
    group=GROUP,
    parents=[of(items, need="some"), *_SCORED],
    checks=[
        Check(
            "doses_hold",
            "Shares lie in [0, 1], J in [-1, 1], changes in [-2, 2], and intervals are ordered.",
            _wrong_doses,
        )
    ],
)
