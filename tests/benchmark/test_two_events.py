"""Two events: eight items a scenario, four of which hide what is asked."""

from __future__ import annotations

from collections import Counter

import pytest

from traps_pipeline.protocol.two_events import LaneItem, lane_item, lane_items


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
