"""Verdicts of pairs and arms, as their stages leave them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pandas as pd

from tests.build.cells import row
from traps_pipeline.judging.judging_rows import VERDICTS, VOTES
from traps_pipeline.models.registry.judges import panel_id
from traps_pipeline.protocol.datasets import ARMS, sides_of
from traps_pipeline.scoring.metrics import cell_metrics
from traps_pipeline.scoring.score_rows import METRICS
from traps_pipeline.storage.benchmark_tables import ITEMS, current_rows
from traps_pipeline.storage.workspace import Workspace

Rows = Callable[..., pd.DataFrame]
JUDGES = ("rule-1", "rule-2", "rule-3")


def of_arm(rows: Rows, arm: str, pairs: list[tuple[bool, bool, bool]], **cell: object) -> pd.DataFrame:
    """VERDICTS rows of an arm: of the sides that it has."""
    both = rows(pairs, dataset=arm, **cell)
    return both.loc[both["side"].isin(sides_of(arm))].reset_index(drop=True)


def write(workspace: Workspace, verdicts: pd.DataFrame) -> None:
    """Items, votes, verdicts and metrics of these VERDICTS rows, as their stages would leave them."""
    tables = workspace.tables
    for dataset, part in verdicts.groupby("dataset"):
        items = part.drop_duplicates("item_id")[["item_id", "pair_id", "side"]].itertuples(index=False)
        rows = [row(ITEMS, dataset=dataset, item_id=item, pair_id=pair, side=side) for item, pair, side in items]
        tables.write(ITEMS, {"dataset": dataset}, rows, {})
        for cell, mine in part.groupby(["dataset", "model", "regime", "run"]):
            where: dict[str, Any] = dict(zip(("dataset", "model", "regime", "run"), cell, strict=True))
            tables.write(VERDICTS, where, mine.reset_index(drop=True), {})
            cast = [
                row(VOTES, item_id=item, side=side, task="abstention", judge=judge, valid=True, panel=panel_id("rules"),
                    abstained=bool(said) != (judge == JUDGES[0] and dataset in ARMS), **where)
                for item, side, said in mine[["item_id", "side", "abstained"]].itertuples(index=False)
                for judge in JUDGES
            ]  # fmt: skip
            tables.write(VOTES, where, cast, {})
        tables.write(
            METRICS, {"dataset": dataset}, cell_metrics(current_rows(workspace, VERDICTS, dataset=str(dataset))), {}
        )
