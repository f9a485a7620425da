"""Evidence that a panel hides: pixel counts, and an ablation that catches shadows and reflections as well."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from traps_pipeline.scenes.render import Renderer


def hidden_from(
    renderer: Renderer, qpos: np.ndarray, decisive: Sequence[str], hidden: Sequence[str] = ()
) -> int | None:
    """First frame of the void from which no decisive geom has a pixel until the end; None if there is no such frame
    or if the hidden element is visible in any frame."""
    counts = renderer.visible_pixels(qpos, [*decisive, *hidden], panel=True)
    if counts[:, len(decisive) :].any():
        return None
    seen = np.flatnonzero(counts[:, : len(decisive)].any(axis=1))
    first = int(seen[-1]) + 1 if seen.size else 0
    return first if first < len(qpos) else None


def ablation_pixels(renderer: Renderer, qpos: np.ndarray, geoms: Sequence[str]) -> int:
    """How many void pixels change, over the given frames, when the geoms are taken away. 0 proves that nothing of
    them, shadow included, reaches the eye."""
    with_them = renderer.frames(qpos, panel=True)
    without = renderer.frames(qpos, panel=True, without=geoms)
    return sum(int((a != b).any(axis=2).sum()) for a, b in zip(with_them, without, strict=True))
