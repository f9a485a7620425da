"""Measure what gives recorded voids away, and find pairs that show nearly the same (docs/recorded.md).

A cue is what one look without understanding tells: a clip's length, a question's words. Its J is that of a classifier
of the cue alone, fitted on other scenarios (five folds).
"""

import json
from collections.abc import Iterator, Mapping, Sequence
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np

from traps_pipeline.base.files import write_text
from traps_pipeline.base.terminal import text_table
from traps_pipeline.base.wording import count_noun
from traps_pipeline.benchmark.recorded_clips import clip_path
from traps_pipeline.protocol.datasets import SIDES, datasets_of_category
from traps_pipeline.scenes.worlds.spec import SceneSpec

FOLDS, LISTED = 5, 20  # near duplicates that are named
FILE = "leaks.json"  # in the benchmark's folder
NUMBERS = ("clip length", "file size", "bytes a frame", "brightness", "detail", "motion at the end")
_PICTURE = (32, 24)  # pixels of a first or last frame that a classifier sees
_TINY, _ALIKE_LEVELS = (16, 12), 8  # size of a near duplicate's pictures, by how much of 255 they differ at most


def measure_leaks(records: Sequence[SceneSpec], out: Path) -> str:
    """Measure how well single cues of recorded clips tell control from void; write JSON, return text."""
    folder = out / "released"
    looks = {(r.scenario_id, side): _look(clip_path(folder, r.scenario_id, side)) for r in records for side in SIDES}
    rows = [*_rows(records, looks)]
    write_text(out / FILE, json.dumps(rows, indent=1) + "\n")
    cells = [(row["dataset"], row["cue"], row["n_pairs"], f"{row['j']:+.2f} ± {row['half_width']:.2f}") for row in rows]
    lines = [text_table(("dataset", "cue alone", "pairs", "J, held-out pairs"), cells, left=(0, 1))] if rows else []
    lines += [] if rows else [f"what gives voids away: not measured, since no dataset has {FOLDS} pairs"]
    alone = sum("cover" in spec.void and "control_cover" not in spec.evidence for spec in records)
    board = f"a board comes in the void alone in {count_noun(alone, 'pair')}, which tells sides: give control_cover"
    alike = [*_near_duplicates(looks)]
    more = [f"and {len(alike) - LISTED:,} more such pairs"] if len(alike) > LISTED else []
    return "\n".join([*lines, *([board] if alone else []), *alike[:LISTED], *more])


def _look(clip: Path) -> dict[str, Any]:
    """Return a clip's NUMBERS, and small pictures of it. Raises DamagedClip."""
    import cv2

    from traps_pipeline.video.encode import decode

    frames, size = decode(clip)[0], clip.stat().st_size
    grey = np.stack([cv2.cvtColor(frame, cv2.COLOR_RGB2GRAY) for frame in frames]).astype(np.float32)
    detail = np.mean([np.abs(cv2.Laplacian(frame, cv2.CV_32F)).mean() for frame in grey[:: len(grey) // 5 or 1]])
    numbers = (len(grey), size, size / len(grey), grey.mean(), detail, np.abs(np.diff(grey[-4:], axis=0)).mean())
    ends = [cv2.resize(frames[k], _PICTURE, interpolation=cv2.INTER_AREA).ravel() / 255 for k in (0, -1)]
    chosen = frames[np.linspace(0, len(frames) - 1, 5).astype(int)]
    tiny = np.stack([cv2.resize(frame, _TINY, interpolation=cv2.INTER_AREA) for frame in chosen]).astype(np.int16)
    return {"numbers": [float(number) for number in numbers], "ends": ends, "tiny": tiny}


def _rows(records: Sequence[SceneSpec], looks: Mapping[tuple[str, str], Any]) -> Iterator[dict[str, Any]]:
    from sklearn.feature_extraction.text import TfidfVectorizer
    from sklearn.linear_model import LogisticRegression
    from sklearn.pipeline import make_pipeline
    from sklearn.preprocessing import StandardScaler
    from sklearn.tree import DecisionTreeClassifier

    words = make_pipeline(TfidfVectorizer(ngram_range=(1, 2)), LogisticRegression(C=10.0))
    pictures = make_pipeline(StandardScaler(), LogisticRegression(C=0.01, max_iter=1000))
    number = DecisionTreeClassifier(max_depth=4, min_samples_leaf=2, random_state=0)
    datasets = {name: None for record in records for name in datasets_of_category(record.category)[:1]}
    for dataset in datasets:
        members = [record for record in records if datasets_of_category(record.category)[0] == dataset]
        if len(members) < FOLDS:
            continue
        seen = [looks[record.scenario_id, side] for record in members for side in SIDES]
        texts = [text for record in members for text in (record.question, record.ill_posed_question)]
        numbers = np.array([look["numbers"] for look in seen])
        yield _row(f"{dataset}_ill_posed", "question", texts, words)
        for k, name in enumerate(NUMBERS):
            yield _row(dataset, name, numbers[:, [k]], number)
        for k, name in enumerate(("first frame", "last frame")):
            yield _row(dataset, name, np.stack([look["ends"][k] for look in seen]), pictures)
        yield _row(dataset, "all numbers, learned", numbers, pictures)


def _row(dataset: str, cue: str, features: Any, classifier: Any) -> dict[str, Any]:
    """Return the J of a cue; features of each scenario's control and void, in turn."""
    from sklearn.model_selection import GroupKFold, cross_val_predict

    n_pairs = len(features) // 2
    void, scenario = np.tile([False, True], n_pairs), np.repeat(np.arange(n_pairs), 2)
    said = cross_val_predict(classifier, features, void, groups=scenario, cv=GroupKFold(FOLDS))
    j = said[1::2].astype(float) - said[::2]  # of each pair: 1, 0 or -1
    half_width = 1.96 * j.std(ddof=1) / np.sqrt(n_pairs)  # of a normal interval over pairs
    return {"dataset": dataset, "cue": cue, "n_pairs": n_pairs, "j": float(j.mean()), "half_width": float(half_width)}


def _near_duplicates(looks: Mapping[tuple[str, str], Any]) -> Iterator[str]:
    """Yield a line for each two scenarios whose controls show nearly the same."""
    pictures = {scenario_id: look["tiny"] for (scenario_id, side), look in looks.items() if side == "control"}
    for (one, picture), (other, other_picture) in combinations(pictures.items(), 2):
        if np.abs(picture - other_picture).max() <= _ALIKE_LEVELS:
            yield f"{one} and {other}: controls show nearly the same; leave one out, or say so where you publish"
