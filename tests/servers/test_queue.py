"""Which scenarios a reviewer sees first: flagged ones by how much."""

from __future__ import annotations

import pandas as pd

from traps_pipeline.servers.queue import queue

FLAGS = pd.DataFrame({"judges": [3, 0, 7], "models": [0.0, 0.25, 0.1]}, index=pd.Index(["a-1", "a-2", "a-3"]))


def test_queues_are_in_order_and_lose_what_is_reviewed() -> None:
    scenarios, reviewed = ["a-1", "a-2", "a-3", "a-4"], frozenset({"a-3"})
    ordered = {name: queue(name, scenarios, frozenset(), FLAGS) for name in ("judges", "models")}
    assert ordered == {"judges": ["a-3", "a-1"], "models": ["a-2", "a-3"]}
    assert queue("unreviewed", scenarios, reviewed, FLAGS) == ["a-1", "a-2", "a-4"]
    assert queue("judges", scenarios, reviewed, FLAGS) == ["a-1"]
    assert queue("all", scenarios, reviewed, FLAGS) == scenarios
    assert queue("judges", scenarios, reviewed, pd.DataFrame()) == []
