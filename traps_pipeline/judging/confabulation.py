"""Label confabulation: the errors in answers that should have been abstentions (docs/spec.md 6.1 and 6.2).

A seeded sample of each model's void failures goes to one judge, which labels four independent axes
(`scoring.prevalence` counts them). `assets/confabulation.yaml` names the models, the size of a sample and the judge. A
sample consists of the n failures with the smallest digests. It is uniform and independent between models, and a failure
that appears or disappears changes at most one member, so that nearly all paid labels are reused.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field

from traps_pipeline.base import progress
from traps_pipeline.base.digests import digest
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.base.paths import ASSETS
from traps_pipeline.base.progress import Tally
from traps_pipeline.base.yamlfile import parse_yaml_model, read_yaml, within
from traps_pipeline.judging.judging_rows import CONFABULATION, VERDICTS, ConfabulationRow
from traps_pipeline.judging.panel import Flag, about_answer, ask_judges, judge_request, parse_judgement, quote
from traps_pipeline.models.answer_rows import RESPONSES
from traps_pipeline.models.ask import Call, SettledCell
from traps_pipeline.models.judges import JudgeEntry, load_judges, thinking_of
from traps_pipeline.models.participants import Row, when_asked
from traps_pipeline.models.prompts import prompt
from traps_pipeline.models.registry import NETWORK, get_model
from traps_pipeline.models.request import Request
from traps_pipeline.models.schemas import structured_output
from traps_pipeline.protocol.cells import Cell, Evaluation
from traps_pipeline.protocol.datasets import DATASETS, is_ill_posed
from traps_pipeline.protocol.ratings import AXES
from traps_pipeline.protocol.regimes import REGIMES
from traps_pipeline.storage.benchmark_tables import ITEMS
from traps_pipeline.storage.parquet import StageOutput
from traps_pipeline.storage.workspace import Workspace

PROTOCOL_FILE = ASSETS / "confabulation.yaml"
TASK = "confabulation"
# The parts of a failure's id, which people's labels refer to: another answer is another failure. They are in the
# protocol's digest, so that the table is rebuilt when the parts change.
SAMPLED = ("cell", "item", "answer", "trace that the judge sees")
SCHEMA = structured_output(TASK, **{axis: {"type": "boolean"} for axis in AXES}, rationale={"type": "string"})
TRACE_AND_OUTPUT, OUTPUT = "trace_and_output", "output"
Evidence = Literal["trace_and_output", "output"]
VOID_KINDS: Mapping[str, str] = {
    "occluder": "an opaque wall hides the place where the outcome could be seen",
    "truncation": "the clip ends before the outcome is decided",
    "question": "the clip shows the whole event, but the question asks for what the clip cannot show, or takes for "
    "granted something that is not in it",
}


class Validation(BaseModel):
    """The selection of labelled failures that two people label too."""

    model_config = ConfigDict(extra="forbid", frozen=True)
    n: int = Field(ge=1)
    models: list[str] = Field(min_length=1)


class Protocol(BaseModel):
    """The contents of `assets/confabulation.yaml`: each model's sample, each panel's judge, and the judge's prompt."""

    model_config = ConfigDict(extra="forbid", frozen=True)
    n: int = Field(ge=1, description="failures per model; all if there are fewer")
    seed: int
    regime: str = Field(pattern=f"^({'|'.join(REGIMES)})$")
    run: int = Field(ge=1)
    judges: dict[str, str] = Field(description="judge by panel; for a panel that is not here nothing is labelled")
    models: dict[str, Evidence] = Field(min_length=1)
    validation: Validation

    def cells(self, model: str) -> list[Cell]:
        """Return the cells from which a model's failures are drawn."""
        return [Cell(dataset, Evaluation(model, self.regime, self.run)) for dataset in DATASETS]

    def judge(self, panel: str) -> JudgeEntry | None:
        """Return the judge of a study with this panel; None if there is none."""
        name = self.judges.get(panel)
        return load_judges()[name] if name is not None else None


@cache
def load_protocol(path: Path = PROTOCOL_FILE) -> Protocol:
    """Return the protocol. Raises TrapsError naming the file and the wrong field, model or judge."""
    protocol = parse_yaml_model(Protocol, read_yaml(path), path)
    with within(path):
        runs = {model: get_model(model).runs for model in protocol.models}
    for model, most in runs.items():
        if protocol.run > most:
            raise TrapsError(f"{path}: run is {protocol.run}, but {model} has only {most} runs")
    strangers = [model for model in protocol.validation.models if model not in protocol.models]
    if strangers:
        raise TrapsError(f"{path}: validation.models: {', '.join(strangers)} must be among `models`")
    for panel, name in protocol.judges.items():
        judge = load_judges().get(name)
        if judge is None or judge.backend != NETWORK:
            known = ", ".join(entry.id for entry in load_judges().values() if entry.backend == NETWORK)
            raise TrapsError(f"{path}: judges.{panel} is {name!r}; it must be a judge over the network: {known}")
    return protocol


