"""`traps run` makes the mechanistic stages through Dagster; a second run computes nothing."""

from __future__ import annotations

import json

import pytest

from tests.build.inside import with_mechanism
from tests.conftest import Checkout, Finished
from traps_pipeline.mechanism.control_rows import PATCHING, PROBE_BASELINES, STEERING_NULLS
from traps_pipeline.mechanism.mechanism_rows import PROBES, STEERING_EFFECTS, STEERING_VOTES
from traps_pipeline.storage.workspace import Workspace

pytestmark = pytest.mark.slow


def counted(finished: Finished) -> list[int]:
    """Items extracted, steered answers asked, votes on them."""
    tallies = json.loads(finished.ok().out)["run"]["tallies"]
    return [tallies.get(stage, {"asked": 0})["asked"] for stage in ("hidden_states", "steering", "steering_votes")]


@pytest.mark.promise
def test_traps_run_looks_into_a_model_once(own_study: Checkout) -> None:
    experiment = with_mechanism(own_study)
    extracted, answers, votes = counted(own_study.traps("run", experiment, "--json"))
    tables = Workspace.open(own_study.workspace).tables
    judged, effects = tables.read_all(STEERING_VOTES), tables.read(STEERING_EFFECTS, {})
    assert extracted > 0 and answers > 0 and votes > 3 * answers  # controls are judged for correctness too
    assert len(judged) > answers  # controls stand in two datasets
    assert len(effects.groupby(["source", "target"])) == 4  # the paths between the two
    nulls, baselines = tables.read(STEERING_NULLS, {}), tables.read_all(PROBE_BASELINES)
    assert set(nulls["draws"]) == {2} and set(nulls["dose"]) == {1, 5}  # the largest gap, and each alpha
    assert {"question words", "output margin", "noise"} <= set(baselines["features"])
    patched = tables.read_all(PATCHING)
    assert patched.query("layer == 4 and group == 'last' and source == 'pair' and site == 'residual'")["n"].max() == 2
    assert set(patched.loc[patched["effect"].notna()].groupby(["dataset", "into", "source"]).size()) == {6}
    assert ((patched["n"] + patched["n_left_out"]) > 0).all()
    assert tables.read_all(PROBES)["note"].notna().any()  # tiny was not asked under standard: no Cf->Cf, and why
    assert counted(own_study.traps("run", experiment, "--json")) == [0, 0, 0]
