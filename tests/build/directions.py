"""States of pairs, and where directions come from."""

from __future__ import annotations

import numpy as np

from traps_pipeline.mechanism.directions import Origin


def pair_states(layers: int = 3, pairs: int = 30, width: int = 8) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(0)
    control = rng.normal(size=(layers, pairs, width)).astype(np.float32)
    return control + rng.normal(scale=0.1, size=control.shape).astype(np.float32), control


def origin() -> Origin:
    return Origin("m", "folder", "d1", "float32", "none", "chaotic", "standard", "last", 7, ("a", "b"), "d2")
