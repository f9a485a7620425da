"""Explain which answers to an item are valid and which are stale (`traps why`)."""

import json
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from traps_pipeline.base.errors import TrapsError
from traps_pipeline.base.suggestions import did_you_mean
from traps_pipeline.base.wording import count_noun
from traps_pipeline.judging.judging_rows import VOTES
from traps_pipeline.models.asking.answer_rows import RESPONSES
from traps_pipeline.models.asking.answers import answer_request, with_posteriors
from traps_pipeline.models.registry.entries import load_models
from traps_pipeline.protocol.cells import Cell, Evaluation
from traps_pipeline.protocol.regimes import REGIMES
from traps_pipeline.storage.benchmark_tables import ITEMS
from traps_pipeline.storage.tables import Table
from traps_pipeline.storage.workspace import Workspace

# Without the times of calls, for which pyarrow would import pandas.
_OF_ANSWER = ("item_id", "text", "fragment", "error", "outcome")
_OF_VOTE = ("item_id", "task", "abstained", "correct", "valid", "judge", "rationale", "invalid_reason")


def explain_item(workspace: Workspace, item_id: str) -> dict[str, Any]:
    """Return an item's question, clip if it is current, and the state of its answers, as JSON values.

    For every evaluation that has asked it: whether its answer is valid or which component of the key changed, with the
    answer and its votes. Raises TrapsError for an unknown item.
    """
    dataset = item_id.split(":")[0]
    current = _current_item(workspace, dataset, item_id)
    explanation: dict[str, Any] = {"item": item_id, "evaluations": []}
    if current is not None:
        truth = current["ground_truth"] if current["side"] == "control" else "none, it is void"
        clip = str(workspace.resolve(current["clip"]))
        explanation |= {"question": current["question"], "ground_truth": truth, "clip": clip}
    rows_by_evaluation = workspace.answers.naming(item_id)
    for model, entry in load_models().items():
        for regime in REGIMES:
            for run in range(1, entry.runs + 1):
                evaluation = Evaluation(model, regime, run)
                if evaluation.key not in rows_by_evaluation:
                    continue
                all_rows = rows_by_evaluation[evaluation.key].rows.values()
                rows = [row for row in all_rows if row["components"]["about"]["item_id"] == item_id]
                if not rows:
                    continue
                request = answer_request(workspace, entry, current, evaluation) if current else None
                cell = Cell(dataset, evaluation)
                explanation["evaluations"].append(
                    {
                        "evaluation": evaluation.key,
                        "state": _state(rows, request.components if request else None),
                        "answers": _rows_of(workspace, RESPONSES, _OF_ANSWER, cell, item_id),
                        "votes": _rows_of(workspace, VOTES, _OF_VOTE, cell, item_id),
                    }
                )
    if current is None and not explanation["evaluations"]:
        raise TrapsError(_unknown_reason(workspace, item_id))
    return explanation


def lines_of(explanation: Mapping[str, Any]) -> Iterator[str]:
    """Yield the lines of text that print an explanation."""
    if "question" in explanation:
        yield f"question: {explanation['question']}"
        yield f"ground truth: {explanation['ground_truth']}"
        yield f"clip: {explanation['clip']}"
    for evaluation in explanation["evaluations"]:
        yield f"{evaluation['evaluation']}: {evaluation['state']}"
        for answer in evaluation["answers"]:
            yield f"    {answer['outcome']}: {_short(answer['text']) if answer['text'] else answer['error'] or ''}"
            yield from [f"        it began: {_short(answer['fragment'])}"] if answer["fragment"] else []
        for vote in evaluation["votes"]:
            decision = vote["abstained"] if vote["task"] == "abstention" else vote["correct"]
            word = "invalid" if not vote["valid"] else "yes" if decision else "no"
            yield f"    {vote['judge']} on {vote['task']}: {word} ({vote['rationale'] or vote['invalid_reason']})"
    if not explanation["evaluations"]:
        yield "no model has been asked this item"


def _unknown_reason(workspace: Workspace, item_id: str) -> str:
    item_ids = workspace.tables.read_all(ITEMS, ["item_id"])["item_id"]
    if item_ids.empty:
        return f"item {item_id!r} is unknown: this study has no items yet; `traps run EXPERIMENT` makes them"
    form = "; an item is dataset:scenario:side, e.g. occlusion:domino_chain-0001:void"
    return f"item {item_id!r} is unknown{did_you_mean(item_id, item_ids) or form}"


def _rows_of(
    workspace: Workspace, table: Table, columns: Sequence[str], cell: Cell, item_id: str
) -> list[dict[str, Any]]:
    if workspace.tables.state(table, cell.partition) is None:
        return []
    return _rows_about(workspace, table, cell.partition, item_id, columns)


def _rows_about(
    workspace: Workspace, table: Table, partition: Mapping[str, Any], item_id: str, columns: Sequence[str] | None = None
) -> list[dict[str, Any]]:
    """Return an item's rows; only these become Python values."""
    data = workspace.tables.read_arrow(table, columns, **partition)
    places = [place for place, name in enumerate(data["item_id"].to_pylist()) if name == item_id]
    return [row for place in places for row in data.slice(place, 1).to_pylist()]


def _current_item(workspace: Workspace, dataset: str, item_id: str) -> dict[str, Any] | None:
    if workspace.tables.state(ITEMS, {"dataset": dataset}) is None:
        return None
    rows = _rows_about(workspace, ITEMS, {"dataset": dataset}, item_id)
    return next(iter(with_posteriors(workspace, dataset, rows)), None)


def _state(rows: list[dict[str, Any]], wanted: Mapping[str, Any] | None) -> str:
    newest_row = max(rows, key=lambda row: row["created_at"])
    if wanted is None:
        times = count_noun(len(rows), "time")
        return f"asked {times}; the item is no longer in the benchmark, its answers stay in the ledger"
    for row in rows:
        if row["components"] == dict(wanted):
            return f"answered {row['created_at'][:19]} ({row['outcome']}), key {row['key'][:12]}: still stands"
    old = newest_row["components"]
    changed_parts = [name for name in sorted(old.keys() | wanted.keys()) if old.get(name) != wanted.get(name)]
    parts = [f"{name}: {_short(old.get(name))} -> {_short(wanted.get(name))}" for name in changed_parts]
    return f"will be asked again; changed since {newest_row['created_at'][:19]}: {'; '.join(parts)}"


def _short(value: Any) -> str:
    text = value if isinstance(value, str) else json.dumps(value, ensure_ascii=False)
    return repr(text if len(text) <= 160 else text[:157] + "...")
