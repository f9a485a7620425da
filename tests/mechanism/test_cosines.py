"""Cosines of directions without the noise of few pairs and of shared controls, and split halves: worked by hand."""

from __future__ import annotations

import numpy as np
import pytest

from traps_pipeline.mechanism.cosines import PairDifferences, cross_product, disattenuated

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
