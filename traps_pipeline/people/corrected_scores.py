"""Correct scores for the panel's errors, by people's labels (docs/people.md).

A panel with sensitivity Se and specificity Sp against people says yes to p = Se t + (1 - Sp) (1 - t) of answers of
which a share t is yes. Solved for t (Rogan and Gladen 1978), this turns a judged share into a corrected one. Se, Sp and
the shares are resampled together: a resampled scenario takes its labelled answers along, so that the intervals hold the
uncertainty of both.
"""

from collections.abc import Mapping
from typing import Any, cast

import numpy as np
import pandas as pd

from traps_pipeline.people.human_score_rows import CORRECTED, PANEL_ERRORS
from traps_pipeline.people.human_scores import stratum_weights, with_intervals
from traps_pipeline.people.label_units import ABOUT_ANSWERS, TaskName
from traps_pipeline.people.labels import true_labels
from traps_pipeline.protocol.datasets import DATASETS, taxonomy_of
from traps_pipeline.scoring.bootstrap import (
    RESAMPLED_METRICS,
    RESAMPLES,
    SEED,
    Resampling,
    draw_scenarios,
    means_over_runs,
    metrics_of,
    metrics_of_shares,
    resampled_sums,
    run_sums,
    shares_of,
    with_unseen,
)
from traps_pipeline.scoring.metrics import decision_counts, joined_epochs

SHARES: tuple[TaskName, ...] = ("correctness", "abstention", "abstention")  # the tasks behind Acc, FalseAbs and AbsRec
NO_BETTER = "the panel agrees with people no better than chance"
Errors = Mapping[TaskName, np.ndarray]  # by task: the ends of sensitivity and specificity, (2, 2, draws)


def panel_errors(
    labels: pd.DataFrame, verdicts: pd.DataFrame, resamples: int = RESAMPLES, seed: int = SEED
) -> pd.DataFrame:
    """Return PANEL_ERRORS from HUMAN_LABELS and VERDICTS rows; none without labels."""
    rows = []
    if _is_labelled(labels):
        resampling = _resampling(verdicts, resamples, seed)
        rows = [
            _errors_row(labels, task, draws, joined_epochs(verdicts["panel"]))
            for task, draws in _errors(labels, resampling).items()
        ]
    return pd.DataFrame(rows, columns=pd.Index(PANEL_ERRORS.names))


def corrected(
    labels: pd.DataFrame, verdicts: pd.DataFrame, resamples: int = RESAMPLES, seed: int = SEED
) -> pd.DataFrame:
    """Return CORRECTED rows: every model and regime, as judged and as corrected.

    Both come from the same resamples as the leaderboard's. There are none unless people labelled answers for both
    tasks, since PECS needs both.
    """
    empty_table = pd.DataFrame(columns=pd.Index(CORRECTED.names))
    if not _is_labelled(labels):
        return empty_table
    resampling = _resampling(verdicts, resamples, seed)
    errors = _errors(labels, resampling)
    if len(errors) < len(ABOUT_ANSWERS):
        return empty_table
    taxonomies = [taxonomy_of(dataset) for dataset in verdicts["dataset"]]
    item_columns = verdicts[["model", "regime", "dataset", "run", "scenario_id"]].assign(taxonomy=taxonomies)
    items = pd.concat([item_columns, decision_counts(verdicts)], axis=1)
    panel, rows = joined_epochs(verdicts["panel"]), list[dict[str, Any]]()
    for key, group in items.groupby(["model", "regime"], sort=True):
        model, regime = cast(tuple[str, str], key)
        for dataset, metrics in _entry(group, f"{model}|{regime}", resampling, errors).items():
            entry = {"model": model, "regime": regime, "dataset": dataset, "panel": panel}
            rows.append(entry | {"n_runs": _count_runs(group, dataset)} | metrics)
    return pd.DataFrame(rows, columns=pd.Index(CORRECTED.names))


def rogan_gladen(share: np.ndarray, sensitivity: np.ndarray, specificity: np.ndarray) -> np.ndarray:
    """Return the Rogan-Gladen estimate of the true share in [0, 1]; NaN if sensitivity + specificity is 1 or less."""
    gain = sensitivity + specificity - 1
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.clip(np.where(gain > 1e-12, (share + specificity - 1) / gain, np.nan), 0.0, 1.0)


