"""A cue that differs between the sides is found, one that does not gives chance: on real clips with a planted cue."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from traps_pipeline.base.digests import file_digest
from traps_pipeline.benchmark.shortcuts import by_words, shortcuts
from traps_pipeline.report.figures.grids import shortcut_figure
from traps_pipeline.video.encode import encode

SCENARIOS = 10


def _clip(path: Path, rng: np.random.Generator, frames: int, occluder: bool) -> dict[str, object]:
    video = np.full((frames, 96, 128, 3), 180, np.uint8)
    video[:, 60:80, 10 : 20 + rng.integers(80)] = rng.integers(0, 255, 3)  # scenes differ
    if occluder:
        video[:, 20:50, 40:90] = (20, 30, 90)
    encode(list(video), path, 10)
    found = {"path": path.name, "duration_s": frames / 10, "size_bytes": path.stat().st_size}
    return {**found, "file_sha256": file_digest(path)}


@pytest.fixture(scope="module")
def table(tmp_path_factory: pytest.TempPathFactory) -> pd.DataFrame:
    """occlusion: an occluder in the void's first frame; chaotic: the void is shorter; ill-posed: another question."""
    root, rng = tmp_path_factory.mktemp("clips"), np.random.default_rng(0)
    items: list[dict[str, str]] = []
    clips: list[dict[str, object]] = []
    for taxonomy in ("occlusion", "chaotic"):
        for k in range(SCENARIOS):
            name = f"{taxonomy}-{k}"
            scene = np.random.default_rng(k)
            clips.append(_clip(root / f"{name}-control.mp4", scene, 10, occluder=False))
            scene = np.random.default_rng(k)  # the same scene again
            hidden = taxonomy == "occlusion"
            clips.append(_clip(root / f"{name}-void.mp4", scene, 10 if hidden else 5 + int(rng.integers(3)), hidden))
            for dataset, side, clip, question in (
                (taxonomy, "control", "control", "Does it fall?"),
                (taxonomy, "void", "void", "Does it fall?"),
                (f"{taxonomy}_ill_posed", "control", "control", "Does it fall?"),
                (f"{taxonomy}_ill_posed", "void", "control", "What is its mass in grams?"),
            ):
                items.append(
                    {
                        "dataset": dataset,
                        "scenario_id": name,
                        "pair_id": f"{dataset}:{name}",
                        "side": side,
                        "question": question,
                        "clip": f"{name}-{clip}.mp4",
                    }
                )
    return shortcuts(pd.DataFrame(items), pd.DataFrame(clips), root)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("dataset", "telling", "silent"),
    [
        ("occlusion", {"first frame"}, {"question", "clip length"}),
        ("chaotic", {"clip length", "file size"}, {"question", "first frame"}),
        ("occlusion_ill_posed", {"question"}, {"clip length", "first frame", "file size"}),
        ("chaotic_ill_posed", {"question"}, {"clip length", "first frame", "file size"}),
    ],
)
def test_only_the_planted_cue_tells_control_from_void(
    table: pd.DataFrame, dataset: str, telling: set[str], silent: set[str]
) -> None:
    rows = table.loc[table["dataset"] == dataset].set_index("cue")
    assert (rows["n_pairs"] == SCENARIOS).all()
    assert (rows.loc[sorted(telling), "accuracy"] >= 0.8).all(), rows
    assert (rows.loc[sorted(silent), "accuracy"] == 0.5).all(), rows


@pytest.mark.slow  # imports scikit-learn
def test_words_are_classified_as_by_scikit_learn() -> None:
    from sklearn.feature_extraction.text import TfidfVectorizer
    from sklearn.linear_model import LogisticRegression
    from sklearn.pipeline import make_pipeline

    rng = np.random.default_rng(0)
    words = ["which", "what", "colour", "ball", "block", "falls", "first", "is", "heavier", "Blue", "red", "a"]
    texts = np.array([" ".join(rng.choice(words, rng.integers(1, 12))) for _ in range(90)], object)
    void = rng.random(90) < np.where([text.count("is") > 0 for text in texts], 0.8, 0.3)
    model = make_pipeline(TfidfVectorizer(ngram_range=(1, 2)), LogisticRegression(C=10, max_iter=1000, tol=1e-10))
    expected = model.fit(texts[:60], void[:60]).predict(texts[60:])
    assert 5 < expected.sum() < 25
    assert by_words(texts[:60], void[:60], texts[60:]).tolist() == expected.tolist()


@pytest.mark.slow
def test_no_interval_of_the_figure_goes_beyond_what_a_share_can_be(table: pd.DataFrame) -> None:
    figure = shortcut_figure(table.assign(half_width=0.4))
    ends = [x for bars in figure.axes[0].collections for segment in bars.get_segments() for x, _ in segment]  # type: ignore[attr-defined]
    assert len(ends) > 10 and max(ends) == 1 and min(ends) >= 0
