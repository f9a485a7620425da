"""Measure how well superficial cues (wording, length, file size) predict the side.

A model that abstained on such a cue alone would score without having seen anything, so a reader must know their size.
They are reported beside the observer and are no gate: a cut clip *is* shorter.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, MutableMapping, Sequence
from importlib.metadata import version
from itertools import chain, pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from traps_pipeline.base.digests import digest, file_digest
from traps_pipeline.protocol.datasets import DATASETS

FOLDS = 5
THUMBNAIL = (32, 24)  # pixels of a first frame that the classifier sees, width and height
COLUMNS = ("dataset", "cue", "n_pairs", "accuracy", "half_width")


# (features of items to fit, (n, ..), which are void, (n,); features of others, (m, ..)) -> whether those are void, (m,)
Classifier = Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]


class _Cue(NamedTuple):
    """A cue: values that identify what a classifier reads, features, and classifier."""

    values: Callable[[pd.DataFrame], pd.Series]
    features: Callable[[pd.DataFrame], np.ndarray]
    classify: Classifier


def shortcuts(
    items: pd.DataFrame, videos: pd.DataFrame, root: Path, cache: MutableMapping[str, list[float]] | None = None
) -> pd.DataFrame:
    """Return how accurately each cue predicts the side, per dataset; 0.5 is chance.

    items are ITEMS rows, videos VIDEOS rows, clips lie under root. Columns: dataset, cue, n_pairs, accuracy, half_width
    (of a 95 % normal interval over pairs). Every scenario is predicted by a classifier fitted on the others (five
    folds), with both its sides in one fold. Datasets of fewer than five scenarios are left out. Raises DamagedClip.
    """
    clips = videos.drop_duplicates("path").set_index("path")
    cues, code = _cues(clips, root), [file_digest(Path(__file__)), version("scikit-learn")]
    rows, results = [], dict[str, list[float]]()
    for dataset in DATASETS:
        data = items.loc[items["dataset"] == dataset].reset_index(drop=True)
        if data["scenario_id"].nunique() < FOLDS:
            continue
        id_rows: list[Any] = data[["scenario_id", "pair_id", "side"]].to_numpy().tolist()
        for name, cue in cues.items():
            key = digest([*code, dataset, name, id_rows, cue.values(data).tolist()])
            results[key] = (cache or {}).get(key) or _accuracy(_hits(data, cue.features(data), cue.classify))
            rows.append((dataset, name, data["pair_id"].nunique(), *results[key]))
    if cache is not None:
        cache.clear()
        cache.update(results)
    return pd.DataFrame(rows, columns=list(COLUMNS))


def _accuracy(hits: np.ndarray) -> list[float]:
    return [float(hits.mean()), float(1.96 * hits.std(ddof=1) / np.sqrt(len(hits)))]


def _cues(clips: pd.DataFrame, root: Path) -> dict[str, _Cue]:
    def of_clip(column: str) -> Callable[[pd.DataFrame], pd.Series]:
        return lambda items: pd.Series(clips.loc[items["clip"], column])

    def by_clip(column: str) -> _Cue:
        values = of_clip(column)
        return _Cue(values, lambda items: values(items).to_numpy(float)[:, None], _by_number)

    def first_frames(items: pd.DataFrame) -> np.ndarray:
        thumbnails = {path: _thumbnail(root / path) for path in items["clip"].unique()}
        return np.stack([thumbnails[path] for path in items["clip"]])

    return {
        "question": _Cue(
            lambda items: pd.Series(items["question"]), lambda items: items["question"].to_numpy(), by_words
        ),
        "clip length": by_clip("duration_s"),
        "first frame": _Cue(of_clip("file_sha256"), first_frames, _by_picture),
        "file size": by_clip("size_bytes"),
    }


def _hits(items: pd.DataFrame, features: np.ndarray, classify: Classifier) -> np.ndarray:
    """Return the share of correctly predicted sides of each pair (0, 0.5 or 1)."""
    void, fold = (items["side"] == "void").to_numpy(), _folds(items["scenario_id"].to_numpy(str))
    is_right = np.empty(len(items), bool)
    for k in range(FOLDS):
        held_out = fold == k
        is_right[held_out] = classify(features[~held_out], void[~held_out], features[held_out]) == void[held_out]
    _, pair = np.unique(items["pair_id"].to_numpy(str), return_inverse=True)
    return np.bincount(pair, weights=is_right) / np.bincount(pair)


def _folds(scenarios: np.ndarray) -> np.ndarray:
    """Return each item's fold: the scenarios of most items first, each into the smallest fold."""
    _, scenario, sizes = np.unique(scenarios, return_inverse=True, return_counts=True)
    fold_of, fold_sizes = np.empty(len(sizes), int), np.zeros(FOLDS, int)
    for k in np.argsort(sizes, kind="stable")[::-1]:
        fold_of[k] = np.argmin(fold_sizes)
        fold_sizes[fold_of[k]] += sizes[k]
    return fold_of[scenario]