def protocol_digest(panel: str) -> str:
    """Return the digest of everything, except the answers, that the labels of a study with this panel depend on."""
    protocol = load_protocol()
    judge = protocol.judge(panel)
    call = [judge.id, judge.provider_id, judge.params, SCHEMA, prompt(f"judge_{TASK}"), VOID_KINDS] if judge else None
    call = [*call, *judge.thinking] if call and judge and judge.thinking else call
    return digest([protocol.model_dump(exclude={"judges"}), call, SAMPLED])[:16]


# --- the sample -------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Failure(Call):
    """The call to the judge about a sampled void failure; n_failures is the size of the population."""

    item: Mapping[str, Any]
    text: str
    trace: str | None
    n_failures: int


def void_kind(dataset: str) -> str:
    """Return why the voids of a dataset cannot be answered: a key of VOID_KINDS."""
    if is_ill_posed(dataset):
        return "question"
    return "occluder" if dataset == "occlusion" else "truncation"


def draw_sample(seed: int, n: int, keys: Iterable[tuple[str, str]]) -> list[tuple[str, str]]:
    """Return a seeded sample of n keys without replacement (all keys if there are fewer), independent of order."""
    return sorted(keys, key=lambda key: digest([seed, *key]))[:n]


def sample_id(cell: Cell, item_id: str, answer: str | None, trace: str | None) -> str:
    """Return a failure's id for annotators: it reveals neither model nor item, and changes with the answer."""
    return digest([cell.key, item_id, answer, trace or None])[:12]


def sample_failures(workspace: Workspace, judge: JudgeEntry, model: str) -> dict[Cell, list[Failure]]:
    """Return a model's sample by cell; empty, with a note, while a dataset with items lacks verdicts."""
    protocol = load_protocol()
    cells = [cell for cell in protocol.cells(model) if workspace.tables.state(ITEMS, {"dataset": cell.dataset})]
    lacking = [cell.key for cell in cells if workspace.tables.state(VERDICTS, cell.partition) is None]
    if lacking:
        if len(lacking) < len(cells):
            progress.current().note(f"confabulation: {model} is sampled only after {', '.join(lacking)} is judged")
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
    """Return the void items whose answers do not abstain by the panel's verdict, with text and trace of each answer."""
    verdicts = workspace.tables.read(VERDICTS, cell.partition, ["item_id", "side", "abstained"])
    failed = verdicts.loc[(verdicts["side"] == "void") & verdicts["abstained"].eq(False), ["item_id"]]
    responses = workspace.tables.read(RESPONSES, cell.partition, ["item_id", "text", "reasoning"])
    items = workspace.tables.read(
        ITEMS, {"dataset": cell.dataset}, ["item_id", "dataset", "question", "benchmark_version"]
    )
    rows = failed.merge(responses, on="item_id").merge(items, on="item_id").to_dict("records")
    return [{str(name): value if isinstance(value, str) else None for name, value in row.items()} for row in rows]


# --- the judge --------------------------------------------------------------------------------------------------------


def render(question: str, kind: str, answer: str, trace: str | None) -> str:
    """Return the user message to the judge."""
    parts = [quote("reasoning trace", "TRACE", trace)] if trace else ["No reasoning trace is given."]
    about = [f"Question: {question}", f"Why it could not be answered: {VOID_KINDS[kind]}."]
    return "\n\n".join([*about, *parts, quote("response", "RESPONSE", answer)])


def label_request(judge: JudgeEntry, cell: Cell, item: Mapping[str, Any], answer: str, trace: str | None) -> Request:
    """Return the call to the judge about one failure; it reveals neither model nor regime nor ground truth."""
    user = render(item["question"], void_kind(cell.dataset), answer, trace)
    return judge_request(judge, prompt(f"judge_{TASK}"), SCHEMA, about_answer(TASK, cell, item["item_id"]), user)


class Labels(BaseModel):
    """The schema of the task (`prompts/judge_confabulation.txt`)."""

    model_config = ConfigDict(extra="ignore")
    hallucinated_premise: Flag
    invalid_inference: Flag
    epistemic_surrender: Flag
    doubt_in_reasoning: Flag
    rationale: str


# --- the confabulation stage ------------------------------------------------------------------------------------------


def collect_labels(workspace: Workspace) -> StageOutput:
    """Return CONFABULATION rows of a study.

    Sample every judged model of the protocol, and ask the judge for the labels that the ledger of votes lacks. There
    are no rows if the study's panel has no judge for confabulation.
    """
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
        **when_asked(row),
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
