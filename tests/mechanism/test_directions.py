"""Void directions: hand-worked vectors and cosines, controls of the same norm, the choice of pairs, files read back."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from tests.build.errors import raises
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.mechanism.cosines import PairDifferences, cross_product, disattenuated
from traps_pipeline.mechanism.directions import (
    KINDS,
    NULLS,
    Origin,
    cosine_matrix,
    direction_scenarios,
    extract_directions,
    load_directions,
    save_directions,
    seeded_order,
    steered_scenarios,
)

NAMES = [f"plinko-{n:04d}" for n in range(200)]
ORIGIN = Origin("m", "folder", "d1", "float32", "none", "chaotic", "standard", "last", 7, ("a", "b"), "d2")


def pair_states() -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(0)
    control = rng.normal(size=(3, 30, 8)).astype(np.float32)  # layers, pairs, width
    return control + rng.normal(scale=0.1, size=control.shape).astype(np.float32), control


def test_the_void_direction_is_the_unit_mean_difference() -> None:
    control = np.zeros((1, 2, 2), np.float32)
    control[0] = [[1, 0], [3, 0]]
    void = control + np.array([[[6, 4], [0, 4]]], np.float32)
    made = extract_directions(void, control, [1])
    assert made.void.tolist() == [pytest.approx([0.6, 0.8])]  # mean difference (3, 4)
    assert made.gaps.tolist() == [5.0]
    assert made.residual_norms.tolist() == [2.0]  # control states of length 1 and 3


def test_nulls_are_unit_vectors_orthogonal_to_the_void_direction() -> None:
    made = extract_directions(*pair_states(), [1], draws=20)
    for null in NULLS:
        assert made.vectors[null].shape == (20, 3, 8)
        assert np.allclose(np.linalg.norm(made.vectors[null], axis=2), 1, atol=1e-6)
        assert np.abs((made.vectors[null] * made.void).sum(axis=2)).max() < 1e-6
    again, other = (extract_directions(*pair_states(), [seed]) for seed in (1, 2))
    more = extract_directions(*pair_states(), [1], NULLS[1:])  # a kind does not depend on which others there are
    for null in NULLS:
        assert (again.vectors[null][0] != other.vectors[null][0]).any()
    assert all((again.vectors[null] == more.vectors[null]).all() for null in NULLS[1:]) and NULLS[0] not in more.vectors
    assert (again.void == other.void).all()


def test_a_shuffled_null_has_none_of_what_all_pairs_share() -> None:
    """With four pairs that differ by (5, +-1) the swapped mean differences have parts along the void direction; what is
    left is the second axis alone."""
    control = np.zeros((1, 4, 2), np.float32)
    void = np.array([[[5, 1], [5, -1], [5, 1], [5, -1]]], np.float32)
    made = extract_directions(void, control, [3], draws=10)
    assert made.void.tolist() == [[1, 0]] and made.gaps.tolist() == [5]
    lengths = np.linalg.norm(made.vectors["shuffled"], axis=2)[:, 0]
    assert set(np.round(lengths, 6)) <= {0.0, 1.0} and 1.0 in lengths  # zero where the swaps cancel the second axis too
    assert np.abs(made.vectors["shuffled"][..., 0]).max() == 0


def test_covariance_nulls_lie_where_states_vary() -> None:
    rng = np.random.default_rng(0)
    control = rng.normal(size=(1, 50, 8)).astype(np.float32) * np.array([1, 9, 1, 1, 1, 1, 1, 1], np.float32)
    void = rng.normal(size=(1, 50, 8)).astype(np.float32) * np.array([1, 9, 1, 1, 1, 1, 1, 1], np.float32)
    void[..., 0] += 20
    made = extract_directions(void, control, [1], draws=50)
    along = {null: np.mean(made.vectors[null][:, 0, 1] ** 2) for null in NULLS}
    assert along["covariance"] > 0.6 and along["isotropic"] < 0.3  # 81 / 87 of the variance, against 1 / 7


def test_a_layer_where_the_sides_are_equal_has_no_direction() -> None:
    void, control = pair_states()
    void[0] = control[0]
    made = extract_directions(void, control, [1])
    assert not made.void[0].any() and made.gaps[0] == 0
    assert not any(made.vectors[null][:, 0].any() for null in NULLS)  # nothing to be orthogonal to
    with raises(TrapsError, "mechanism.directions.extract_directions"):
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
    with raises(TrapsError, "mechanism.directions.load_directions", str(path)):
        load_directions(path)
    save_directions(path, made, ORIGIN)
    back, said = load_directions(path)
    assert all((back.vectors[k] == made.vectors[k]).all() for k in KINDS)
    assert (back.residual_norms == made.residual_norms).all() and (back.gaps == made.gaps).all() and back.n_layers == 3
    assert said == json.loads(path.with_suffix(".json").read_text())
    assert (said["dataset"], said["n_pairs"], said["pooling"]) == ("chaotic", 2, "last")
    content = bytearray(path.read_bytes())
    content[-1] ^= 1
    path.write_bytes(content)
    with raises(TrapsError, "mechanism.directions.load_directions", str(path)):
        load_directions(path)


def test_cosines_are_of_angles() -> None:
    matrix = cosine_matrix(np.array([[1, 0], [0, 1], [np.sqrt(0.5), np.sqrt(0.5)], [0, 0]]))
    half = np.sqrt(0.5)
    assert matrix[:3, :3] == pytest.approx(np.array([[1, 0, half], [0, 1, half], [half, half, 1]]))
    assert np.isnan(matrix[3]).all()


ONCE = np.ones((1, 6))


def test_products_of_different_scenarios_alone_count() -> None:
    one = PairDifferences(np.array([[2.0, 1.0], [2.0, -1.0]]), np.array([0, 1]))
    other = PairDifferences(np.array([[1.0, 1.0], [1.0, -1.0], [1.0, 0.0]]), np.array([2, 3, 4]))
    assert cross_product(one, one, ONCE) == pytest.approx(3)  # (2, 1)(2, -1), not the squares 5
    assert cross_product(other, other, ONCE) == pytest.approx(2 / 3)  # of 0, 1 and 1
    assert disattenuated(one, other, ONCE) == pytest.approx(2 / np.sqrt(3 * 2 / 3))
    shared = PairDifferences(other.values[:2], np.array([1, 5]))  # one of its scenarios is one of the first's
    assert cross_product(one, shared, ONCE) == pytest.approx((3 + 1 + 3) / 3)  # without (2, -1)(1, 1)
    twice = np.array([[1.0, 1, 0, 2, 0, 0]])  # scenario 3 drawn twice: never multiplied with itself
    assert cross_product(one, other, twice) == pytest.approx((1 + 3) / 2)
    assert np.isnan(cross_product(other, other, twice))


def test_a_direction_that_is_all_noise_has_no_disattenuated_cosine() -> None:
    noise = PairDifferences(np.array([[1.0, 0.0], [-1.0, 0.0]]), np.array([0, 1]))
    assert np.isnan(disattenuated(noise, noise, ONCE))
