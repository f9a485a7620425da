"""Find lookalikes among records, so that a family shows many different scenes."""

from collections.abc import Mapping
from itertools import combinations

import numpy as np

from traps_pipeline.scenes.worlds.spec import SceneSpec
from traps_pipeline.scenes.worlds.world import World

NEAR_BITS = 8  # two pictures whose hashes differ in so few look alike
NEAR_SHARE = 0.1  # of a family's records may have another one that looks like them


def perceptual_hash(frame: np.ndarray) -> int:
    """Return the 64-bit pHash (Zauner, 2010) of an RGB frame, (H, W, 3)."""
    import cv2  # here, since the graph imports the sampler, and nothing heavy

    grey = cv2.resize(cv2.cvtColor(frame, cv2.COLOR_RGB2GRAY), (32, 32), interpolation=cv2.INTER_AREA)
    low = cv2.dct(grey.astype(np.float32))[:8, :8].ravel()
    return int("".join("1" if is_above else "0" for is_above in low > np.median(low)), 2)


def frame_hash(spec: SceneSpec, qpos: np.ndarray) -> int:
    """Return the hash of the first frame of a record's clip. qpos: (F, nq)."""
    with World.of_record(spec, qpos).closed_renderer() as renderer:
        (first,) = renderer.frames(qpos[:1])
    return perceptual_hash(first)


def lookalikes(hashes: Mapping[str, int]) -> dict[str, str]:
    """Return by id each record that looks like another, and that other. hashes: id -> hash."""
    neighbour_of = dict[str, str]()
    for first, second in combinations(hashes, 2):
        if (hashes[first] ^ hashes[second]).bit_count() <= NEAR_BITS:
            neighbour_of.setdefault(first, second)
            neighbour_of.setdefault(second, first)
    return neighbour_of


def excess_lookalike(hashes: Mapping[str, int], new: int, count: int) -> str | None:
    """Return the id of the record that a new clip resembles, if that is a lookalike too many among `count`."""
    pairs = lookalikes({**hashes, "new": new})
    return pairs.get("new") if len(pairs) > NEAR_SHARE * count else None
