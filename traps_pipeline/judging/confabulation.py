"""What is wrong with the answers that should have been abstentions (docs/spec.md 6.1 and 6.2).

A seeded sample of each model's void failures goes to one judge, which labels four independent axes
(`scoring.prevalence` counts them). `assets/confabulation.yaml` says whose, how many and who judges. A sample is the n
failures of least digest: uniform, independent from model to model, and a failure that is added or goes exchanges one
of the sample and no more, so that labels stay paid for once.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field, StrictBool

from traps_pipeline import progress
from traps_pipeline.benchmark.tables import ITEMS
from traps_pipeline.digests import digest
from traps_pipeline.errors import TrapsError
from traps_pipeline.judging.panel import ask_judges, judge_request, parse_judgement, quoted
from traps_pipeline.judging.tables import CONFABULATION, VERDICTS, ConfabulationRow
from traps_pipeline.models.ask import Call, Settled
from traps_pipeline.models.judges import JudgeEntry, load_judges
from traps_pipeline.models.participants import Row, when_asked
from traps_pipeline.models.prompts import prompt
from traps_pipeline.models.registry import NETWORK, get_model, structured
from traps_pipeline.models.request import Request
from traps_pipeline.models.tables import RESPONSES
from traps_pipeline.partitions import DATASETS, Cell, Evaluation, is_ill_posed
from traps_pipeline.paths import ASSETS
from traps_pipeline.progress import Tally
from traps_pipeline.storage.parquet import Made
from traps_pipeline.storage.workspace import Workspace
from traps_pipeline.yamlfile import parse_yaml_model, read_yaml

PROTOCOL_FILE = ASSETS / "confabulation.yaml"
TASK = "confabulation"
AXES = ("hallucinated_premise", "invalid_inference", "epistemic_surrender", "doubt_in_reasoning")
# What the id of a failure is made of, and with it the people's labels: another answer is another failure. A part of
# the protocol's digest, so that ids made otherwise are made anew.
SAMPLED = ("cell", "item", "answer", "trace that the judge sees")
SCHEMA = structured(TASK, **{axis: {"type": "boolean"} for axis in AXES}, rationale={"type": "string"})
TRACE_AND_OUTPUT, OUTPUT = "trace_and_output", "output"
Evidence = Literal["trace_and_output", "output"]
VOID_KINDS: Mapping[str, str] = {
    "occluder": "an opaque wall hides the place where the outcome could be seen",
    "truncation": "the clip ends before the outcome is decided",
    "question": "the clip shows the whole event, but the question asks for what the clip cannot show, or takes for "
    "granted something that is not in it",
}


class Validation(BaseModel):
    """Which of the labelled failures two people label too."""

    model_config = ConfigDict(extra="forbid", frozen=True)
    n: int = Field(ge=1)
    models: list[str] = Field(min_length=1)


class Protocol(BaseModel):
    """`assets/confabulation.yaml`: the sample of each model, the judge of each panel, and what it is shown."""

    model_config = ConfigDict(extra="forbid", frozen=True)
    n: int = Field(ge=1, description="failures a model; all if there are fewer")
    seed: int
    regime: Literal["standard", "guided", "json"]
    run: int = Field(ge=1)
    judges: dict[str, str] = Field(description="panel to judge; a panel that is not here labels nothing")
    models: dict[str, Evidence] = Field(min_length=1)
    validation: Validation

    def cells(self, model: str) -> list[Cell]:
        """The cells that a model's failures come from."""
        return [Cell(dataset, Evaluation(model, self.regime, self.run)) for dataset in DATASETS]

    def judge(self, panel: str) -> JudgeEntry | None:
        """The judge of a study with this panel; None where there is none."""
        name = self.judges.get(panel)
        return load_judges()[name] if name is not None else None


@cache
def load_protocol(path: Path = PROTOCOL_FILE) -> Protocol:
    """The protocol. Raises TrapsError naming the file and the field, model or judge that is wrong."""
    protocol = parse_yaml_model(Protocol, read_yaml(path), path)
    for model in protocol.models:
        if protocol.run > get_model(model).runs:
            raise TrapsError(f"{path}: {model} has {get_model(model).runs} runs, not run {protocol.run}")
    strangers = [model for model in protocol.validation.models if model not in protocol.models]
    if strangers:
        raise TrapsError(f"{path}: validation.models: {', '.join(strangers)} not among models")
    for panel, name in protocol.judges.items():
        judge = load_judges().get(name)
        if judge is None or judge.backend != NETWORK:
            known = ", ".join(entry.id for entry in load_judges().values() if entry.backend == NETWORK)
            raise TrapsError(f"{path}: judges.{panel} is {name!r}; it must be a judge over the network: {known}")
    return protocol


