"""The responses stage: from the items of a cell to its table, one row an item."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from functools import cache
from typing import Any

from traps_pipeline.models.ask import Participants, Row, Work, run_work
from traps_pipeline.models.backends import make_backend
from traps_pipeline.models.prompts import system_prompt
from traps_pipeline.models.registry import ModelEntry, get_model, load_models
from traps_pipeline.models.request import Request
from traps_pipeline.partitions import Cell, Evaluation
from traps_pipeline.progress import Tally
from traps_pipeline.storage.workspace import Workspace
from traps_pipeline.tables import ITEMS, RESPONSES


@dataclass(frozen=True)
class FinishedCell:
    """A cell whose table is written: its data version and what it took."""

    cell: Cell
    version: str
    rows: int
    tally: Tally


def answer_request(workspace: Workspace, entry: ModelEntry, item: Mapping[str, Any], evaluation: Evaluation) -> Request:
    """The call that puts an item to a model: frames or video, then the question, nothing else."""
    return Request(
        participant=entry.id,
        endpoint=entry.backend,
        params=entry.params,
        system=system_prompt(evaluation.regime),
        user=item["question"],
        about={"item_id": item["item_id"], "model": entry.id, "regime": evaluation.regime, "run": evaluation.run},
        media=workspace.resolve(item["clip"]),
        media_digest=item["media_digest"],
        secret=_secret(entry, item) if entry.backend == "reference" else {},
    )


def _secret(entry: ModelEntry, item: Mapping[str, Any]) -> dict[str, Any]:
    """What reference strategies may read: side, labels, on a control its ground truth; the sub-scenario's commonest
    answer goes to `prior` alone, so that a corrected answer which changes it re-asks no other model."""
    secret: dict[str, Any] = {"side": item["side"], "labels": list(item["labels"])}
    if item["side"] == "control":
        secret["ground_truth"] = item["ground_truth"]
    if entry.params["strategy"] == "prior":
        secret["commonest_answer"] = item["commonest_answer"]
    return secret


def response_row(cell: Cell, item: Mapping[str, Any], key: str, row: Row, reasoning: str | None) -> dict[str, Any]:
    """One row of the responses table."""
    copied = ("outcome", "text", "finish_reason", "error", "served_model", "prompt_tokens", "completion_tokens")
    copied += ("reasoning_tokens", "cost_usd", "latency_s", "attempts", "epoch")
    return {
        **{name: item[name] for name in ("item_id", "pair_id", "side", "benchmark_version")},
        **cell.partition,
        **{name: row[name] for name in copied},
        "reasoning": reasoning,
        "request_key": key,
        "created_at": datetime.fromisoformat(row["created_at"]),
    }


def collect_answers(
    workspace: Workspace, cells: Sequence[Cell], inputs: Mapping[str, Mapping[str, str]]
) -> Iterator[FinishedCell]:
    """Ask what is missing and write the table of each cell; `inputs` are the input versions by cell key."""

    @cache
    def items(dataset: str) -> list[dict[str, Any]]:
        return workspace.tables.read(ITEMS, {"dataset": dataset}).to_dict("records")

    def requests(cell: Cell) -> list[Request]:
        entry = get_model(cell.evaluation.model)
        return [answer_request(workspace, entry, item, cell.evaluation) for item in items(cell.dataset)]

    def finish(cell: Cell, rows: Mapping[str, Row], tally: Tally) -> FinishedCell:
        traces = workspace.answers.reasoning(cell.evaluation.key)
        keyed = zip(items(cell.dataset), requests(cell), strict=True)
        table = [response_row(cell, item, r.key, rows[r.key], traces.get(r.key)) for item, r in keyed]
        version = workspace.tables.write(RESPONSES, cell.partition, table, inputs[cell.key], failed=tally.errors)
        return FinishedCell(cell, version, len(table), tally)

    entries = {entry.id: (entry.backend, entry.limits) for entry in load_models().values()}
    work = Work(
        "responses", workspace.answers, Participants(entries, make_backend), workspace.study.epoch, requests, finish
    )
    yield from run_work(work, cells)