def _thumbnail(clip: Path) -> np.ndarray:
    import cv2

    from traps_pipeline.video.encode import decode_first

    return cv2.resize(decode_first(clip), THUMBNAIL, interpolation=cv2.INTER_AREA).ravel() / 255


def by_words(texts: np.ndarray, void: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Classify texts by logistic regression (C = 10) on the TF-IDF of their words and pairs of words.

    As scikit-learn does it, whose import takes over a second after each corrected question.
    """
    terms = [_terms(text) for text in texts]
    column = {term: k for k, term in enumerate(sorted({*chain(*terms)}))}
    appears_in = np.bincount([column[term] for text_terms in terms for term in {*text_terms}], minlength=len(column))
    idf = np.log((1 + len(texts)) / (1 + appears_in)) + 1
    rows, other_rows = (_weighted(part, column, idf) for part in (terms, [_terms(text) for text in others]))
    *of_rows, intercept = _logistic_regression(rows @ rows.T, void)
    return other_rows @ (rows.T @ of_rows) + intercept > 0


def _terms(text: str) -> list[str]:
    words = re.findall(r"\w\w+", text.lower())
    return words + [" ".join(pair) for pair in pairwise(words)]


def _weighted(terms: Sequence[Sequence[str]], column: Mapping[str, int], idf: np.ndarray) -> np.ndarray:
    """Return the TF-IDF of each text's known terms, (n, terms), of length sqrt(10): C = 10 of rows of length 1."""
    counts = np.zeros((len(terms), len(column)))
    for row, text_terms in zip(counts, terms, strict=True):
        np.add.at(row, [column[term] for term in text_terms if term in column], 1)
    rows = counts * idf
    length = np.linalg.norm(rows, axis=1, keepdims=True)
    return rows * (np.sqrt(10) / np.where(length > 0, length, 1.0))


def _logistic_regression(products: np.ndarray, label: np.ndarray) -> np.ndarray:
    """Return the weight of each row and, last, the intercept, (n + 1,), by Newton's method; C is 1.

    products: inner products of the rows, (n, n). The weights of the terms, which are more, are sums over the rows.
    """
    n = len(label)
    system = np.block([[products, np.ones((n, 1))], [np.ones((1, n)), np.zeros((1, 1))]])
    point = np.zeros(n + 1)
    for _ in range(100):
        margin = system[:n] @ point
        share = 1 / (1 + np.exp(-margin))
        curvature = np.maximum(share * (1 - share), 1e-12)
        step_system = system + np.diag(np.append(1 / curvature, 0))
        target = np.append(margin + (label - share) / curvature, 0)
        previous, point = point, np.linalg.solve(step_system, target)
        if np.allclose(point, previous, atol=1e-9):
            return point
    raise ArithmeticError("Newton's method has not converged in 100 steps")  # the benchmark's questions need 8


def _by_picture(pictures: np.ndarray, void: np.ndarray, others: np.ndarray) -> np.ndarray:
    from sklearn.linear_model import LogisticRegression
    from sklearn.pipeline import make_pipeline
    from sklearn.preprocessing import StandardScaler

    model = make_pipeline(StandardScaler(), LogisticRegression(C=0.01, max_iter=1000))
    return model.fit(pictures, void).predict(others)


def _by_number(numbers: np.ndarray, void: np.ndarray, others: np.ndarray) -> np.ndarray:
    from sklearn.tree import DecisionTreeClassifier

    model = DecisionTreeClassifier(max_depth=4, min_samples_leaf=2, random_state=0)
    return model.fit(numbers, void).predict(others)
