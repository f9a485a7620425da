"""Which records look alike: a family that is drawn shows many scenes, and not one scene many times."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import combinations

import numpy as np

from traps_pipeline.scenes.worlds.spec import SceneSpec
from traps_pipeline.scenes.worlds.world import World

NEAR_BITS = 8  # of 64: two pictures whose hashes differ in so few look alike
NEAR_SHARE = 0.1  # of a family's records may have another one that looks like them


def perceptual_hash(frame: np.ndarray) -> int:
    """Return 64 bits: which of the 8 x 8 lowest cosine frequencies of the 32 x 32 grey picture lie above their median.
    frame: (H, W, 3) RGB. The pHash of Zauner, Implementation and Benchmarking of Perceptual Image Hash Functions, 2010.
    """
    import cv2  # here, since the graph imports the sampler, and nothing heavy

    grey = cv2.resize(cv2.cvtColor(frame, cv2.COLOR_RGB2GRAY), (32, 32), interpolation=cv2.INTER_AREA)
    low = cv2.dct(grey.astype(np.float32))[:8, :8].ravel()
    return int("".join("1" if value > np.median(low) else "0" for value in low), 2)


def first_look(spec: SceneSpec, qpos: np.ndarray) -> int:
    """Return the hash of the first frame of a record's clip. qpos: its trajectory, (F, nq)."""
    with World.of_record(spec, qpos).closed_renderer() as renderer:
        (first,) = renderer.frames(qpos[:1])
    return perceptual_hash(first)


def alike(looks: Mapping[str, int]) -> dict[str, str]:
    """Return, for each record that looks like another, that other. looks: record to its hash."""
    neighbour_of = dict[str, str]()
    for one, other in combinations(looks, 2):
        if (looks[one] ^ looks[other]).bit_count() <= NEAR_BITS:
            neighbour_of.setdefault(one, other)
            neighbour_of.setdefault(other, one)
    return neighbour_of


def too_alike(looks: Mapping[str, int], new: int, count: int) -> str | None:
    """Return the record that a new hash looks like, if with it more than NEAR_SHARE of `count` records have such
    another.
    """
    pairs = alike({**looks, "new": new})
    return pairs.get("new") if len(pairs) > NEAR_SHARE * count else None
