"""The precision that a plan promises is what the bootstrap then finds."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from tests.build.errors import raises
from traps_pipeline.cli import main
from traps_pipeline.protocol.datasets import DATASETS
from traps_pipeline.scoring.bootstrap import intervals, resample
from traps_pipeline.scoring.power import Shares, precision


def everywhere(n: int) -> dict[str, int]:
    return dict.fromkeys(DATASETS, n)


def test_the_width_of_one_dataset_follows_by_hand() -> None:
    # Acc 0.5, AbsRec 0.5, FalseAbs 0: J 0.5; 0.25 x 0.25 + 0.25 x 0.25 = 0.125 of a pair: sqrt(0.125 / 800) = 0.0125.
    # The unseen scenario takes 1/801 of Acc, of J twice that, and gives as much: 2 x (0.5 + 1) x 0.5 / 801 at most.
    found = precision({"occlusion": 800}, Shares(0.5, 0.5, 0.0))
    assert 2 * 1.96 * 0.0125 < found.width < 2 * 1.96 * 0.0125 + 2 * 1.5 * 0.5 / 801 + 0.002
    assert found.difference is not None and found.difference > 2.8016 * 0.017678
    assert precision({"occlusion": 800, "chaotic": 0}).width == precision({"occlusion": 800}).width
    with raises(ValueError, "scoring.power.precision"):
        precision({"occlusion": 0})


def test_a_model_that_never_varies_has_a_width_all_the_same() -> None:
    assert 0.1 < precision(everywhere(16), Shares(1.0, 1.0, 0.0)).width < 0.5


@pytest.mark.slow
def test_more_models_need_a_larger_difference_and_too_few_scenarios_find_none() -> None:
    two, many = precision(everywhere(100)), precision(everywhere(100), models=16)
    assert two.difference == two.among_all == many.difference
    assert many.among_all is not None and two.difference is not None and many.among_all > 1.3 * two.difference
    assert precision({"occlusion": 12}, models=16).among_all is None  # 120 x 2^-11 > 0.05


@pytest.mark.slow
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
    assert np.mean(widths) == pytest.approx(precision(everywhere(n), shares).width, rel=0.15)


@pytest.mark.slow
@pytest.mark.promise
def test_the_plan_names_the_difference_that_all_models_of_the_experiment_leave(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["plan", "paper", "--workspace", str(tmp_path / "none")]) == 0
    found = precision(dict(zip(DATASETS, (202, 202, 500, 500), strict=True)), models=16)
    _, width, said = capsys.readouterr().out.partition(f" {found.width:.3f} ")
    assert width and {f"{found.among_all:.3f}", "16", "120"} <= {*said.split()}  # of 16 models there are 120 pairs
