"""Declare the scoring group: metrics of cells, contrasts, the leaderboard."""

import json
from collections.abc import Callable
from functools import partial
from importlib import import_module
from typing import TYPE_CHECKING

from traps_pipeline.base.errors import TrapsError
from traps_pipeline.judging.judging_rows import VERDICTS, VOTES
from traps_pipeline.pipeline.graph import Check
from traps_pipeline.pipeline.previews import Markdown, rows_shown
from traps_pipeline.pipeline.schemes import DATASET, by_dataset
from traps_pipeline.pipeline.stage import SHARED_IN_RUN, dep, is_declared, stage
from traps_pipeline.pipeline.stages.benchmark_stages import arms, items
from traps_pipeline.pipeline.stages.evaluation_stages import judges, responses, verdicts, votes
from traps_pipeline.pipeline.wanted import StudyPartitions
from traps_pipeline.protocol.datasets import DATASETS, GRADED, INFERENCE_ARMS, TWO_EVENTS
from traps_pipeline.scoring.score_rows import (
    CONTRASTS,
    GRADED_CUTS,
    HYPOTHESES,
    LEADERBOARD,
    METRICS,
    REGIME_TESTS,
    TWO_WAY,
)
from traps_pipeline.storage.benchmark_tables import ITEMS, current_rows
from traps_pipeline.storage.parquet import StageOutput
from traps_pipeline.storage.workspace import Workspace

if TYPE_CHECKING:
    import pandas as pd

    from traps_pipeline.scoring.bootstrap import ResampledMetrics

_stage = partial(stage, group="scoring")


def has_pairs(partitions: StudyPartitions, key: str | None) -> bool:
    """Return whether the study evaluates pairs."""
    return partitions.has_pairs


def _zero_check(find: str, noun: str) -> Callable[[Workspace, str | None, StageOutput], str]:
    """Return a check that `find` (a module.function of `scoring`) counts no wrong row."""

    def wrong(workspace: Workspace, key: str | None, output: StageOutput) -> str:
        module, _, name = find.partition(".")
        count = getattr(import_module(f"traps_pipeline.scoring.{module}"), name)(output.frame)
        return f"wrong {noun}: {count:,}" if count else ""

    return wrong


@_stage(
    METRICS,
    parents=[items, dep(verdicts, by_dataset, need="some"), judges],
    scheme=DATASET,
    checks=[
        Check(
            "shares_are_shares",
            "Acc, AbsRec and FalseAbs lie in [0, 1], PECS is Acc x max(0, J) and lies within its bounds.",
            _zero_check("metrics.wrong_metrics", "metrics"),
        )
    ],
)
def metrics(workspace: Workspace, dataset: str) -> StageOutput:
    """Return Acc, FalseAbs, AbsRec, J and PECS of a dataset, by cell and scope."""
    from traps_pipeline.scoring.metrics import cell_metrics

    judged = current_rows(workspace, VERDICTS, dataset=dataset)
    if judged.empty and len(workspace.tables.read_all(ITEMS, ["item_id"], dataset=dataset)):
        raise TrapsError(f"metrics {dataset}: no verdicts yet; materialize verdicts for a cell of this dataset first")
    return StageOutput(cell_metrics(judged))


def _metrics_and_verdicts(workspace: Workspace, name: str) -> "tuple[pd.DataFrame, pd.DataFrame]":
    """Return METRICS rows of the pairs, without arms, and their VERDICTS rows."""
    cells = workspace.tables.read_all(METRICS, dataset=DATASETS)
    if cells.empty:
        raise TrapsError(f"{name}: no metrics yet; materialize metrics for a dataset first")
    return cells, current_rows(workspace, VERDICTS)


def _bootstrap_of(judged: "pd.DataFrame") -> "ResampledMetrics":
    """Return the bootstrap of verdicts, which one run needs twice: for the contrasts, then for the leaderboard."""
    from traps_pipeline.scoring.bootstrap import resample

    rows, resampled = SHARED_IN_RUN.pop("bootstrap", (None, None))  # after the second time the memory is free again
    if rows is None or not rows.equals(judged):
        resampled = resample(judged)
        SHARED_IN_RUN["bootstrap"] = judged, resampled
    return resampled


# The panel is an input of everything computed from its verdicts, so that a change of panel makes them stale at once,
# not only after the new votes.
_SCORED = (dep(metrics, need="some"), dep(verdicts, need="some"), judges)


@_stage(CONTRASTS, parents=_SCORED, wants=has_pairs)
def contrasts(workspace: Workspace, _: None) -> StageOutput:
    """Return paired differences of models and regimes, with intervals and Holm's p."""
    from traps_pipeline.scoring.contrasts import contrasts as paired

    cells, judged = _metrics_and_verdicts(workspace, "contrasts")
    table = paired(_bootstrap_of(judged), cells, judged)
    separable, n_refused = table["separable"].to_numpy(bool, na_value=False), len(table.loc[table["refused"].notna()])
    separable_overall = table.loc[separable & (table["dataset"] == "overall")]
    shown = {"contrasts": rows_shown(separable_overall), "separable": int(separable.sum()), "refused": n_refused}
    return StageOutput(table, shown=shown)


