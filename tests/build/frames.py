"""Frames without a renderer."""

from __future__ import annotations

import numpy as np


def frames(count: int = 20, height: int = 120, width: int = 160, step: int = 5) -> list[np.ndarray]:
    """A bright square that moves over a gradient by so many pixels a frame; no two frames alike."""
    ramp = np.linspace(0, 200, width).astype(np.uint8)
    drawn = []
    for i in range(count):
        frame = np.repeat(np.tile(ramp, (height, 1))[..., None], 3, axis=2)
        frame[40:80, step * i : step * i + 40] = (230, 40, 30)
        drawn.append(frame)
    return drawn
