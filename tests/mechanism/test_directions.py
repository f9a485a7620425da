"""Void directions: hand-worked vectors, controls of the same norm, the choice of pairs, and files read back."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from traps_pipeline.errors import TrapsError
from traps_pipeline.mechanism.directions import (
    KINDS,
    Origin,
    cosine_matrix,
    direction_scenarios,
    extract_directions,
    load_directions,
    save_directions,
    seeded_order,
    steered_scenarios,
    vector_digest,
)

NAMES = [f"plinko-{n:04d}" for n in range(200)]


def pair_states(layers: int = 3, pairs: int = 30, width: int = 8) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(0)
    control = rng.normal(size=(layers, pairs, width)).astype(np.float32)
    return control + rng.normal(scale=0.1, size=control.shape).astype(np.float32), control


def origin() -> Origin:
    return Origin("m", "folder", "d1", "float32", "none", "chaotic", "standard", "last", 7, ("a", "b"), "d2")


def test_the_void_direction_is_the_unit_mean_difference() -> None:
    control = np.zeros((1, 2, 2), np.float32)
    control[0] = [[1, 0], [3, 0]]
    void = control + np.array([[[6, 4], [0, 4]]], np.float32)
    made = extract_directions(void, control, [1])
    assert made.vectors["void"].tolist() == [pytest.approx([0.6, 0.8])]  # mean difference (3, 4)
    assert made.norms["void"].tolist() == [5.0]
    assert made.residual_norms.tolist() == [2.0]  # control states of length 1 and 3


def test_random_and_shuffled_directions_have_the_norm_of_the_void_direction() -> None:
    made = extract_directions(*pair_states(), [1])
    for kind in KINDS:
        assert np.allclose(np.linalg.norm(made.vectors[kind], axis=1), 1, atol=1e-6)
    again, other = (extract_directions(*pair_states(), [seed]) for seed in (1, 2))
    assert all((made.vectors[k] == again.vectors[k]).all() for k in KINDS)
    assert (made.vectors["void"] == other.vectors["void"]).all()
    assert all((made.vectors[k] != other.vectors[k]).any() for k in ("random", "shuffled"))


def test_shuffled_labels_lose_a_direction_that_all_pairs_share() -> None:
    void, control = pair_states(pairs=30)
    shift = np.zeros(8, np.float32)
    shift[2] = 5
    made = extract_directions(void + shift, control, [3])
    assert made.vectors["void"][:, 2].min() > 0.999
    # Half of the pairs are swapped, so what they share cancels and the rest is the mean of 30 differences of 0.1.
    assert made.norms["shuffled"].max() < 0.15
    for seed in range(20):  # with few pairs too: no shuffle is the true labelling or its reverse
        few = extract_directions(void[:, :4] + shift, control[:, :4], [seed])
        assert np.abs((few.vectors["void"] * few.vectors["shuffled"]).sum(axis=1)).max() < 0.9


def test_a_layer_where_the_sides_are_equal_has_no_direction() -> None:
    void, control = pair_states()
    void[0] = control[0]
    made = extract_directions(void, control, [1])
    assert not made.vectors["void"][0].any() and made.norms["void"][0] == 0
    with pytest.raises(TrapsError, match="needs two pairs at least"):
        extract_directions(void[:, :1], control[:, :1], [1])


def test_steered_scenarios_are_none_that_a_direction_comes_from_where_there_are_enough() -> None:
    steered, origin_of = steered_scenarios(NAMES, 50, 7), direction_scenarios(NAMES, 100, 7)
    assert len(steered) == 50 and len(origin_of) == 100 and not set(steered) & set(origin_of)
    assert len(set(steered_scenarios(NAMES[:120], 50, 7)) & set(direction_scenarios(NAMES[:120], 100, 7))) == 30
    assert steered != steered_scenarios(NAMES, 50, 8)


def test_a_discarded_scenario_moves_no_other() -> None:
    gone = steered_scenarios(NAMES, 50, 7)[10]
    left = [name for name in NAMES if name != gone]
    assert [n for n in seeded_order(NAMES, 7) if n != gone] == seeded_order(left, 7)
    assert len(set(steered_scenarios(left, 50, 7)) - set(steered_scenarios(NAMES, 50, 7))) == 1


def test_directions_come_back_as_they_were_saved_and_damage_is_told(tmp_path: Path) -> None:
    made, path = extract_directions(*pair_states(), [1]), tmp_path / "a" / "chaotic.safetensors"
    with pytest.raises(TrapsError, match="is missing; `traps run` makes both"):
        load_directions(path)
    save_directions(path, made, origin())
    back, said = load_directions(path)
    assert all((back.vectors[k] == made.vectors[k]).all() for k in KINDS)
    assert (back.residual_norms == made.residual_norms).all() and back.n_layers == 3
    assert said == json.loads(path.with_suffix(".json").read_text())
    assert (said["dataset"], said["n_pairs"], said["pooling"]) == ("chaotic", 2, "last")
    content = bytearray(path.read_bytes())
    content[-1] ^= 1
    path.write_bytes(content)
    with pytest.raises(TrapsError, match="damaged"):
        load_directions(path)


def test_a_direction_is_known_by_its_numbers() -> None:
    vector = np.arange(4, dtype=np.float32)
    assert vector_digest(vector) == vector_digest(vector.astype(np.float64))
    assert vector_digest(vector) != vector_digest(np.nextafter(vector, np.float32(9)))


def test_cosines_are_of_angles() -> None:
    matrix = cosine_matrix(np.array([[1, 0], [0, 1], [np.sqrt(0.5), np.sqrt(0.5)], [0, 0]]))
    assert matrix[:3, :3] == pytest.approx(
        np.array([[1, 0, 0.70710678], [0, 1, 0.70710678], [0.70710678, 0.70710678, 1]])
    )
    assert np.isnan(matrix[3]).all()
