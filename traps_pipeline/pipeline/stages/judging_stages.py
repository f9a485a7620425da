"""Declare judging: panel agreement, judge bias, confabulation in void failures."""

from functools import partial
from typing import TYPE_CHECKING

from traps_pipeline.base.errors import TrapsError
from traps_pipeline.base.wording import count_noun, in_percent
from traps_pipeline.judging.confabulation_protocol import load_protocol, protocol_digest
from traps_pipeline.judging.judging_rows import AGREEMENT, CONFABULATION, JUDGE_BIAS, JUDGE_VALIDATION, VERDICTS, VOTES
from traps_pipeline.models.registry.judges import load_panel, panel_id
from traps_pipeline.pipeline.graph import Check
from traps_pipeline.pipeline.schemes import CELL, these_keys
from traps_pipeline.pipeline.stage import dep, source, stage
from traps_pipeline.pipeline.stages.benchmark_stages import items
from traps_pipeline.pipeline.stages.evaluation_stages import MAX_INVALID_SHARE, judges, responses, verdicts, votes
from traps_pipeline.pipeline.stages.scoring_stages import has_pairs, leaderboard
from traps_pipeline.protocol.ratings import VOTE_COLUMNS
from traps_pipeline.scoring.score_rows import CONFABULATION_PREVALENCE, LEADERBOARD, LEAVE_ONE_OUT
from traps_pipeline.storage.benchmark_tables import current_rows
from traps_pipeline.storage.parquet import StageOutput
from traps_pipeline.storage.workspace import Workspace

if TYPE_CHECKING:
    import pandas as pd

_stage, _source = partial(stage, group="judging"), partial(source, group="judging")


@_source(kinds=["yaml"])
def confabulation_protocol(workspace: Workspace, _: None) -> str:
    """Return the version of the confabulation protocol.

    assets/confabulation.yaml and its prompt name the models whose failures are sampled, and the judge that labels.
    """
    return protocol_digest(workspace.study.panel)


@_source(kinds=["parquet"])
def judge_validation(workspace: Workspace, _: None) -> str:
    """Return the version of the judge's comparison with two annotators. `traps people validate` writes it."""
    state = workspace.tables.state(JUDGE_VALIDATION, {})
    return state.version if state else "not run"


def _panel(workspace: Workspace) -> list[str]:
    return [judge.id for judge in load_panel(workspace.study.panel)]


def _votes(workspace: Workspace, name: str) -> "pd.DataFrame":
    """Return votes of the study's current panel. Raises TrapsError without any."""
    cast = current_rows(workspace, VOTES, [*VOTE_COLUMNS, "panel"])
    cast = cast.loc[cast["panel"] == panel_id(workspace.study.panel)]
    if cast.empty:
        raise TrapsError(f"{name}: no votes yet; materialize votes for a cell first")
    return cast


_VOTED = (dep(items, need="some"), dep(votes, need="some"), judges)


@_stage(AGREEMENT, parents=_VOTED, wants=has_pairs)
def agreement(workspace: Workspace, _: None) -> "pd.DataFrame":
    """Return agreement (unanimity, Fleiss, Cohen, Krippendorff) by dataset and task."""
    from traps_pipeline.judging.agreement import agreement as rows_of

    return rows_of(_votes(workspace, "agreement"), _panel(workspace))


@_stage(JUDGE_BIAS, parents=_VOTED, wants=has_pairs)
def judge_bias(workspace: Workspace, _: None) -> "pd.DataFrame":
    """Return each judge's rate of yes against the majority, by dataset and task."""
    from traps_pipeline.judging.agreement import judge_bias as rows_of

    return rows_of(_votes(workspace, "judge_bias"), _panel(workspace))


@_stage(LEAVE_ONE_OUT, parents=[*_VOTED, dep(verdicts, need="some"), leaderboard], wants=has_pairs)
def leave_one_out(workspace: Workspace, _: None) -> "pd.DataFrame":
    """Return PECS by the votes of two judges, for each judge left out."""
    from traps_pipeline.scoring.leave_one_out import leave_one_out as rows_of

    cast, board = _votes(workspace, "leave_one_out"), workspace.tables.read(LEADERBOARD, {})
    return rows_of(current_rows(workspace, VERDICTS), cast, board, _panel(workspace))


def _excess_of_invalid(workspace: Workspace, key: str | None, output: StageOutput) -> str:
    labels = output.rows(CONFABULATION)
    invalid = sum(not label.valid for label in labels)
    is_too_many = invalid > MAX_INVALID_SHARE * len(labels)
    return f"invalid: {invalid:,} of {count_noun(len(labels), 'label')}" if is_too_many else ""


_SAMPLED = these_keys(CELL, [c.key for m in load_protocol().models for c in load_protocol().cells(m)])


@_stage(
    CONFABULATION,
    parents=[
        dep(items, need="none"),
        dep(responses, _SAMPLED, need="none"),
        dep(verdicts, _SAMPLED, need="none"),
        confabulation_protocol,
    ],
    code="4",
    cost="money",
    checks=[
        Check(
            "few_invalid_labels",
            f"At most {in_percent(MAX_INVALID_SHARE)} of the labels break the schema.",
            _excess_of_invalid,
            blocks=False,
        )
    ],
)
def confabulation(workspace: Workspace, _: None) -> StageOutput:
    """Return void failures labelled on four axes by the panel's judge, if it has one."""
    from traps_pipeline.judging.confabulation import collect_labels

    return collect_labels(workspace)


@_stage(CONFABULATION_PREVALENCE, parents=[confabulation])
def confabulation_prevalence(workspace: Workspace, _: None) -> "pd.DataFrame":
    """Return how often each axis applies to a model's sampled void failures."""
    from traps_pipeline.scoring.prevalence import prevalence

    return prevalence(workspace.tables.read(CONFABULATION, {}))
