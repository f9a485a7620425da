"""Two events: eight items a scenario, four of which hide what is asked."""

from __future__ import annotations

import json
from collections import Counter
from pathlib import Path
from typing import Any

import pytest

from traps_pipeline.base.errors import TrapsError
from traps_pipeline.benchmark.corrections import (
    Correction,
    LaneScenario,
    apply_to_lanes,
    of_pairs,
    of_study,
    read_corrections,
)
from traps_pipeline.benchmark.decisions import save_decision, undo_decision
from traps_pipeline.benchmark.filmed_arms import incomplete_reasons
from traps_pipeline.benchmark.records import load_released, two_events_lines
from traps_pipeline.protocol.two_events import LaneItem, lane_item, lane_items
from traps_pipeline.scenes.draw.draw_lanes import is_turn_of_earlier
from traps_pipeline.storage.benchmark_tables import ARMS
from traps_pipeline.storage.study import Asked, Study
from traps_pipeline.storage.workspace import Workspace


def test_an_item_id_says_which_lane_is_asked_and_which_are_hidden():
    item = lane_item("two_events:chain-e001:left.right")
    assert (item.scenario_id, item.lane, item.clip) == ("chain-e001", "left", "right")
    assert (item.asked_hidden, item.other_hidden, item.side) == (False, True, "control")
    assert lane_item("two_events:chain-e001:right.right").side == "void"


def test_the_two_items_of_a_pair_differ_in_nothing_but_whether_the_asked_lane_is_hidden():
    items = lane_items("chain-e001")
    assert [lane_item(item.item_id) for item in items] == items and len({*items}) == 8
    assert set(Counter(item.pair_id for item in items).values()) == {2}
    for pair in {item.pair_id for item in items}:
        one, other = (item for item in items if item.pair_id == pair)
        assert (one.lane, one.other_hidden) == (other.lane, other.other_hidden) and {one.side, other.side} == {
            "control",
            "void",
        }


@pytest.mark.parametrize(
    "item_id", ["occlusion:chain-0001:left.both", "two_events:chain-e001:void", "two_events:left.both"]
)
def test_another_id_is_refused_by_name(item_id: str):
    with pytest.raises(ValueError, match=item_id):
        lane_item(item_id)


def test_an_item_makes_its_own_name():
    assert LaneItem("chain-e001", "left", "both").item_id == "two_events:chain-e001:left.both"


# --- corrections ------------------------------------------------------------------------------------------------------

ID = "slide-e001"


def decide(tmp_path: Path, *changes: dict[str, Any]) -> dict[str, LaneScenario]:
    signed = {"scenario_id": ID, "who": "jd", "when": "2026-11-21", "why": "reviewed"}
    (tmp_path / "review.jsonl").write_text("".join(f"{json.dumps(signed | change)}\n" for change in changes))
    return apply_to_lanes(two_events_lines(), read_corrections(tmp_path))


def test_a_scenario_of_two_events_is_discarded_restored_and_reworded_in_both_lanes(tmp_path: Path):
    assert ID not in decide(tmp_path, {"action": "discard"})
    assert decide(tmp_path, {"action": "discard"}, {"action": "restore"})[ID].spec == two_events_lines()[ID].spec
    reworded = decide(tmp_path, {"action": "correct", "question": "Does it stop, yes or no?"})[ID].spec
    asked = [each.text for each in reworded.questions()]
    assert len({*asked}) == 2 and all(text.endswith("does it stop, yes or no?") for text in asked)
    assert reworded.scene_hash == two_events_lines()[ID].spec.scene_hash  # so no clip is drawn again


def test_the_last_decision_about_two_events_is_taken_back(tmp_path: Path):
    for seen, changes in enumerate(
        ({"action": "correct", "question": "Does it stop, yes or no?"}, {"action": "discard"})
    ):
        signed = {"scenario_id": ID, "who": "jd", "when": "2026-11-21", "why": "reviewed"}
        save_decision(Correction.model_validate(signed | changes), seen, tmp_path)
    undo_decision(ID, 2, who="jd", why="no", folder=tmp_path)
    scenario = apply_to_lanes(two_events_lines(), read_corrections(tmp_path))[ID]
    assert scenario.spec.question == "Does it stop, yes or no?"


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"action": "correct", "params": {"radius_m": 0.1}}, "discard it"),
        ({"action": "correct", "answer": "yes"}, "discard it"),
        ({"action": "correct", "labels": ["a", "b"]}, "is not one of"),
        ({"action": "correct"}, "no change"),
        ({"action": "keep", "question": "Why?"}, "keep"),
    ],
)
def test_a_wrong_decision_about_two_events_is_named_by_file_and_line(
    tmp_path: Path, change: dict[str, Any], named: str
):
    with pytest.raises(TrapsError, match=rf"review\.jsonl:1: .*{named}"):
        decide(tmp_path, change)


def test_decisions_about_two_events_leave_the_pairs_as_they_are(tmp_path: Path):
    decide(tmp_path, {"action": "discard"})
    assert of_pairs(read_corrections(tmp_path)) == []


# --- records ----------------------------------------------------------------------------------------------------------


def test_a_study_has_the_first_scenarios_of_each_family_or_those_that_it_names():
    scenarios = apply_to_lanes(two_events_lines(), [])
    assert {*of_study(scenarios, Study(per_family=1), two_events_lines())} == {
        id_ for id_ in scenarios if id_.endswith("e001")
    }
    named = Study(scenarios=["slide-e002", "slide-0001"])
    assert [*of_study(scenarios, named, two_events_lines())] == ["slide-e002"]
    assert [*of_study(load_released(), named)] == ["slide-0001"]


@pytest.mark.parametrize("block", [0, 1])
def test_in_every_eight_scenarios_half_of_the_lanes_show_the_earlier_of_their_two_answers(block: int):
    for family in ("slide", "chain"):
        numbers = range(8 * block + 1, 8 * block + 9)
        turns = [is_turn_of_earlier(family, number, lane, seed=2026) for number in numbers for lane in range(2)]
        assert sum(turns) == 8


@pytest.mark.parametrize(
    ("field", "value"), [("camera", {"distance": -1.0}), ("physics", {"fps": 0}), ("labels", ["yes"])]
)
def test_an_implausible_record_is_named_by_file_line_and_field(tmp_path: Path, field: str, value: Any):
    record = json.loads(two_events_lines()[ID].line)
    record[field] = record[field] | value if isinstance(value, dict) else value
    (tmp_path / "slide.jsonl").write_text(json.dumps(record) + "\n")
    with pytest.raises(TrapsError, match=rf"slide\.jsonl:1: .*{field}"):
        _ = two_events_lines(tmp_path)[ID].spec


def test_arms_without_two_events_are_stale_only_where_the_study_has_scenarios_of_them(tmp_path: Path):
    asked = Asked(datasets=("occlusion", "two_events"), models=("oracle",), regimes=("standard",), runs=(1,))
    study = Study(scenarios=["hidden_drop-0001", "chain-e001"], experiments={"mine": asked})
    workspace = Workspace.create(tmp_path / "study", study)
    for category in ("hidden", "collisions"):
        workspace.tables.write(ARMS, {"category": category}, [], {})
    assert incomplete_reasons(workspace, "hidden") == []
    (reason,) = incomplete_reasons(workspace, "collisions")
    assert "two_events" in reason
