"""Define the tables of people's labels and agreement, and the files' version."""

from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Annotated

from traps_pipeline.base.digests import file_digest
from traps_pipeline.base.paths import ASSETS
from traps_pipeline.protocol.regimes import REGIMES, one_of
from traps_pipeline.storage import columns as shared
from traps_pipeline.storage.tables import Table

LABELS_FILE = "labels.jsonl"  # file in a study's folder of labels
PROTOCOL_FILE = ASSETS / "annotation.yaml"
PeopleTask = Annotated[str, "answerability, confabulation, abstention or correctness"]
Axis = Annotated[bool | None, "an axis of confabulation; null in other tasks"]


@dataclass(frozen=True, kw_only=True)
class HumanLabelRow:
    """One person's last label of one clip or answer that is still in the study."""

    task: PeopleTask
    unit: Annotated[str, "digest of what was shown; it changes with clip, question and answer"]
    annotator: Annotated[str, "who labelled"]
    item_id: shared.ItemId
    dataset: shared.CellDataset
    scenario_id: shared.ScenarioId
    side: shared.Side
    model: Annotated[str | None, "whose answer was labelled; null for a clip"]
    regime: Annotated[str | None, f"{one_of(REGIMES)}; null for a clip"]
    run: Annotated[int | None, "run of the answer; null for a clip"]
    stratum: Annotated[str, "group that it was sampled from, and whether the judges are split about it"]
    stratum_size: Annotated[int, "units of the stratum in the study"]
    answer: Annotated[str | None, "what the person answered about a clip; null where it cannot be known"]
    abstained: Annotated[bool | None, "clip: cannot be known; abstention: the answer abstains; null in other tasks"]
    correct: Annotated[bool | None, "clip of a control: the answer is right; correctness: the answer is right"]
    panel: Annotated[bool | None, "what the panel decided about the answer; null for clips and confabulation"]
    hallucinated_premise: Axis
    invalid_inference: Axis
    epistemic_surrender: Axis
    doubt_in_reasoning: Axis
    seconds: Annotated[float, "seconds from showing it to the first label"]
    created_at: Annotated[datetime, "when the label was given"]
    benchmark_version: shared.BenchmarkVersion


HUMAN_LABELS = Table("human_labels", HumanLabelRow, partition_by=(), key=("task", "unit", "annotator"))


@dataclass(frozen=True, kw_only=True)
class HumanAgreementRow:
    """Agreement between people on one decision of a task; no row without labels."""

    task: PeopleTask
    decision: Annotated[str, "abstained (of clips: cannot be known), correct, or an axis of confabulation"]
    annotators: Annotated[str, "who labelled, joined by +"]
    n_labels: Annotated[int, "labels"]
    n_units: Annotated[int, "clips or answers labelled"]
    n_shared: Annotated[int, "of these, labelled by two people or more"]
    agreement: Annotated[float | None, "share of pairs of labels of the same unit that are equal; null without any"]
    alpha: Annotated[float | None, "Krippendorff's alpha (nominal) over n_shared"]
    undefined: Annotated[str | None, "why a statistic is null"]
    seconds: Annotated[float, "median seconds a label"]


HUMAN_AGREEMENT = Table("human_agreement", HumanAgreementRow, partition_by=(), key=("task", "decision"))


def labels_version(folder: Path) -> str:
    """Return the digest of the labels in a study's folder of labels."""
    path = folder / LABELS_FILE
    return file_digest(path)[:16] if path.is_file() else "not run"