def _corrected_ends(share: np.ndarray, errors: np.ndarray) -> np.ndarray:
    """Return corrected ends, (2, draws), from ends of the share, (2, draws), and of its errors, (2, 2, draws)."""
    sensitivity, specificity = errors[:, 0], errors[:, 1]
    return rogan_gladen(share, sensitivity[::-1], specificity)


def _is_labelled(labels: pd.DataFrame) -> bool:
    return bool(labels["task"].isin(list(ABOUT_ANSWERS)).any())


def _resampling(verdicts: pd.DataFrame, resamples: int, seed: int) -> Resampling:
    items = verdicts[["scenario_id"]].assign(taxonomy=[taxonomy_of(dataset) for dataset in verdicts["dataset"]])
    return draw_scenarios(items, resamples, seed)


def _errors(labels: pd.DataFrame, resampling: Resampling) -> Errors:
    """Return sensitivity and specificity by task and draw; NaN without yes, or no."""
    errors: dict[TaskName, np.ndarray] = {}
    for task in ABOUT_ANSWERS:
        answers = true_labels(labels, task).dropna(subset=["truth"])
        if answers.empty:
            continue
        truth, panel = answers["truth"].to_numpy(bool), answers["panel"].to_numpy(bool)
        counts = np.stack([truth & panel, truth, ~truth & ~panel, ~truth], axis=1) * stratum_weights(answers)[:, None]
        taxonomies = np.array([taxonomy_of(dataset) for dataset in answers["dataset"]])
        total, n_with_class = np.zeros(()), np.zeros(counts.shape[1] // 2)
        for taxonomy, (ids, weights) in resampling.scenarios.items():
            is_of_taxonomy = taxonomies == taxonomy
            scenario_counts = np.zeros((len(ids), 1, counts.shape[1]))
            np.add.at(
                scenario_counts[:, 0],
                ids.get_indexer(pd.Index(answers["scenario_id"][is_of_taxonomy])),
                counts[is_of_taxonomy],
            )
            total = total + resampled_sums(weights, scenario_counts)[0]
            n_with_class = n_with_class + (scenario_counts[:, 0, 1::2] > 0).sum(axis=0)
        errors[task] = shares_of(with_unseen(total, n_with_class, resampling.unseen(task, len(n_with_class))))
    return errors


def _errors_row(labels: pd.DataFrame, task: TaskName, draws: np.ndarray, panel: str) -> dict[str, Any]:
    answers = true_labels(labels, task)
    decided_answers = answers.dropna(subset=["truth"])
    n_yes = int(decided_answers["truth"].to_numpy(bool).sum())
    if n_yes in (0, len(decided_answers)):
        reason = f"people say {'yes' if n_yes else 'no'} of every answer"
    else:
        reason = None if draws[0, :, 0].sum() > 1 else NO_BETTER
    return {
        "task": task,
        "n_answers": len(decided_answers),
        "n_tied": len(answers) - len(decided_answers),
        "n_people": labels.loc[labels["task"] == task, "annotator"].nunique(),
        "n_yes": n_yes,
        **with_intervals(("sensitivity", "specificity"), draws),
        "undefined": reason,
        "panel": panel,
    }


def _entry(group: pd.DataFrame, named: str, resampling: Resampling, errors: Errors) -> dict[str, dict[str, float]]:
    """Return the metrics of one model and regime, judged and corrected, by dataset."""

    def right(sums: np.ndarray, in_mean: bool) -> np.ndarray:
        shares = shares_of(sums, in_mean)
        fixed = [_corrected_ends(shares[:, k], errors[task]) for k, task in enumerate(SHARES)]
        return metrics_of_shares(np.stack(fixed, axis=1))

    sums = run_sums(group, resampling, named)
    means = [means_over_runs(sums, compute, resampling.resamples + 1) for compute in (metrics_of, right)]
    return {
        dataset: {
            **with_intervals(RESAMPLED_METRICS, metrics),
            **with_intervals(RESAMPLED_METRICS, means[1][dataset], "_corrected"),
        }
        for dataset, metrics in means[0].items()
        if not np.isnan(metrics[:, :, 0]).all()
    }


def _count_runs(group: pd.DataFrame, dataset: str) -> int:
    """Return how many runs are behind a dataset's row (`overall`: with all four)."""
    if dataset != "overall":
        return len(set(group["run"][group["dataset"] == dataset]))
    return sum(len(set(rows["dataset"])) == len(DATASETS) for _, rows in group.groupby("run"))
