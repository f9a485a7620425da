"""Records that look alike: few of a family may."""

from __future__ import annotations

import numpy as np
import pytest

from traps_pipeline.base.paths import RELEASED
from traps_pipeline.benchmark.records import load_released
from traps_pipeline.scenes.draw.likeness import NEAR_SHARE, alike, first_look, perceptual_hash, too_alike
from traps_pipeline.scenes.worlds.spec import load_trajectory


def test_a_hash_tells_places_and_not_shades() -> None:
    blocks = np.random.default_rng(0).integers(20, 200, (8, 6))
    picture = np.kron(blocks, np.ones((60, 60))).astype(np.uint8)[:, :, None].repeat(3, axis=2)
    assert perceptual_hash(picture) == perceptual_hash(picture + 40)
    assert (perceptual_hash(picture) ^ perceptual_hash(picture[:, ::-1].copy())).bit_count() > 8


def test_records_whose_hashes_differ_in_eight_bits_are_alike_and_in_nine_are_not() -> None:
    assert alike({"a": 0, "b": 0xFF, "c": 0x1FF << 20}) == {"a": "b", "b": "a"}


def test_a_tenth_of_a_family_may_have_a_neighbour() -> None:
    looks = {f"x-{k}": 0xFFFF << 16 * k for k in range(4)}  # sixteen bits and more apart
    assert too_alike(looks, 0xFFFF, 20) is None  # two of twenty
    assert too_alike(looks, 0xFFFF, 19) == "x-0"
    assert too_alike(looks, 0xFFFF0000 << 8, 19) is None
    assert too_alike({**looks, "x-9": 0xFFFF}, 0xFFFF0001, 39) == "x-1"  # two were alike, four are more than 3.9
    assert too_alike({**looks, "x-9": 0xFFFF}, 0xFFFF << 8, 19) is None  # it has no part in it


@pytest.mark.slow
def test_few_released_boards_of_plinko_look_like_another() -> None:  # of all families the one where most did
    specs = {id_: spec for id_, spec in load_released().items() if spec.family == "plinko"}
    files = {id_: RELEASED / "trajectories" / f"{id_}.npz" for id_ in specs}
    looks = {id_: first_look(spec, load_trajectory(files[id_], spec.trajectory_sha256)) for id_, spec in specs.items()}
    assert len(looks) == 50 and len(alike(looks)) <= NEAR_SHARE * 50
