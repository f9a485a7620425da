"""Name the eight items of a scenario of two events, and take their ids apart (docs/arms.md, "Two events")."""

from dataclasses import dataclass
from itertools import product

from traps_pipeline.protocol.datasets import TWO_EVENTS

LANES = ("left", "right")  # halves of the picture, an event in each
CLIPS: dict[str, tuple[bool, bool]] = {  # by the lanes that are hidden in it: whether the left and the right one is
    "neither": (False, False), "left": (True, False), "right": (False, True), "both": (True, True),
}  # fmt: skip

ITEMS_A_SIDE = 4  # of a scenario: as many can be answered as must be abstained on


@dataclass(frozen=True)
class LaneItem:
    """An item: a scenario, the lane that is asked about, and the clip that is shown."""

    scenario_id: str
    lane: str
    clip: str

    @property
    def asked_hidden(self) -> bool:
        """Whether the clip hides the asked lane."""
        return CLIPS[self.clip][LANES.index(self.lane)]

    @property
    def other_hidden(self) -> bool:
        """Whether the clip hides the other lane."""
        return CLIPS[self.clip][1 - LANES.index(self.lane)]

    @property
    def side(self) -> str:
        """`void` where it must be abstained on."""
        return "void" if self.asked_hidden else "control"

    @property
    def name(self) -> str:
        """The last part of its id."""
        return f"{self.lane}.{self.clip}"

    @property
    def item_id(self) -> str:
        """The item's id, `two_events:SCENARIO:LANE.CLIP`."""
        return f"{TWO_EVENTS}:{self.scenario_id}:{self.name}"

    @property
    def pair_id(self) -> str:
        """The id of its pair: two items that differ in nothing but whether the asked event is hidden."""
        return f"{TWO_EVENTS}:{self.scenario_id}:{self.lane}.{'other_hidden' if self.other_hidden else 'other_seen'}"


def lane_items(scenario_id: str) -> list[LaneItem]:
    """Return a scenario's eight items, of which four must be abstained on."""
    return [LaneItem(scenario_id, lane, clip) for clip, lane in product(CLIPS, LANES)]


def lane_item(item_id: str) -> LaneItem:
    """Return the item of an id `two_events:SCENARIO:LANE.CLIP`. Raises ValueError."""
    dataset, _, rest = item_id.partition(":")
    scenario_id, _, name = rest.rpartition(":")
    lane, _, clip = name.partition(".")
    if dataset != TWO_EVENTS or not scenario_id or lane not in LANES or clip not in CLIPS:
        raise ValueError(
            f"item id {item_id!r}: not {TWO_EVENTS}:SCENARIO:LANE.CLIP, LANE of {LANES}, CLIP of {[*CLIPS]}"
        )
    return LaneItem(scenario_id, lane, clip)
