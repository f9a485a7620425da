"""A study's metrics under the names of a harness."""

from __future__ import annotations

from traps_pipeline.release.harness.scoring import RUN_METRICS
from traps_pipeline.scoring.score_rows import LEADERBOARD
from traps_pipeline.storage.workspace import Workspace


def ours(workspace: Workspace, model: str, regime: str) -> dict[str, float]:
    """The leaderboard's metrics under the names of a harness."""
    board = workspace.tables.read_all(LEADERBOARD)
    rows = board.loc[(board["model"] == model) & (board["regime"] == regime)].to_dict("records")
    prefixed = {"" if row["dataset"] == "overall" else f"{row['dataset']}_": row for row in rows}
    assert len(prefixed) == 5
    return {f"{prefix}{name}": row[name] for prefix, row in prefixed.items() for name in RUN_METRICS}
