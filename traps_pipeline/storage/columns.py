"""Define column types that several tables share, each with its meaning."""

from dataclasses import dataclass
from datetime import datetime
from typing import Annotated

from traps_pipeline.protocol.regimes import REGIMES, one_of

ScenarioId = Annotated[str, "family and number"]
ItemId = Annotated[str, "dataset:scenario_id:side"]
PairId = Annotated[str, "dataset:scenario_id"]
Dataset = Annotated[str, "one of four, or an arm"]
CellDataset = Annotated[str, "occlusion, occlusion_ill_posed, chaotic or chaotic_ill_posed"]
Category = Annotated[str, "one of twelve"]
SubScenario = Annotated[str, "the paper's name where it has one"]
Side = Annotated[str, "control or void"]
Question = Annotated[str, "with its choices"]
ClipPath = Annotated[str, "mp4, relative to the workspace"]
MediaDigest = Annotated[str, "digest of the clip's file"]
Model = Annotated[str, "id in assets/models.yaml"]
Regime = Annotated[str, one_of(REGIMES)]
Run = Annotated[int, "independent repetition, from 1"]
Outcome = Annotated[str, "answer, truncated, unfinished, empty, refused, error or malformed"]
AnswerOutcome = Annotated[
    str,
    "answer, truncated (before an answer), unfinished (ended for an unknown reason), degenerate, empty, refused, error "
    "or malformed",
]
Tokens = Annotated[int | None, "tokens"]
LedgerKey = Annotated[str, "ledger key"]
Panel = Annotated[str, "the panel and the version of its judges and their prompts: name@version, .1 for one judge"]
Panels = Annotated[str, "panels of the verdicts, joined by +; metrics of different panels are not compared"]
Judge = Annotated[str, "id in assets/judges.yaml"]
Epoch = Annotated[str, "campaign in which it was asked"]
AnswerEpochs = Annotated[str, "campaigns of the answers, joined by +"]
AskedAt = Annotated[datetime, "when it was asked"]
Wilson = Annotated[float | None, "95 % Wilson interval"]
BenchmarkVersion = Annotated[
    str, "of the part of the benchmark that this row is from: release, or release+digest once corrected"
]


@dataclass(frozen=True, kw_only=True, slots=True)
class CellRow:
    """The columns of a row that belongs to one cell: a dataset under one evaluation."""

    dataset: CellDataset
    model: Model
    regime: Regime
    run: Run


@dataclass(frozen=True, kw_only=True)
class EntryRow:
    """The columns of a row of scores: a model under a regime, and the verdicts that they are from."""

    model: Model
    regime: Regime
    panel: Panels
    epoch: AnswerEpochs
    benchmark_version: BenchmarkVersion
