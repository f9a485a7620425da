"""Clips and what is sent of them."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from traps_pipeline.base.digests import file_digest
from traps_pipeline.storage.media import MediaSpec
from traps_pipeline.video.encode import encode

VIDEO = MediaSpec(profile="video", fps=5)


IMAGES = MediaSpec(profile="images", fps=5)


def drawn(count: int, height: int = 120, width: int = 160) -> list[np.ndarray]:
    """A bright square that moves over a gradient, 2 px a frame; no two frames alike."""
    ramp = np.linspace(0, 200, width).astype(np.uint8)
    frames = []
    for i in range(count):
        frame = np.repeat(np.tile(ramp, (height, 1))[..., None], 3, axis=2)
        frame[40:80, 2 * i : 2 * i + 40] = (230, 40, 30)
        frames.append(frame)
    return frames


def write_clip(path: Path, count: int = 50, fps: int = 10) -> tuple[Path, str]:
    encode(drawn(count), path, fps)
    return path, file_digest(path)
