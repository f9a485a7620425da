"""Turn a cell's items into the rows of its table of responses, one per item."""

from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

from traps_pipeline.base import progress
from traps_pipeline.base.cores import cores
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.models.asking.answer_rows import ResponseRow
from traps_pipeline.models.asking.ask import Call, SettledCell, collect_outcomes
from traps_pipeline.models.asking.participants import Row, call_time_columns
from traps_pipeline.models.framing import media_for_dataset
from traps_pipeline.models.reading.interpret import read_answer
from traps_pipeline.models.registry.entries import ModelEntry, effective_params, get_model
from traps_pipeline.models.registry.prompts import system_prompt
from traps_pipeline.models.request import Request
from traps_pipeline.protocol.cells import Cell, Evaluation
from traps_pipeline.protocol.datasets import GRADED, dataset_of
from traps_pipeline.storage.benchmark_tables import ITEMS
from traps_pipeline.storage.media import MediaSpec
from traps_pipeline.storage.parquet import StageOutput
from traps_pipeline.storage.posteriors import posteriors
from traps_pipeline.storage.workspace import Workspace

# The columns of an item that requests, responses and votes use.
_ITEM_COLUMNS = ("item_id", "pair_id", "side", "labels", "question", "ground_truth", "commonest_answer", "clip")
_ITEM_COLUMNS += ("media_digest", "benchmark_version", "aliases", "answer_type")


@dataclass(frozen=True)
class Question(Call):
    """The call that asks a model about an item."""

    item: Mapping[str, Any]


def answer_request(workspace: Workspace, entry: ModelEntry, item: Mapping[str, Any], evaluation: Evaluation) -> Request:
    """Return the call about an item; its media are prepared if missing, for every regime and run."""
    clip, dataset = workspace.resolve(item["clip"]), dataset_of(item["item_id"])
    spec = media_for_dataset(entry.media, dataset) if entry.media else None
    media = workspace.media.prepare(clip, item["media_digest"], spec) if spec else None
    return Request(
        participant=entry.id,
        endpoint=entry.endpoint,
        params=effective_params(entry, evaluation.regime, dataset),
        system=system_prompt(evaluation.regime, dataset),
        user=item["question"],
        about={"item_id": item["item_id"], "model": entry.id, "regime": evaluation.regime, "run": evaluation.run},
        media=clip,
        sent=media,
        media_digest=media.sha256 if media else item["media_digest"],
        secret=_secret(entry, item),
    )


def is_prepared(workspace: Workspace, entry: ModelEntry, item: Mapping[str, Any]) -> bool:
    """Return whether the media of an item's clip are prepared for this model."""
    spec = media_for_dataset(entry.media, dataset_of(item["item_id"])) if entry.media else None
    return spec is None or workspace.media.known(item["media_digest"], spec) is not None


def prepare_media(workspace: Workspace, cells: Sequence[Cell]) -> None:
    """Prepare all clips' media on all cores first, as encoding would delay calls."""
    jobs: dict[tuple[str, str], tuple[Path, str, MediaSpec]] = {}
    for dataset, media in {(cell.dataset, get_model(cell.evaluation.model).media) for cell in cells}:
        if media is None:
            continue
        spec = media_for_dataset(media, dataset)
        items = [*asked_items(workspace, dataset)]
        workspace.bring(item["clip"] for item in items)
        for item in items:
            jobs[item["media_digest"], repr(spec)] = (workspace.root / item["clip"], item["media_digest"], spec)
    with ThreadPoolExecutor(cores()) as pool:
        for n_finished, _ in enumerate(pool.map(lambda job: workspace.media.prepare(*job), jobs.values()), start=1):
            progress.current().tick("responses", "media to send", n_finished, len(jobs))


def wanted_questions(workspace: Workspace, cell: Cell) -> list[Question]:
    """Return the calls that ask a model about a cell's items, in order. Raises TrapsError without items."""
    entry = get_model(cell.evaluation.model)
    items = asked_items(workspace, cell.dataset)
    if not items and not workspace.tables.state(ITEMS, {"dataset": cell.dataset}):  # a held-out set may have none of it
        raise TrapsError(f"items {cell.dataset}: not made yet; materialize scene_specs, videos and items first")
    return [Question(answer_request(workspace, entry, item, cell.evaluation), item) for item in items]


