"""Which scenarios a reviewer sees first: flagged ones by how much, those that look alike side by side."""

from __future__ import annotations

import re
import time
from pathlib import Path

import numpy as np
import pandas as pd

from traps_pipeline.servers.duplicates import Comparison, fingerprint, neighbours
from traps_pipeline.servers.queue import queue
from traps_pipeline.video.encode import encode

FLAGS = pd.DataFrame({"judges": [3, 0, 7], "models": [0.0, 0.25, 0.1]}, index=pd.Index(["a-1", "a-2", "a-3"]))


def test_queues_are_in_order_and_lose_what_is_reviewed() -> None:
    scenarios, reviewed = ["a-1", "a-2", "a-3", "a-4"], frozenset({"a-3"})
    alike = {"a-4": 0.01, "a-1": 0.05}
    ordered = {name: queue(name, scenarios, frozenset(), FLAGS, alike) for name in ("judges", "models", "alike")}
    assert ordered == {"judges": ["a-3", "a-1"], "models": ["a-2", "a-3"], "alike": ["a-4", "a-1"]}
    assert queue("unreviewed", scenarios, reviewed, FLAGS, alike) == ["a-1", "a-2", "a-4"]
    assert queue("judges", scenarios, reviewed, FLAGS, alike) == ["a-1"]
    assert queue("all", scenarios, reviewed, FLAGS, alike) == scenarios
    assert queue("judges", scenarios, reviewed, pd.DataFrame(), alike) == []


def clip(folder: Path, name: str, seed: int, noise: int = 0) -> Path:
    """Ten frames of coarse random squares; the same seed with noise is nearly the same clip."""
    rng = np.random.default_rng(seed)
    coarse = rng.integers(0, 256, (10, 6, 8, 3))
    frames = coarse.repeat(20, axis=1).repeat(20, axis=2) + np.random.default_rng(noise).integers(
        0, noise + 1, (10, 120, 160, 3)
    )
    encode([frame.clip(0, 255).astype(np.uint8) for frame in frames], folder / f"{name}.mp4", fps=10)
    return folder / f"{name}.mp4"


def test_the_nearest_of_a_family_is_found_and_a_torn_clip_is_left_out(tmp_path: Path) -> None:
    clips = {"a-1": clip(tmp_path, "a-1", 1), "a-2": clip(tmp_path, "a-2", 2), "a-3": clip(tmp_path, "a-3", 1, noise=6)}
    clips |= {"b-1": clip(tmp_path, "b-1", 1)}  # the same picture, but of another family
    prints = {name: fingerprint(path) for name, path in clips.items()}
    found = neighbours(prints, {name: name[0] for name in clips})
    assert set(found) == {"a-1", "a-2", "a-3"}
    assert (found["a-1"].scenario_id, found["a-3"].scenario_id) == ("a-3", "a-1")
    assert found["a-1"].distance < 0.1 < found["a-2"].distance
    (tmp_path / "a-2.mp4").write_bytes(clips["a-2"].read_bytes()[:900])
    comparison = Comparison(clips, {name: name[0] for name in clips})
    assert (re.findall(r"\d+", comparison.progress), comparison.found) == (["0", "4"], {})
    comparison.start()
    until = time.monotonic() + 300
    while comparison.progress and time.monotonic() < until:
        time.sleep(0.02)
    assert set(comparison.found) == {"a-1", "a-3"}
