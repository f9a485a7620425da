"""Score people on the clips that models are asked about (docs/people.md).

Labels of all people are pooled. A label is weighted by the size of its stratum over the number of its labels, so that
clips chosen because the judges are split about them count no more than they do in the study.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd

from traps_pipeline.people.human_score_rows import HUMAN_ROW
from traps_pipeline.people.labels import agreement_of, label_matrix
from traps_pipeline.protocol.datasets import DATASETS, taxonomy_of
from traps_pipeline.scoring.bootstrap import (
    RESAMPLED_METRICS,
    RESAMPLES,
    SEED,
    draw_scenarios,
    limits_of,
    means_over_runs,
    metrics_of,
    run_sums,
    with_interval,
)
from traps_pipeline.scoring.metrics import COUNTS, decision_counts, joined_versions


def stratum_weights(labels: pd.DataFrame) -> np.ndarray:
    """Return each label's weight, (labels,): stratum size / labels in the stratum."""
    return (labels["stratum_size"] / labels.groupby("stratum")["stratum"].transform("size")).to_numpy(float)


def human_row(labels: pd.DataFrame, resamples: int = RESAMPLES, seed: int = SEED) -> pd.DataFrame:
    """Return people's scores on clips (HUMAN_ROW), with intervals over scenarios.

    Without a label of a clip there is no row; overall is null until all four datasets have metrics.
    """
    is_clip = (labels["task"] == "answerability") & labels["dataset"].isin(DATASETS)
    clips = labels.loc[is_clip].reset_index(drop=True)
    if clips.empty:
        return pd.DataFrame(columns=pd.Index(HUMAN_ROW.names))
    counts = decision_counts(clips).mul(stratum_weights(clips), axis=0)
    items = pd.concat([clips[["dataset", "scenario_id"]].assign(run=1), counts[COUNTS]], axis=1)
    items["taxonomy"] = items["dataset"].map(taxonomy_of)
    resampling = draw_scenarios(items, resamples, seed)
    means = means_over_runs(run_sums(items, resampling, "people"), metrics_of, resamples + 1)
    clips_of = {name: clips if name == "overall" else clips.loc[clips["dataset"] == name] for name in means}
    rows = [_row(dataset, metrics, clips_of[dataset]) for dataset, metrics in means.items()]
    return pd.DataFrame(rows, columns=pd.Index(HUMAN_ROW.names))


def _row(dataset: str, metrics: np.ndarray, clips: pd.DataFrame) -> dict[str, Any]:
    _, agreement, alpha = agreement_of(label_matrix(clips, "abstained"))
    return {
        "dataset": dataset,
        "n_people": clips["annotator"].nunique(),
        "n_labels": len(clips),
        "n_clips": clips["unit"].nunique(),
        **with_intervals(RESAMPLED_METRICS, metrics),
        "agreement": agreement,
        "alpha": alpha,
        "seconds": float(np.median(clips["seconds"].to_numpy(float))),
        "benchmark_version": joined_versions(clips["benchmark_version"]),
    }


def with_intervals(names: Sequence[str], draws: np.ndarray, suffix: str = "") -> Mapping[str, float]:
    """Return scores with intervals as columns. draws: (2, names, 1 + resamples), observed ones first."""
    columns = [with_interval(f"{name}{suffix}", draws[:, k], limits_of(name)) for k, name in enumerate(names)]
    return {name: value for metric_columns in columns for name, value in metric_columns.items()}
