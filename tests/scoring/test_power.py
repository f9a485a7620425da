"""The precision that a plan promises is what the bootstrap then finds."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest

from traps_pipeline.base.partitions import DATASETS
from traps_pipeline.scoring.bootstrap import intervals, resample
from traps_pipeline.scoring.power import Precision, Shares, precision


def test_the_width_of_one_dataset_follows_by_hand() -> None:
    # Acc 0.5, AbsRec 0.5, FalseAbs 0: J 0.5; 0.25 x 0.25 + 0.25 x 0.25 = 0.125 of a pair, so sqrt(0.125 / 200) = 0.025.
    found = precision([200], Shares(0.5, 0.5, 0.0))
    assert found.width == pytest.approx(2 * 1.96 * 0.025, rel=0.05)
    assert found.difference == pytest.approx(2.8016 * 0.035355, rel=0.1)
    assert precision([200, 200, 200, 200], Shares(0.5, 0.5, 0.0)).width == pytest.approx(found.width / 2, rel=0.05)
    assert precision([200, 0]).width == precision([200]).width
    with pytest.raises(ValueError, match="no dataset"):
        precision([0])


def test_with_two_pairs_nothing_is_promised() -> None:
    found = precision([2])
    assert found.width <= 1 and found.difference is None


def test_a_model_that_never_varies_has_no_width() -> None:
    assert precision([16] * 4, Shares(1.0, 1.0, 0.0)) == Precision(0.0, 0.0)


@pytest.mark.parametrize(
    "shares", [Shares(), Shares(0.8, 0.9, 0.05), Shares(0.4, 0.5, 0.25), Shares(0.5, 0.5, 0.5), Shares(0.8, 0.2, 0.2)]
)
def test_the_promised_width_is_within_15_percent_of_the_bootstraps(shares: Shares, rows) -> None:
    rng, widths, n = np.random.default_rng(7), [], 150
    for _ in range(6):
        parts = []
        for dataset in DATASETS:
            control = rng.random(n)
            right, declines = control < shares.acc, control >= 1 - shares.false_abs
            declined = rng.random(n) < shares.abs_rec
            pairs = [*zip(right.tolist(), declines.tolist(), declined.tolist(), strict=True)]
            parts.append(rows(pairs, dataset=dataset))
        found = intervals(resample(pd.concat(parts, ignore_index=True), 400)).set_index("dataset").loc["overall"]
        widths.append(found["pecs_ci_high"] - found["pecs_ci_low"])
    assert np.mean(widths) == pytest.approx(precision([n] * 4, shares).width, rel=0.15)
