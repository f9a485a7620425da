"""Declare evaluation: answers, votes and verdicts by cell (dataset x evaluation)."""

from collections.abc import Iterator, Sequence
from functools import partial
from typing import Any, cast

from traps_pipeline.base.errors import TrapsError
from traps_pipeline.base.explorer_link import EXPLORER, answers_view
from traps_pipeline.base.wording import count_noun, in_percent
from traps_pipeline.judging.judging_rows import VERDICTS, VOTES, VoteRow
from traps_pipeline.models.asking.answer_rows import RESPONSES, ResponseRow
from traps_pipeline.models.reading.interpret import READING
from traps_pipeline.models.reading.judged_answers import UNREAD
from traps_pipeline.models.registry.entries import answering_version
from traps_pipeline.models.registry.judges import panel_version
from traps_pipeline.models.registry.prompts import prompt_version
from traps_pipeline.models.request import JUDGED_OUTCOMES
from traps_pipeline.pipeline.graph import Check
from traps_pipeline.pipeline.previews import Records, StudyFile
from traps_pipeline.pipeline.schemes import CELL, EVALUATION, by_dataset, by_evaluation
from traps_pipeline.pipeline.stage import dep, source, stage
from traps_pipeline.pipeline.stages.benchmark_stages import items
from traps_pipeline.protocol.cells import Cell, Evaluation
from traps_pipeline.storage.benchmark_tables import ITEMS
from traps_pipeline.storage.parquet import StageOutput
from traps_pipeline.storage.workspace import Workspace

MAX_INVALID_SHARE = 0.05
ITEMS_SHOWN = 40
DECIDED_AT_ONCE = 50  # cells whose votes are in memory together
_stage, _source = partial(stage, group="evaluation", scheme=CELL), partial(source, group="evaluation")


@_source(kinds=["yaml"], scheme=EVALUATION)
def models(workspace: Workspace, key: str) -> str:
    """Return the version of a model's settings in assets/models.yaml."""
    return answering_version(Evaluation.parse(key))


@_source(kinds=["text"], scheme=EVALUATION)
def prompts(workspace: Workspace, key: str) -> str:
    """Return the version of a regime's system prompt (assets/prompts)."""
    datasets = {d for experiment in workspace.study.experiments.values() for d in experiment.datasets}
    return prompt_version(Evaluation.parse(key).regime, datasets)


@_source(kinds=["yaml"])
def judges(workspace: Workspace, _: None) -> str:
    """Return the version of the panel: assets/judges.yaml and judges' prompts."""
    return panel_version(workspace.study.panel)


def _with_items(
    workspace: Workspace, cells: Iterator[tuple[Cell, StageOutput]]
) -> Iterator[tuple[str | None, StageOutput]]:
    """Add a cell's items to the metadata of its partition."""
    for cell, output in cells:
        items_shown = _items_shown(workspace, cell, cast(Sequence[ResponseRow | VoteRow], output.content))
        yield cell.key, StageOutput(output.content, output.tally, {**output.shown, **items_shown})


def _items_shown(workspace: Workspace, cell: Cell, rows: Sequence[ResponseRow | VoteRow]) -> dict[str, Any]:
    """Return metadata: items without an answer, and the explorer's view of all."""
    view = answers_view(dataset=cell.dataset, model=cell.evaluation.model, regime=cell.evaluation.regime)
    columns = ("item_id", "side", "outcome", "error", "attempts")
    unanswered = [row for row in rows if isinstance(row, ResponseRow) and row.outcome not in JUDGED_OUTCOMES]
    records = [{name: str(getattr(row, name)) for name in columns} for row in unanswered[:ITEMS_SHOWN]]
    table = {"without an answer": Records(records)} if records else {}
    reason = {"one item": f"traps why {rows[0].item_id}"} if rows else {}
    return {**table, "all items": StudyFile(workspace.relative(workspace.reports / EXPLORER), view), **reason}


def _answers_missing(workspace: Workspace, key: str | None, output: StageOutput) -> str:
    state = workspace.tables.state(ITEMS, {"dataset": Cell.parse(str(key)).dataset})
    n_items, n_rows = state.rows if state else 0, len(output.rows(RESPONSES))
    return "" if n_rows == n_items else f"{count_noun(n_rows, 'row')} for {count_noun(n_items, 'item')}"


@_stage(
    RESPONSES,
    parents=[dep(items, by_dataset), dep(models, by_evaluation), dep(prompts, by_evaluation)],
    code=f"3.{READING}",
    cost="money",
    checks=[Check("one_answer_an_item", "Every item of the cell has exactly one row.", _answers_missing)],
    side_by_side=True,
)
def responses(workspace: Workspace, keys: Sequence[str]) -> Iterator[tuple[str | None, StageOutput]]:
    """Return a model's answers under a regime in a run, one row per item. Answers in the ledger are reused."""
    from traps_pipeline.models.asking.answers import collect_answers

    return _with_items(workspace, collect_answers(workspace, [Cell.parse(key) for key in keys]))


def _excess_of_invalid(workspace: Workspace, key: str | None, output: StageOutput) -> str:
    cast_votes = output.rows(VOTES)
    invalid = sum(not vote.valid and vote.invalid_reason != UNREAD for vote in cast_votes)  # unread is counted apart
    is_too_many = invalid > MAX_INVALID_SHARE * len(cast_votes)
    return f"invalid: {invalid:,} of {count_noun(len(cast_votes), 'vote')}" if is_too_many else ""


@_stage(
    VOTES,
    parents=[dep(items, by_dataset), responses, judges],
    code="5",
    cost="money",
    checks=[
        Check(
            "few_invalid_votes",
            f"At most {in_percent(MAX_INVALID_SHARE)} of a cell's votes break the judges' schema.",
            _excess_of_invalid,
            blocks=False,
        )
    ],
    side_by_side=True,
)
def votes(workspace: Workspace, keys: Sequence[str]) -> Iterator[tuple[str | None, StageOutput]]:
    """Return the panel's votes on a cell's answers, a row per answer, judge and task."""
    from traps_pipeline.judging.panel import collect_votes

    return _with_items(workspace, collect_votes(workspace, [Cell.parse(key) for key in keys]))


def _verdicts_missing(workspace: Workspace, key: str | None, output: StageOutput) -> str:
    answers_state = workspace.tables.state(RESPONSES, Cell.parse(str(key)).partition)
    n_answers, n_verdicts = answers_state.rows if answers_state else 0, len(output.frame)
    return (
        "" if n_answers == n_verdicts else f"{count_noun(n_verdicts, 'verdict')} for {count_noun(n_answers, 'answer')}"
    )


@_stage(
    VERDICTS,
    parents=[dep(items, by_dataset), responses, votes, judges],
    code="4",
    checks=[Check("one_verdict_an_item", "Every answered item has exactly one verdict.", _verdicts_missing)],
    side_by_side=True,
)
def verdicts(workspace: Workspace, keys: Sequence[str]) -> Iterator[tuple[str | None, StageOutput | TrapsError]]:
    """Return the verdict of the panel's majority on each item of a cell."""
    from traps_pipeline.judging.verdicts import decide_cells

    for first in range(0, len(keys), DECIDED_AT_ONCE):
        cells = [Cell.parse(key) for key in keys[first : first + DECIDED_AT_ONCE]]
        for cell, rows in decide_cells(workspace, cells).items():
            if isinstance(rows, TrapsError):
                yield cell.key, rows
            else:
                yield cell.key, StageOutput(rows, shown={"undecided": int(rows["undecided"].to_numpy(bool).sum())})
