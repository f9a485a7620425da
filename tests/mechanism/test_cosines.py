"""Cosines of directions without the noise of few pairs and of shared controls, and split halves: worked by hand."""

from __future__ import annotations

import numpy as np
import pytest

from traps_pipeline.mechanism.cosines import PairDifferences, apart, disattenuated, split_half

ONCE = np.ones((1, 6))


def test_products_of_different_scenarios_alone_count() -> None:
    one = PairDifferences(np.array([[2.0, 1.0], [2.0, -1.0]]), np.array([0, 1]))
    other = PairDifferences(np.array([[1.0, 1.0], [1.0, -1.0], [1.0, 0.0]]), np.array([2, 3, 4]))
    assert apart(one, one, ONCE) == pytest.approx(3)  # (2, 1)(2, -1), not the squares 5
    assert apart(other, other, ONCE) == pytest.approx(2 / 3)  # of 0, 1 and 1
    assert disattenuated(one, other, ONCE) == pytest.approx(2 / np.sqrt(3 * 2 / 3))
    shared = PairDifferences(other.values[:2], np.array([1, 5]))  # one of its scenarios is one of the first's
    assert apart(one, shared, ONCE) == pytest.approx((3 + 1 + 3) / 3)  # without (2, -1)(1, 1)
    twice = np.array([[1.0, 1, 0, 2, 0, 0]])  # scenario 3 drawn twice: never multiplied with itself
    assert apart(one, other, twice) == pytest.approx((1 + 3) / 2)
    assert np.isnan(apart(other, other, twice))


def test_a_direction_that_is_all_noise_has_no_disattenuated_cosine() -> None:
    noise = PairDifferences(np.array([[1.0, 0.0], [-1.0, 0.0]]), np.array([0, 1]))
    assert np.isnan(disattenuated(noise, noise, ONCE))


def test_noise_hides_a_common_direction_and_shared_controls_feign_one() -> None:
    rng, d, n = np.random.default_rng(0), 400, 60
    true = np.full(d, 0.2)  # its length is 4, that of a pair's noise 20 and of their mean's 2.6
    one, other = (PairDifferences(true + rng.normal(size=(n, d)), np.arange(n) + n * k) for k in (0, 1))
    assert cosine(one, other) < 0.8 and disattenuated(one, other, np.ones((1, 2 * n))) == pytest.approx(1, abs=0.1)
    assert split_half(one, [1]) < 0.6 < split_half(PairDifferences(one.values + 1, one.scenario), [1])
    control = 3 * rng.normal(size=(n, d))
    voids = [5 * np.eye(d)[k] + rng.normal(size=(n, d)) for k in (0, 1)]  # two directions at a right angle
    one, other = (PairDifferences(void - control, np.arange(n)) for void in voids)
    assert cosine(one, other) > 0.4 and abs(disattenuated(one, other, np.ones((1, n)))[0]) < 0.15


def cosine(one: PairDifferences, other: PairDifferences) -> float:
    means = [of.values.mean(axis=0) for of in (one, other)]
    return float(means[0] @ means[1] / np.prod([np.linalg.norm(mean) for mean in means]))