def protocol_digest(panel: str) -> str:
    """What decides the labels of a study with this panel, beside the answers."""
    protocol = load_protocol()
    judge = protocol.judge(panel)
    asked = [judge.id, judge.provider_id, judge.params, SCHEMA, prompt(f"judge_{TASK}"), VOID_KINDS] if judge else None
    return digest([protocol.model_dump(exclude={"judges"}), asked, SAMPLED])[:16]


# --- the sample -------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Failure(Call):
    """The call that puts a sampled void failure to the judge: its item and answer, and of how many it was drawn."""

    item: Mapping[str, Any]
    text: str
    trace: str | None
    n_failures: int


def void_kind(dataset: str) -> str:
    """Why the voids of a dataset cannot be answered: a key of VOID_KINDS."""
    if is_ill_posed(dataset):
        return "question"
    return "occluder" if dataset == "occlusion" else "truncation"


def drawn(seed: int, n: int, keys: Iterable[tuple[str, str]]) -> list[tuple[str, str]]:
    """A seeded sample without replacement of n of these keys, all if they are fewer, whatever their order."""
    return sorted(keys, key=lambda key: digest([seed, *key]))[:n]


def sample_id(cell: Cell, item_id: str, answer: str | None, trace: str | None) -> str:
    """What stands for a failure before its annotators: it tells neither model nor item, and changes with the answer."""
    return digest([cell.key, item_id, answer, trace or None])[:12]


def sample_failures(workspace: Workspace, judge: JudgeEntry, model: str) -> dict[Cell, list[Failure]]:
    """A model's sample by cell. Empty, with a note, until every dataset of the study that has items has verdicts."""
    protocol = load_protocol()
    cells = [cell for cell in protocol.cells(model) if workspace.tables.state(ITEMS, {"dataset": cell.dataset})]
    lacking = [cell.key for cell in cells if workspace.tables.state(VERDICTS, cell.partition) is None]
    if lacking:
        if len(lacking) < len(cells):
            progress.current().note(f"confabulation: {model} is not sampled before {', '.join(lacking)} is judged")
        return {}
    found = {(model, row["item_id"]): (cell, row) for cell in cells for row in _void_failures(workspace, cell)}
    sample: dict[Cell, list[Failure]] = {}
    for key in drawn(protocol.seed, protocol.n, found):
        cell, row = found[key]
        trace = row["reasoning"] if protocol.models[model] == TRACE_AND_OUTPUT else None
        request = label_request(judge, cell, row, row["text"], trace)
        sample.setdefault(cell, []).append(Failure(request, row, row["text"], trace, len(found)))
    return sample


def _void_failures(workspace: Workspace, cell: Cell) -> list[dict[str, Any]]:
    """Items on which the panel found an answer where an abstention was due, with text and trace of that answer."""
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
    """The user message to the judge."""
    shown = [quoted("reasoning trace", "TRACE", trace)] if trace else ["No reasoning trace is given."]
    about = [f"Question: {question}", f"Why it could not be answered: {VOID_KINDS[kind]}."]
    return "\n\n".join([*about, *shown, quoted("response", "RESPONSE", answer)])


def label_request(judge: JudgeEntry, cell: Cell, item: Mapping[str, Any], answer: str, trace: str | None) -> Request:
    """The call that puts one failure to the judge; it tells neither model nor regime, and no ground truth."""
    user = render(item["question"], void_kind(cell.dataset), answer, trace)
    return judge_request(judge, TASK, SCHEMA, cell, item["item_id"], user)


class Labels(BaseModel):
    """Schema of the task (`prompts/judge_confabulation.txt`)."""

    model_config = ConfigDict(extra="ignore")
    hallucinated_premise: StrictBool
    invalid_inference: StrictBool
    epistemic_surrender: StrictBool
    doubt_in_reasoning: StrictBool
    rationale: str


# --- the confabulation stage ------------------------------------------------------------------------------------------


def collect_labels(workspace: Workspace) -> Made:
    """CONFABULATION rows of a study: sample every model of the protocol that the study has judged, and ask what the
    ledger of votes does not hold.

    Nothing where the study's panel has no judge for it.
    """
    protocol, table, total = load_protocol(), list[ConfabulationRow](), Tally()
    judge = protocol.judge(workspace.study.panel)
    if judge is None:
        return Made(table)
    samples: dict[Cell, list[Failure]] = {}
    for model in protocol.models:
        samples |= sample_failures(workspace, judge, model)

    def finish(settled: Settled[Cell, Failure]) -> tuple[Cell, Made]:
        return settled.made(_label_row)

    for _, made in ask_judges(workspace, TASK, [judge], list(samples), samples.__getitem__, finish):
        table.extend(made.rows(CONFABULATION))
        total.add(made.tally)
    return Made(table, total, {"asked": total.asked, "known": total.cached, "failed": total.errors})


def _label_row(cell: Cell, failure: Failure, row: Row) -> ConfabulationRow:
    labels = parse_judgement(Labels, row)
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