def asked_items(workspace: Workspace, dataset: str) -> list[dict[str, Any]]:
    """Return a cell's items, in order, with the columns that requests, responses and votes use."""
    state = workspace.tables.state(ITEMS, {"dataset": dataset})
    return with_posteriors(workspace, dataset, _item_rows(workspace, dataset, state.version if state else ""))


@lru_cache(maxsize=1)  # a dataset's cells follow one another
def _item_rows(workspace: Workspace, dataset: str, version: str) -> list[dict[str, Any]]:
    """Return the items of one version of a dataset; equal texts share one copy."""
    copies: dict[str, str] = {}
    rows = workspace.tables.read_all(ITEMS, _ITEM_COLUMNS, dataset=dataset).to_dict("records")
    return [
        {name: copies.setdefault(value, value) if isinstance(value, str) else value for name, value in row.items()}
        for row in rows
    ]


def with_posteriors(workspace: Workspace, dataset: str, items: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return items of graded cuts with `posterior`, which strategy `bayes` reads; other items unchanged."""
    if dataset != GRADED:
        return items
    posterior_of = posteriors(workspace)
    return [item | {"posterior": posterior_of[item["pair_id"].removeprefix(f"{GRADED}:")]} for item in items]


def _secret(entry: ModelEntry, item: Mapping[str, Any]) -> dict[str, Any]:
    """Return hidden facts for reference strategies, to each only those that it reads: other changes re-ask no model."""
    if entry.backend == "rule":
        return {"commonest_answer": item["commonest_answer"]}
    if entry.backend != "reference":
        return {}
    secret: dict[str, Any] = {"side": item["side"], "labels": list(item["labels"])}
    if item["side"] == "control":
        secret["ground_truth"] = item["ground_truth"]
    if entry.params["strategy"] == "prior":
        secret["commonest_answer"] = item["commonest_answer"]
    if entry.params["strategy"] == "bayes" and "posterior" in item:
        secret["posterior"] = item["posterior"]
    return secret


def response_row(cell: Cell, item: Mapping[str, Any], row: Row, reasoning: str | None) -> ResponseRow:
    """Return one row of the responses table."""
    entry, regime, dataset = get_model(cell.evaluation.model), cell.evaluation.regime, cell.dataset
    reading = read_answer(row, reasoning, regime, thinking=entry.thinking, dataset=dataset, max_tokens=entry.max_tokens)
    row_fields = ("finish_reason", "served_model", "client", "prompt_tokens", "completion_tokens")
    row_fields += ("reasoning_tokens", "cost_usd", "latency_s", "attempts")
    return ResponseRow(
        **{name: item[name] for name in ("item_id", "pair_id", "side", "benchmark_version")},
        **cell.partition,
        **{name: row[name] for name in row_fields},
        **call_time_columns(row),
        outcome=reading.outcome,
        text=reading.text,
        fragment=reading.fragment,
        reasoning=reading.reasoning,
        is_json=reading.is_json,
        first_token=row.get("first_token"),
        error=reading.why or row["error"],
        request_key=row["key"],
    )


def collect_answers(workspace: Workspace, cells: Sequence[Cell]) -> Iterator[tuple[Cell, StageOutput]]:
    """Ask for missing answers; yield the RESPONSES rows of each cell as it is done."""
    prepare_media(workspace, cells)

    def finish(settled: SettledCell[Cell, Question]) -> tuple[Cell, StageOutput]:
        traces = workspace.answers.reasoning(settled.cell.evaluation.key, settled.rows)
        return settled.output(
            lambda cell, question, row: response_row(cell, question.item, row, traces.get(row["key"]))
        )

    entries, calls = [get_model(cell.evaluation.model) for cell in cells], partial(wanted_questions, workspace)
    yield from collect_outcomes(workspace, "responses", workspace.answers, entries, cells, calls, finish)
