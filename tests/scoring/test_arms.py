"""Arms enter no metric of the pairs, and have metrics of their own."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from tests.build.verdicts import JUDGES, Rows, of_arm, write
from traps_pipeline.pipeline.stages import judging_stages, scoring_stages
from traps_pipeline.protocol.datasets import ARMS, DATASETS
from traps_pipeline.protocol.ratings import VOTE_COLUMNS
from traps_pipeline.report.study_results import StudyResults
from traps_pipeline.scoring import bootstrap
from traps_pipeline.scoring.metrics import cell_metrics, wrong_metrics
from traps_pipeline.scoring.score_rows import CONTRASTS
from traps_pipeline.storage.parquet import StageOutput
from traps_pipeline.storage.study import Study
from traps_pipeline.storage.workspace import Workspace

MODELS = {"oracle": (True, False, True), "prior": (True, True, False)}


def metrics(workspace: Workspace) -> Mapping[str, pd.DataFrame]:
    """Every table of figures over the pairs, and every frame that tables and figures of the report are made from."""
    made: dict[str, StageOutput] = {"contrasts": scoring_stages.contrasts.make(workspace, None)}
    workspace.tables.write(CONTRASTS, {}, made["contrasts"].frame, {})
    made["regime_tests"] = scoring_stages.regime_tests.make(workspace, None)
    made["leaderboard"] = scoring_stages.leaderboard.make(workspace, None)
    votes = judging_stages._votes(workspace, "agreement")
    study = StudyResults(workspace)
    frames = {name: getattr(study, name) for name in ("metrics", "sub_cells", "sub_scenarios", "labels", "composition")}
    return {name: one.frame for name, one in made.items()} | frames | {"votes": votes.loc[:, VOTE_COLUMNS]}


@pytest.mark.slow
@pytest.mark.promise
def test_rows_of_arms_beside_the_pairs_change_no_metric(
    rows: Rows, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(bootstrap.resample, "__defaults__", (50, bootstrap.SEED))
    monkeypatch.setattr(judging_stages, "_panel", lambda workspace: [*JUDGES])
    asked = [(model, regime) for model in MODELS for regime in ("standard", "guided")]
    cells = [{"model": model, "regime": regime} for model, regime in asked]
    pairs = [rows([MODELS[c["model"]], (True, False, True)], dataset=d, **c) for c in cells for d in DATASETS]
    # All is wrong in the arms: whoever reads them shows it.
    arms = [of_arm(rows, arm, [(False, True, False)] * 3, **c) for c in cells for arm in ARMS]
    study = Study(panel="rules", scenarios=["plinko-0001"])
    alone, beside = (Workspace.create(tmp_path / name, study) for name in ("alone", "beside"))
    write(alone, pd.concat(pairs, ignore_index=True))
    write(beside, pd.concat([*pairs, *arms], ignore_index=True))
    expected, found = metrics(alone), metrics(beside)
    assert len(expected["leaderboard"]) == 4 * 5
    for name, frame in expected.items():
        pd.testing.assert_frame_equal(found[name], frame, obj=name)


@pytest.mark.parametrize(
    ("arm", "acc", "false_abs", "abs_rec", "missing"),
    [
        ("length_matched", 0.5, 0.5, np.nan, 1),
        ("occluder_grey", np.nan, np.nan, 1.0, 1),
        ("labels_two", 0.5, 0.5, 1.0, 2),
    ],
)
def test_an_arm_has_the_metrics_of_the_sides_that_it_has(
    rows: Rows, arm: str, acc: float, false_abs: float, abs_rec: float, missing: int
) -> None:
    cells = cell_metrics(of_arm(rows, arm, [(True, False, True), (False, True, True), (None, None, None)]))
    one = cells.loc[cells["scope"] == "all"].iloc[0]
    np.testing.assert_equal([one.acc, one.false_abs, one.abs_rec], [acc, false_abs, abs_rec])
    assert (one.n_pairs, one.n_missing) == (3, missing)
    assert np.isnan(one.pecs) == (arm != "labels_two")
    assert wrong_metrics(cells) == 0
