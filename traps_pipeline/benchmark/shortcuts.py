"""Measure how well superficial cues (wording, length, file size) predict the side.

A model that abstained on such a cue alone would score without having seen anything, so a reader must know their size.
They are reported beside the observer and are no gate: a cut clip *is* shorter.
"""

from __future__ import annotations

from collections.abc import Callable, MutableMapping
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import pandas as pd

from traps_pipeline.base.digests import digest, file_digest
from traps_pipeline.protocol.datasets import DATASETS

if TYPE_CHECKING:
    from sklearn.pipeline import Pipeline

FOLDS = 5
THUMBNAIL = (32, 24)  # pixels of a first frame that the classifier sees, width and height
COLUMNS = ("dataset", "cue", "n_pairs", "accuracy", "half_width")


class _Cue(NamedTuple):
    """A cue: values that identify what a classifier reads, features, and classifier."""

    values: Callable[[pd.DataFrame], pd.Series]
    features: Callable[[pd.DataFrame], np.ndarray]
    model: Callable[[], Pipeline]


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
            results[key] = (cache or {}).get(key) or _accuracy(_hits(data, cue.features(data), cue.model()))
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
        return _Cue(values, lambda items: values(items).to_numpy(float)[:, None], _tree)

    def first_frames(items: pd.DataFrame) -> np.ndarray:
        thumbnails = {path: _thumbnail(root / path) for path in items["clip"].unique()}
        return np.stack([thumbnails[path] for path in items["clip"]])

    return {
        "question": _Cue(
            lambda items: pd.Series(items["question"]), lambda items: items["question"].to_numpy(), _reader
        ),
        "clip length": by_clip("duration_s"),
        "first frame": _Cue(of_clip("file_sha256"), first_frames, _viewer),
        "file size": by_clip("size_bytes"),
    }


def _hits(items: pd.DataFrame, features: np.ndarray, model: Pipeline) -> np.ndarray:
    """Return the share of correctly predicted sides of each pair (0, 0.5 or 1)."""
    from sklearn.model_selection import GroupKFold, cross_val_predict

    void = (items["side"] == "void").to_numpy()
    predictions = cross_val_predict(model, features, void, groups=items["scenario_id"], cv=GroupKFold(FOLDS))
    _, pair = np.unique(items["pair_id"].to_numpy(str), return_inverse=True)
    return np.bincount(pair, weights=predictions == void) / np.bincount(pair)


def _thumbnail(clip: Path) -> np.ndarray:
    import cv2

    from traps_pipeline.video.encode import decode_first

    return cv2.resize(decode_first(clip), THUMBNAIL, interpolation=cv2.INTER_AREA).ravel() / 255


def _reader() -> Pipeline:
    from sklearn.feature_extraction.text import TfidfVectorizer
    from sklearn.linear_model import LogisticRegression
    from sklearn.pipeline import make_pipeline

    return make_pipeline(TfidfVectorizer(ngram_range=(1, 2)), LogisticRegression(C=10, max_iter=1000))


def _viewer() -> Pipeline:
    from sklearn.linear_model import LogisticRegression
    from sklearn.pipeline import make_pipeline
    from sklearn.preprocessing import StandardScaler

    return make_pipeline(StandardScaler(), LogisticRegression(C=0.01, max_iter=1000))


def _tree() -> Pipeline:
    from sklearn.pipeline import make_pipeline
    from sklearn.tree import DecisionTreeClassifier

    return make_pipeline(DecisionTreeClassifier(max_depth=4, min_samples_leaf=2, random_state=0))
