"""Whether states hold the interaction of two events: planted states, worked out by hand, and one real run."""

from __future__ import annotations

import numpy as np
import pytest
import yaml

from tests.conftest import EXPERIMENT, Checkout
from traps_pipeline import inside
from traps_pipeline.mechanism.control_rows import INTERACTION
from traps_pipeline.mechanism.interaction import LaneDesign, lane_metrics
from traps_pipeline.mechanism.stored_states import StoredStates
from traps_pipeline.models.local.adapter import load_local_model
from traps_pipeline.models.registry.entries import get_model
from traps_pipeline.protocol.cells import Extraction
from traps_pipeline.protocol.two_events import lane_items
from traps_pipeline.storage.workspace import Workspace

SCENARIOS = [f"{family}-e00{n}" for family in ("chain", "slide", "tower", "spring") for n in (1, 2, 3)]
DESIGN = LaneDesign.of([item.item_id for scenario in SCENARIOS for item in lane_items(scenario)])
BOARDS = DESIGN.asked.astype(float) + DESIGN.other
CHANCE = pytest.approx({"auroc": 0.5, "within": 0.5, "own_effect": 0.0, "other_effect": 0.0})


def figures(features: np.ndarray, held_out: str = "families") -> dict[str, float]:
    return lane_metrics(features, DESIGN, folds=3, resamples=200, seed=0)[held_out]


@pytest.mark.parametrize("held_out", ["scenarios", "families"])
def test_planted_interaction_is_read_in_every_clip_and_follows_the_asked_event_alone(held_out: str) -> None:
    found = figures(DESIGN.asked[:, None].astype(float), held_out)
    assert (found["auroc"], found["within"], found["confound"]) == (1.0, 1.0, 1.0)
    # Half of the items hide the asked event: one column of two values has deviation half their distance.
    assert found["own_effect"] == pytest.approx(2.0, abs=0.1) and found["other_effect"] == pytest.approx(0.0, abs=0.1)
    assert (found["n_clips"], found["n_scenarios"]) == (24, 12)
    assert found["within_high"] == 1.0 and found["within_low"] == pytest.approx(0.025 ** (1 / 12))


def test_what_tells_the_number_of_boards_alone_is_at_chance_and_only_the_confound_shows_it() -> None:
    found = figures(BOARDS[:, None])
    assert {name: found[name] for name in ("auroc", "within", "own_effect", "other_effect")} == CHANCE
    # 1 or 2 boards where the asked event is hidden, 0 or 1 where it is seen: three of four pairs win, one ties.
    assert found["confound"] == pytest.approx((3 + 0.5) / 4)


def test_what_clip_and_question_tell_apart_adds_up_to_chance_within_every_clip() -> None:
    questions = np.array([item.lane == "left" for scenario in SCENARIOS for item in lane_items(scenario)], float)
    noise = np.random.default_rng(0).standard_normal((DESIGN.clips.max() + 1, 5))[DESIGN.clips]
    found = figures(np.column_stack([questions, noise]), "scenarios")
    assert (found["within"], found["auroc"]) == (0.5, pytest.approx(0.5, abs=0.02))
    assert found["same"] == 0 and figures(noise, "scenarios")["same"] == 1  # what is of the clip alone


def test_families_are_not_held_out_where_there_is_one() -> None:
    design = LaneDesign.of([item.item_id for n in range(4) for item in lane_items(f"chain-e00{n}")])
    features = design.asked[:, None].astype(float)
    assert [*lane_metrics(features, design, folds=2, resamples=20, seed=0)] == ["scenarios"]


@pytest.mark.slow
def test_traps_run_reads_two_events_in_the_pocket_and_in_its_random_weights(own_study: Checkout) -> None:
    experiment = yaml.safe_load((own_study.root / EXPERIMENT).read_text()) | {
        "models": ["pocket"],
        "regimes": ["guided"],
        "judged_by_rules": True,
        "datasets": ["chaotic", "chaotic_ill_posed", "two_events"],
        "mechanism": {
            "models": {"pocket": {"steering": 3, "centroid": 4}},
            "probes": {"folds": 2, "resamples": 100},
            "steering": None,
        },
    }
    experiment["scenarios"] = ["domino_chain-e001", "slide-e001", "plinko-0001", "plinko-0002", "tumbling_dice-0001"]
    (own_study.root / "inside.yaml").write_text(yaml.safe_dump(experiment))
    workspace = own_study.root / "inside"
    own_study.traps("run", "inside.yaml", "--workspace", workspace, "--until", "interaction").ok()
    rows = Workspace.open(workspace).tables.read_all(INTERACTION)
    assert {*rows["prompt"]} == {"guided", "random_0", "random_1"}
    states, rivals = (rows.loc[rows["layer"].ge(0) == of_states] for of_states in (True, False))
    assert len(states) == 3 * 2 * 5 and {*states.loc[states["chosen"]].groupby(["prompt", "held_out"]).size()} == {1}
    raw = rivals["features"].isin(["pixels", "words", "both added", "length"])
    assert {*rivals.loc[~raw, "features"]} == {"output margin", "first-token logits"} and raw.sum() == 3 * 4 * 2
    assert rivals.loc[raw, ["auroc", "within"]].to_numpy() == pytest.approx(0.5)
    # Random weights are read under the prompt that the model is read under.
    random = StoredStates.of(Workspace.open(workspace), Extraction("pocket", "random_0"), ["two_events"])
    prompt = inside.prompt(workspace, random.items["item_id"][0], regime="guided")
    network = load_local_model(get_model("pocket"), inside=True, seed=0)
    assert (random.read("two_events", 4)[0] == network.forward_states(prompt).raw[4]).all()
