"""Verdicts on two events, as their stage leaves them."""

from __future__ import annotations

from collections.abc import Callable

import pandas as pd

from tests.build.cells import row
from traps_pipeline.judging.judging_rows import VERDICTS
from traps_pipeline.protocol.datasets import TWO_EVENTS
from traps_pipeline.protocol.two_events import LaneItem, lane_items

Rule = Callable[[LaneItem], bool | None]  # whether it abstains


def reader(item: LaneItem) -> bool:
    """Look where it is asked."""
    return item.asked_hidden


def lane_verdicts(rule: Rule, scenarios: int = 20, **cell: object) -> pd.DataFrame:
    """VERDICTS rows of a rule that answers rightly where it does not abstain; None: the panel is undecided."""
    about = {"dataset": TWO_EVENTS, "model": "a", "regime": "standard", "run": 1, "category": "hidden"}
    about |= {"epoch": "e1", "panel": "three@1"}
    rows = []
    for item in (item for k in range(scenarios) for item in lane_items(f"hidden_drop-e{k:03d}")):
        abstained = rule(item)
        correct = None if abstained is None or item.asked_hidden else not abstained
        names = {name: getattr(item, name) for name in ("item_id", "pair_id", "side", "scenario_id")}
        rows.append(row(VERDICTS, abstained=abstained, correct=correct, **{**about, **names, **cell}))
    return pd.DataFrame(rows, columns=pd.Index(VERDICTS.names)).astype({"abstained": object, "correct": object})
