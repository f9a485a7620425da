"""Measure how well superficial cues (wording, length, file size) tell the side.

A model that abstained on such a cue alone would score without having seen anything, so a reader must know their size.
They are reported beside the observer and are no gate: a cut clip *is* shorter.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd

from traps_pipeline.protocol.datasets import DATASETS

if TYPE_CHECKING:
    from sklearn.pipeline import Pipeline

FOLDS = 5
THUMBNAIL = (32, 24)  # pixels of a first frame that the classifier sees, width and height
COLUMNS = ("dataset", "cue", "n_pairs", "accuracy", "half_width")


def shortcuts(items: pd.DataFrame, videos: pd.DataFrame, root: Path) -> pd.DataFrame:
    """Return how accurately each cue predicts the side, per dataset; 0.5 is chance.

    items are ITEMS rows, videos VIDEOS rows, clips lie under root. Columns: dataset, cue, n_pairs, accuracy, half_width
    (of a 95 % normal interval over pairs). Every scenario is predicted by a classifier fitted on the others (five
    folds), with both its sides in one fold. Datasets of fewer than five scenarios are left out. Raises DamagedClip.
    """
    clips = videos.drop_duplicates("path").set_index("path")
    cues = _cues(clips, root)
    rows = []
    for dataset in DATASETS:
        here = items.loc[items["dataset"] == dataset].reset_index(drop=True)
        if here["scenario_id"].nunique() < FOLDS:
            continue
        for cue, (features, model) in cues.items():
            hits = _hits(here, features(here), model())
            half_width = 1.96 * hits.std(ddof=1) / np.sqrt(len(hits))
            rows.append((dataset, cue, len(hits), float(hits.mean()), float(half_width)))
    return pd.DataFrame(rows, columns=list(COLUMNS))


Features = Callable[[pd.DataFrame], "np.ndarray"]


def _cues(clips: pd.DataFrame, root: Path) -> Mapping[str, tuple[Features, Callable[[], Pipeline]]]:
    def of_clip(column: str) -> Features:
        return lambda items: clips.loc[items["clip"], [column]].to_numpy(float)

    def first_frames(items: pd.DataFrame) -> np.ndarray:
        thumbnails = {path: _thumbnail(root / path) for path in items["clip"].unique()}
        return np.stack([thumbnails[path] for path in items["clip"]])

    return {
        "question": (lambda items: items["question"].to_numpy(), _reader),
        "clip length": (of_clip("duration_s"), _tree),
        "first frame": (first_frames, _viewer),
        "file size": (of_clip("size_bytes"), _tree),
    }


def _hits(items: pd.DataFrame, features: np.ndarray, model: Pipeline) -> np.ndarray:
    """Return the share of correctly predicted sides of each pair (0, 0.5 or 1)."""
    from sklearn.model_selection import GroupKFold, cross_val_predict

    void = (items["side"] == "void").to_numpy()
    predicted = cross_val_predict(model, features, void, groups=items["scenario_id"], cv=GroupKFold(FOLDS))
    _, pair = np.unique(items["pair_id"].to_numpy(str), return_inverse=True)
    return np.bincount(pair, weights=predicted == void) / np.bincount(pair)


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