@_stage(REGIME_TESTS, parents=_SCORED, wants=has_pairs)
def regime_tests(workspace: Workspace, _: None) -> "pd.DataFrame":
    """Return McNemar's exact test of two regimes, by dataset, model, run and decision."""
    from traps_pipeline.scoring.contrasts import regime_tests as mcnemar

    return mcnemar(_metrics_and_verdicts(workspace, "regime_tests")[1])


@_stage(
    LEADERBOARD,
    parents=[*_SCORED, contrasts],
    checks=[
        Check(
            "intervals_ordered",
            "Every interval is ordered and lies in [0, 1], or for J in [-1, 1].",
            _zero_check("standings.wrong_intervals", "intervals"),
        )
    ],
    wants=has_pairs,
)
def leaderboard(workspace: Workspace, _: None) -> StageOutput:
    """Return means, spreads, 95 % intervals and ranks by model, regime and dataset."""
    from traps_pipeline.report.leaderboard_page import leaderboard_markdown
    from traps_pipeline.scoring.bootstrap import intervals
    from traps_pipeline.scoring.standings import leaderboard as rank

    cells, judged = _metrics_and_verdicts(workspace, "leaderboard")
    board = rank(cells, intervals(_bootstrap_of(judged)), workspace.tables.read(CONTRASTS, {}))
    overall = board.loc[board["dataset"] == "overall", "pecs"].to_numpy(float)
    best = {"best overall PECS": float(overall.max())} if len(overall) else {}
    return StageOutput(board, shown={"leaderboard": Markdown(leaderboard_markdown(board))} | best)


@_stage(
    TWO_WAY,
    parents=[dep(verdicts, need="some"), judges],
    checks=[
        Check(
            "two_way_rows_hold",
            "Shares lie in [0, 1], effects in [-1, 1], and each metric in its interval.",
            _zero_check("two_way.wrong_rows", "rows"),
        )
    ],
)
def two_way(workspace: Workspace, _: None) -> "pd.DataFrame":
    """Return by model and regime how far abstention follows the asked event, or the other one.

    The table is empty if no two events, and nothing that must be inferred, were asked.
    """
    from traps_pipeline.scoring.two_way import two_way as by_event

    return by_event(current_rows(workspace, VERDICTS, dataset=(TWO_EVENTS, *INFERENCE_ARMS)))


@_stage(
    HYPOTHESES,
    parents=[dep(items, need="some"), *_SCORED],
    checks=[
        Check(
            "doses_hold",
            "Shares lie in [0, 1], J in [-1, 1], changes in [-2, 2], and intervals are ordered.",
            _zero_check("doses.wrong_rows", "rows"),
        )
    ],
)
def hypotheses(workspace: Workspace, _: None) -> "pd.DataFrame":
    """Return abstention and accuracy by steps of one property, beside shortcut rules.

    The table is empty if no variation was run.
    """
    from traps_pipeline.scoring.doses import DATASETS_READ
    from traps_pipeline.scoring.doses import hypotheses as by_dose

    judged = current_rows(workspace, VERDICTS, dataset=DATASETS_READ)
    rows = workspace.tables.read_all(ITEMS, ["item_id", "labels"], dataset=DATASETS_READ)
    n_labels = {str(id_): len(labels) for id_, labels in zip(rows["item_id"], rows["labels"], strict=True)}
    return by_dose(judged, n_labels)


@_stage(
    GRADED_CUTS,
    parents=[
        *([dep(arms, need="none")] if is_declared("arms") else []),
        *(dep(parent, need="some") for parent in (items, responses, votes, verdicts)),
        judges,
    ],
    checks=[
        Check(
            "graded_rows_hold",
            "Metrics lie in their limits and intervals; regret is the sum of its parts, and what the ideal earns more.",
            _zero_check("graded.wrong_rows", "rows"),
        )
    ],
)
def graded(workspace: Workspace, _: None) -> "pd.DataFrame":
    """Return the points that models earn on graded cuts, by the true distribution over answers.

    The table is empty if no graded cut was run.
    """
    from traps_pipeline.models.asking.answer_rows import RESPONSES
    from traps_pipeline.scoring.graded import GradedItem
    from traps_pipeline.scoring.graded import graded as against_posterior
    from traps_pipeline.storage.posteriors import posteriors

    posterior_of = posteriors(workspace)
    questions = {
        row["item_id"]: GradedItem(
            [*row["labels"]],
            json.loads(row["aliases"]),
            row["answer_type"],
            row["commonest_answer"],
            posterior_of[row["scenario_id"]],
        )
        for row in workspace.tables.read_all(ITEMS, dataset=GRADED).to_dict("records")
    }
    verdicts, votes, responses = (
        current_rows(workspace, table, dataset=GRADED) for table in (VERDICTS, VOTES, RESPONSES)
    )
    return against_posterior(verdicts, votes, responses, questions)
