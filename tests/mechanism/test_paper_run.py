"""The paper's mechanistic half as it stands in paper.yaml, run as one command on tiny checkpoints of its families."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.conftest import Checkout
from tests.mechanism.paper_run import BLOCKS, DEPTHS, mechanism, paper, write
from traps_pipeline.mechanism.mechanism_rows import COSINES, PROBES, STEERING_EFFECTS, STEERING_SHARES
from traps_pipeline.protocol.datasets import DATASETS
from traps_pipeline.storage.workspace import Workspace

SCENARIOS = [f"{family}-000{n}" for family in ("domino_chain", "plinko") for n in (1, 2, 3)]


def test_the_tiny_checkpoints_are_asked_what_the_papers_models_are() -> None:
    tiny, real = mechanism(), paper()["mechanism"]
    assert {name for name in real if tiny[name] != real[name]} == {"models", "probes", "steering"}
    assert tiny["probes"] == real["probes"] | {"folds": 2}
    differ = {name for name in real["steering"] if tiny["steering"][name] != real["steering"][name]}
    assert differ == {"pairs", "max_new_tokens", "well_posed_pairs", "ill_posed_pairs"}
    layers = {model: (each["steering"], each.get("sweep")) for model, each in tiny["models"].items()}
    # 20 of 36 blocks, of four: 2.2; 35 of 42 with 1 and 17, of six: 5 with 0.1 and 2.4; 28 of 32, of four: 3.5.
    assert layers == {"qwen3-vl-8b": (2, None), "gemma-4-e4b": (5, [1, 2]), "llava-next-video-7b": (4, None)}


@pytest.mark.slow
def test_the_papers_layers_sweep_doses_and_paths_are_run_on_all_three_families(
    own_study: Checkout, tmp_path: Path
) -> None:
    folder = tmp_path / "tiny"
    folder.mkdir()
    path = write(own_study.root / "assets" / "models.yaml", folder, SCENARIOS)
    own = Checkout(own_study.root, tmp_path / "inside")
    (tmp_path / "inside").mkdir()
    (own_study.workspace / "clips").rename(own.workspace / "clips")
    run = own.traps("run", path, "--until", "probes,cosines,steering_effects,steering_shares")
    assert run.code == 0, run.out + run.err
    tables, settings = Workspace.open(own.workspace).tables, mechanism()
    probes, effects = tables.read_all(PROBES), tables.read(STEERING_EFFECTS, {})
    cosines, shares = tables.read(COSINES, {}), tables.read(STEERING_SHARES, {})
    for model in DEPTHS:
        layers = settings["models"][model]
        mine = effects.loc[effects["model"] == model]
        transfer = probes.loc[(probes["model"] == model) & (probes["analysis"] == "transfer")]
        assert set(transfer["layer"]) == {*range(BLOCKS[model] + 1)}  # the embeddings, then every block's output
        assert len(transfer[["source", "target"]].drop_duplicates()) == 12
        assert set(mine["layer"]) == {layers["steering"], *layers.get("sweep", [])}  # of Gemma also the sweep
        assert set(mine["alpha"]) >= {0, *settings["steering"]["alphas"]}
        voids = mine.loc[(mine["kind"] == "void") & (mine["layer"] == layers["steering"])]
        assert len(voids[["source", "target"]].drop_duplicates()) >= 14  # both path sets
        assert set(zip(voids["directions"], voids["regime"], strict=True)) == {
            (a, b) for a in ("standard", "guided") for b in ("standard", "guided")
        }
        at = cosines.loc[(cosines["model"] == model) & (cosines["layer"] == layers["steering"])]
        assert {*at["dataset"]} | {*at["other_dataset"]} == {*DATASETS}
    assert {*shares["path_set"]} >= {"transfer", "within_domain"} and {*shares["model"]} == {*DEPTHS}
