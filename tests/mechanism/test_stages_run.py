"""`traps run` walks the mechanistic stages through Dagster, and a second time computes nothing."""

from __future__ import annotations

import re

import pytest
import yaml

from tests.conftest import EXPERIMENT, Checkout, Finished
from traps_pipeline.models.local.tiny import build_tiny
from traps_pipeline.storage.workspace import Workspace
from traps_pipeline.tables import PROBES, STEERING_EFFECTS, STEERING_VOTES

pytestmark = pytest.mark.slow
ENTRY = """
  - id: tiny
    backend: local
    device: cpu
    media: {profile: frames, uniform: 2, size: [32, 32]}
    params: {checkpoint: tiny, dtype: float32, quantisation: none, do_sample: false, max_new_tokens: 4}
    runs: 1
"""
MECHANISM = {
    "models": {"tiny": {"steering": 3, "centroid": 4}},
    "prompts": ["standard"],
    "probes": {"folds": 2, "resamples": 100},
    "steering": {
        **{"alphas": [5], "pairs": 2, "well_posed_pairs": 4, "ill_posed_pairs": 4, "max_new_tokens": 4},
        **{"direction_regimes": ["standard"], "inference_regimes": ["guided"], "controls": []},
    },
}


def with_mechanism(study: Checkout) -> str:
    """The small study's experiment on two of its datasets, asking for a look into a tiny model besides."""
    with (study.root / "assets" / "models.yaml").open("a") as stream:
        stream.write(ENTRY)
    build_tiny("qwen3-vl", study.root / "tiny")
    experiment = yaml.safe_load((study.root / EXPERIMENT).read_text()) | {
        "datasets": ["chaotic", "chaotic_ill_posed"],
        "mechanism": MECHANISM,
    }
    (study.root / "inside.yaml").write_text(yaml.safe_dump(experiment))
    return "inside.yaml"


def counted(finished: Finished) -> tuple[int, ...]:
    """Items extracted, steered answers asked, votes on them."""
    assert finished.code == 0, finished.out + finished.err
    found = re.search(r"inside models: (\d+) items .*? (\d+) steered .*? (\d+) votes on them", finished.out)
    assert found, finished.out
    return tuple(map(int, found.groups()))


def test_traps_run_looks_into_a_model_once(study: Checkout) -> None:
    name = with_mechanism(study)
    until = "probes,cosines,steering_effects,steering_shares"

    def run() -> Finished:
        return study.traps("run", name, "--until", until)

    extracted, answers, votes = counted(run())
    tables = Workspace.open(study.workspace).tables
    judged, effects = tables.read_all(STEERING_VOTES), tables.read(STEERING_EFFECTS, {})
    assert extracted > 0 and answers > 0 and votes == 3 * answers
    assert len(judged) > answers  # controls stand in two datasets
    assert len(effects.groupby(["source", "target"])) == 4  # the paths between the two
    assert tables.read_all(PROBES)["note"].notna().any()  # tiny was not asked under standard: no Cf->Cf, and why
    assert counted(run()) == (0, 0, 0)
