"""Measure agreement between judges, and the bias of each (docs/spec.md 4.4).

Everything is counted per dataset and task over all models, regimes and runs. An undefined coefficient is null, with the
reason: if all votes are of one class, agreement beyond chance is undefined.
"""

from collections.abc import Iterable, Iterator, Sequence
from itertools import combinations
from typing import Any

import numpy as np
import pandas as pd

from traps_pipeline.judging.judging_rows import AGREEMENT, JUDGE_BIAS
from traps_pipeline.protocol.datasets import DATASETS
from traps_pipeline.protocol.ratings import INVALID, NO, PANEL, TASKS, YES, Ratings, majority, ratings


def agreement(votes: pd.DataFrame, judges: Sequence[str] | None = None) -> pd.DataFrame:
    """Return AGREEMENT of the panel and of each pair of judges, per dataset and task."""
    rows: list[dict[str, Any]] = []
    for group_columns, group in _groups(ratings(votes, judges)):
        rows.append(group_columns | _panel_row(group.values))
        for left, right in combinations(sorted(range(len(group.judges)), key=group.judges.__getitem__), 2):
            name = f"{group.judges[left]}+{group.judges[right]}"
            rows.append(group_columns | {"judges": name} | _pair_row(group.values[:, [left, right]]))
    return pd.DataFrame(rows, columns=pd.Index(AGREEMENT.names))


def judge_bias(votes: pd.DataFrame, judges: Sequence[str] | None = None) -> pd.DataFrame:
    """Return JUDGE_BIAS: each judge's rate of yes against the majority's."""
    rows: list[dict[str, Any]] = []
    for group_columns, group in _groups(ratings(votes, judges)):
        verdict = majority(group.values)
        rows += [
            group_columns | {"judge": judge} | _bias(group.values[:, seat], verdict)
            for seat, judge in enumerate(group.judges)
        ]
    return pd.DataFrame(rows, columns=pd.Index(JUDGE_BIAS.names))


def _groups(ratings_of_study: Ratings) -> Iterator[tuple[dict[str, Any], Ratings]]:
    """Yield the ratings of each dataset and task with votes, and their shared columns."""
    for dataset in DATASETS:
        for task in TASKS:
            is_in_group = (ratings_of_study.answers["dataset"] == dataset) & (ratings_of_study.answers["task"] == task)
            group = ratings_of_study.select(is_in_group.to_numpy(bool))
            if len(group.values):
                versions = {name: _join(group.answers[name].unique(), separator) for name, separator in _JOINS.items()}
                yield {"dataset": dataset, "task": task, **versions}, group


_JOINS = {"epoch": "+", "benchmark_version": " + "}


def _join(values: Iterable[str], by: str) -> str:
    return by.join(sorted({part for value in values for part in value.split(by)}))


def complete(values: np.ndarray) -> np.ndarray:
    """Return the rows of votes (answers, judges) on which every judge cast a valid vote."""
    return values[(values != INVALID).all(axis=1)]


def fleiss_kappa(values: np.ndarray) -> float:
    """Return Fleiss' kappa of complete rows, (answers, judges) of YES and NO.

    An answer with y yes of k votes agrees by (y (y-1) + (k-y) (k-y-1)) / (k (k-1)); chance by p^2 + (1-p)^2, p being
    the share of yes in all votes. NaN if there is one class or no row, and for a single judge.
    """
    n, k = values.shape
    yes = (values == YES).sum(axis=1)
    total = int(yes.sum())
    if k < 2 or total in (0, n * k):
        return float("nan")
    observed_agreement = float(np.mean(yes * (yes - 1) + (k - yes) * (k - yes - 1))) / (k * (k - 1))
    p = total / (n * k)
    return _chance_corrected(observed_agreement, p * p + (1 - p) * (1 - p))


def cohen_kappa(first: np.ndarray, second: np.ndarray) -> float:
    """Return Cohen's kappa of two judges' YES and NO votes; NaN for one class or none."""
    yes = int((first == YES).sum()), int((second == YES).sum())
    n = len(first)
    if sum(yes) in (0, 2 * n):
        return float("nan")
    p, q = yes[0] / n, yes[1] / n
    return _chance_corrected(float(np.mean(first == second)), p * q + (1 - p) * (1 - q))


