"""Label errors in answers that should be abstentions (docs/spec.md 6.1 and 6.2).

A seeded sample of each model's void failures goes to one judge, which labels four independent axes
(`scoring.prevalence` counts them). `assets/confabulation.yaml` names the models, the size of a sample and the judge. A
sample consists of the n failures with the smallest digests. It is uniform and independent between models, and a failure
that appears or disappears changes at most one member, so that nearly all paid labels are reused.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from pydantic import BaseModel, ConfigDict

from traps_pipeline.base import progress
from traps_pipeline.base.digests import digest
from traps_pipeline.base.progress import Tally
from traps_pipeline.judging.confabulation_protocol import (
    OUTPUT,
    SCHEMA,
    TASK,
    TRACE_AND_OUTPUT,
    VOID_KINDS,
    load_protocol,
)
from traps_pipeline.judging.judging_rows import CONFABULATION, VERDICTS, ConfabulationRow
from traps_pipeline.judging.panel import Flag, ask_judges, judge_request, parse_judgement, quote, vote_subject
from traps_pipeline.models.asking.answer_rows import RESPONSES
from traps_pipeline.models.asking.ask import Call, SettledCell
from traps_pipeline.models.asking.participants import Row, call_time_columns
from traps_pipeline.models.registry.judges import JudgeEntry, thinking_of
from traps_pipeline.models.registry.prompts import load_prompt
from traps_pipeline.models.request import Request
from traps_pipeline.protocol.cells import Cell
from traps_pipeline.protocol.datasets import is_ill_posed
from traps_pipeline.protocol.ratings import AXES
from traps_pipeline.storage.benchmark_tables import ITEMS
from traps_pipeline.storage.parquet import StageOutput
from traps_pipeline.storage.workspace import Workspace

MAX_TRACE = 400_000  # characters of a trace that the judge is shown


@dataclass(frozen=True)
class Failure(Call):
    """A void answer that should have been an abstention, sampled out of `n_failures`, and the judge's call on it."""

    item: Mapping[str, Any]
    text: str
    trace: str | None
    n_failures: int


def void_kind(dataset: str) -> str:
    """Return the reason why the voids of a dataset cannot be answered: a key of VOID_KINDS."""
    if is_ill_posed(dataset):
        return "question"
    return "occluder" if dataset == "occlusion" else "truncation"


def draw_sample(seed: int, n: int, keys: Iterable[tuple[str, str]]) -> list[tuple[str, str]]:
    """Return n keys (or all if fewer), drawn by the seed; the order of `keys` plays no part."""
    return sorted(keys, key=lambda key: digest([seed, *key]))[:n]


def sample_id(cell: Cell, item_id: str, answer: str | None, trace: str | None) -> str:
    """Return a failure's id for annotators: opaque, and new if the answer changes."""
    return digest([cell.key, item_id, answer, trace or None])[:12]


def sample_failures(workspace: Workspace, judge: JudgeEntry, model: str) -> dict[Cell, list[Failure]]:
    """Return the sample of a model's failures by cell; empty, with a note, while verdicts are missing."""
    protocol = load_protocol()
    cells = [cell for cell in protocol.cells(model) if workspace.tables.state(ITEMS, {"dataset": cell.dataset})]
    missing_keys = [cell.key for cell in cells if workspace.tables.state(VERDICTS, cell.partition) is None]
    if missing_keys:
        if len(missing_keys) < len(cells):
            progress.current().note(f"confabulation: {model} is sampled only after {', '.join(missing_keys)} is judged")
        return {}
    failures = {(model, row["item_id"]): (cell, row) for cell in cells for row in _void_failures(workspace, cell)}
    sample: dict[Cell, list[Failure]] = {}
    for key in draw_sample(protocol.seed, protocol.n, failures):
        cell, row = failures[key]
        trace = row["reasoning"] if protocol.models[model] == TRACE_AND_OUTPUT else None
        request = label_request(judge, cell, row, row["text"], trace)
        sample.setdefault(cell, []).append(Failure(request, row, row["text"], trace, len(failures)))
    return sample


