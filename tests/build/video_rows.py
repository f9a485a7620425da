"""Rows of the videos table."""

from __future__ import annotations

from typing import Any

from traps_pipeline.storage.benchmark_tables import VideoRow

PARTITION = {"category": "plinko"}


def clip(scenario: str, side: str = "control", **changes: Any) -> VideoRow:
    """A row of the videos table."""
    texts = {name: f"{name} of {scenario}" for name in ("path", "file_sha256", "frames_sha256", "scene_hash")}
    numbers = {"n_frames": 50, "fps": 10, "width": 480, "height": 360, "duration_s": 5.0, "size_bytes": 1000}
    row = {"scenario_id": scenario, "category": "plinko", "side": side, "benchmark_version": "0.1.0"}
    return VideoRow(**(row | texts | numbers | changes))