def krippendorff_alpha(values: np.ndarray) -> float:
    """Return Krippendorff's alpha for nominal values, (answers, judges).

    INVALID is missing.

    In an answer with y yes of m valid votes, 2 y (m-y) of its m (m-1) ordered pairs disagree, with weight 1 / (m-1)
    each; by chance, 2 n_yes n_no of the n (n-1) ordered pairs of all n pairable votes would disagree. NaN if the
    answers with two valid votes or more hold one class or none.
    """
    yes, valid = (values == YES).sum(axis=1), (values != INVALID).sum(axis=1)
    pairable = valid > 1
    yes, valid = yes[pairable], valid[pairable]
    n, n_yes = int(valid.sum()), int(yes.sum())
    if n_yes in (0, n):
        return float("nan")
    observed_disagreement = float(np.sum(2 * yes * (valid - yes) / (valid - 1))) / n
    return 1 - observed_disagreement / (2 * n_yes * (n - n_yes) / (n * (n - 1)))


def unanimous_share(values: np.ndarray) -> float:
    """Return the share of rows (answers, judges) whose votes are equal; NaN if empty or one judge."""
    has_several_judges = len(values) and values.shape[1] > 1
    return float(np.mean((values == values[:, :1]).all(axis=1))) if has_several_judges else float("nan")


def _chance_corrected(observed: float, by_chance: float) -> float:
    return (observed - by_chance) / (1 - by_chance)


def _shared_columns(values: np.ndarray, complete_rows: np.ndarray) -> dict[str, Any]:
    """Return the columns that the panel's row and a pair's row share."""
    valid = values != INVALID
    return {
        "n_items": len(values),
        "n_complete": len(complete_rows),
        "invalid": float(1 - valid.mean()),
        "prevalence": _share((values == YES).sum(), valid.sum()),
        "agreement": unanimous_share(complete_rows),
        "alpha": krippendorff_alpha(values),
        "undefined": _undefined_reason(complete_rows),
    }


def _panel_row(values: np.ndarray) -> dict[str, Any]:
    complete_rows = complete(values)
    n_undecided = int((majority(values) == INVALID).sum())
    return _shared_columns(values, complete_rows) | {
        "judges": PANEL,
        "n_undecided": n_undecided,
        "fleiss_kappa": fleiss_kappa(complete_rows),
        "cohen_kappa": np.nan,
    }


def _pair_row(values: np.ndarray) -> dict[str, Any]:
    complete_rows = complete(values)
    kappa = cohen_kappa(complete_rows[:, 0], complete_rows[:, 1])
    return _shared_columns(values, complete_rows) | {"n_undecided": None, "fleiss_kappa": np.nan, "cohen_kappa": kappa}


def _undefined_reason(complete_rows: np.ndarray) -> str | None:
    if complete_rows.shape[1] < 2:
        return "one judge agrees with nobody"
    if not len(complete_rows):
        return "no answer has a valid vote of each judge"
    if (complete_rows == complete_rows[0, 0]).all():
        return f"every complete vote is {'yes' if complete_rows[0, 0] == YES else 'no'}"
    return None


def _bias(votes: np.ndarray, verdict: np.ndarray) -> dict[str, Any]:
    is_valid = (votes != INVALID) & (verdict != INVALID)
    voted_yes, panel = votes[is_valid] == YES, verdict[is_valid] == YES
    n = int(is_valid.sum())
    yes, panel_yes = _share(voted_yes.sum(), n), _share(panel.sum(), n)
    return {
        "n_votes": len(votes),
        "n_invalid": int((votes == INVALID).sum()),
        "n_decided": n,
        "yes": yes,
        "panel_yes": panel_yes,
        "bias": yes - panel_yes,
        "dissent_yes": _share((voted_yes & (verdict[is_valid] == NO)).sum(), n),
        "dissent_no": _share((~voted_yes & panel).sum(), n),
    }


def _share(part: Any, total: Any) -> float:
    return float(part) / float(total) if total else float("nan")