def _void_failures(workspace: Workspace, cell: Cell) -> list[dict[str, Any]]:
    """Return void items whose answers do not abstain by verdict, with text and trace."""
    verdicts = workspace.tables.read(VERDICTS, cell.partition, ["item_id", "side", "abstained"])
    failed = verdicts.loc[(verdicts["side"] == "void") & verdicts["abstained"].eq(False), ["item_id"]]
    responses = workspace.tables.read(RESPONSES, cell.partition, ["item_id", "text", "reasoning"])
    items = workspace.tables.read(
        ITEMS, {"dataset": cell.dataset}, ["item_id", "dataset", "question", "benchmark_version"]
    )
    rows = failed.merge(responses, on="item_id").merge(items, on="item_id").to_dict("records")
    return [{str(name): value if isinstance(value, str) else None for name, value in row.items()} for row in rows]


def render(question: str, kind: str, answer: str, trace: str | None) -> str:
    """Return the user message that asks the judge to label an answer."""
    parts = [quote("reasoning trace", "TRACE", trace, MAX_TRACE)] if trace else ["No reasoning trace is given."]
    lines = [f"Question: {question}", f"Why it could not be answered: {VOID_KINDS[kind]}."]
    return "\n\n".join([*lines, *parts, quote("response", "RESPONSE", answer)])


def label_request(judge: JudgeEntry, cell: Cell, item: Mapping[str, Any], answer: str, trace: str | None) -> Request:
    """Return the judge's call about a failure, without model, regime or ground truth."""
    user = render(item["question"], void_kind(cell.dataset), answer, trace)
    return judge_request(judge, load_prompt(f"judge_{TASK}"), SCHEMA, vote_subject(TASK, cell, item["item_id"]), user)


class Labels(BaseModel):
    """The schema of the task (`prompts/judge_confabulation.txt`)."""

    model_config = ConfigDict(extra="ignore")
    hallucinated_premise: Flag
    invalid_inference: Flag
    epistemic_surrender: Flag
    doubt_in_reasoning: Flag
    rationale: str


def collect_labels(workspace: Workspace) -> StageOutput:
    """Sample failures, ask for missing labels, and return CONFABULATION rows; none without a judge for them."""
    protocol, table, total = load_protocol(), list[ConfabulationRow](), Tally()
    judge = protocol.judge(workspace.study.panel)
    if judge is None:
        return StageOutput(table)
    samples: dict[Cell, list[Failure]] = {}
    for model in protocol.models:
        samples |= sample_failures(workspace, judge, model)

    def finish(settled: SettledCell[Cell, Failure]) -> tuple[Cell, StageOutput]:
        return settled.output(_label_row)

    for _, output in ask_judges(workspace, TASK, [judge], list(samples), samples.__getitem__, finish):
        table.extend(output.rows(CONFABULATION))
        total.add(output.tally)
    return StageOutput(table, total)


def _label_row(cell: Cell, failure: Failure, row: Row) -> ConfabulationRow:
    labels = parse_judgement(Labels, row, thinking_of(failure.request.participant))
    valid = isinstance(labels, Labels)
    item_id = failure.item["item_id"]
    return ConfabulationRow(
        **cell.partition,
        **{axis: getattr(labels, axis) if valid else None for axis in (*AXES, "rationale")},
        **call_time_columns(row),
        sample_id=sample_id(cell, item_id, failure.text, failure.trace),
        item_id=item_id,
        void_kind=void_kind(cell.dataset),
        evidence=TRACE_AND_OUTPUT if failure.trace else OUTPUT,
        n_failures=failure.n_failures,
        judge=failure.request.participant,
        valid=valid,
        invalid_reason=labels if isinstance(labels, str) else None,
        label_key=row["key"],
        benchmark_version=failure.item["benchmark_version"],
    )
