"""Define score tables from labels: human row, panel errors, corrected scores."""

from dataclasses import dataclass
from typing import Annotated

from traps_pipeline.scoring.score_rows import CI, EACH_METRIC, DatasetOrOverall
from traps_pipeline.storage import columns as shared
from traps_pipeline.storage.tables import EachOf, Table, with_neighbours

Weighted = Annotated[float | None, "over labels, weighted so that each stratum counts as it does in the study"]
Corrected = Annotated[float | None, "corrected for the panel's errors, mean over runs; null where undefined"]
_EACH_CORRECTED = EachOf({f"{name}_corrected": meaning for name, meaning in EACH_METRIC.columns.items()})
Judged = Annotated[float | None, "as the panel decided, mean over runs"]


@dataclass(frozen=True, kw_only=True)
@with_neighbours
class HumanRow:
    """People's scores on a dataset, or overall (mean of four); no row without labels."""

    dataset: DatasetOrOverall
    n_people: Annotated[int, "who labelled clips"]
    n_labels: Annotated[int, "labels of clips"]
    n_clips: Annotated[int, "clips labelled, each with its question"]
    metrics: Annotated[Weighted, EACH_METRIC, CI]
    agreement: Annotated[float | None, "share of pairs of labels of a clip that agree whether it can be known"]
    alpha: Annotated[float | None, "Krippendorff's alpha of whether it can be known"]
    seconds: Annotated[float, "median seconds a clip"]
    benchmark_version: shared.BenchmarkVersion


HUMAN_ROW = Table("human_row", HumanRow, partition_by=(), key=("dataset",))


@dataclass(frozen=True, kw_only=True)
@with_neighbours
class PanelErrorsRow:
    """The panel's errors against people on one task; no row if it was not validated."""

    task: Annotated[str, "abstention (on both sides together: a judge is not told the side) or correctness"]
    n_answers: Annotated[int, "answers labelled, of which most people say the same"]
    n_tied: Annotated[int, "answers left out, since as many people say yes as no"]
    n_people: Annotated[int, "who labelled"]
    n_yes: Annotated[int, "answers of which people say yes (abstained, correct)"]
    sensitivity: Annotated[
        float | None, "share of people's yes that the panel says too, strata weighted; null if none", CI
    ]
    specificity: Annotated[
        float | None, "share of people's no that the panel says too, strata weighted; null if none", CI
    ]
    undefined: Annotated[str | None, "why metrics cannot be corrected for it"]
    panel: shared.Panel


PANEL_ERRORS = Table("panel_errors", PanelErrorsRow, partition_by=(), key=("task",))


@dataclass(frozen=True, kw_only=True)
@with_neighbours
class CorrectedRow:
    """A model under a regime, as judged and corrected; on one dataset, or overall."""

    model: shared.Model
    regime: shared.Regime
    dataset: DatasetOrOverall
    n_runs: Annotated[int, "runs averaged"]
    judged: Annotated[Judged, EACH_METRIC, CI]
    corrected: Annotated[Corrected, _EACH_CORRECTED, CI]
    panel: shared.Panel


CORRECTED = Table("corrected", CorrectedRow, partition_by=(), key=("model", "regime", "dataset"))
