"""What a stage is made from is noted before it reads: a change in between is never taken for having been read."""

from __future__ import annotations

from typing import Any

import pytest

from tests.conftest import EXPERIMENT, Checkout
from traps_pipeline.judging.judging_rows import VERDICTS
from traps_pipeline.pipeline.lineage import Lineage
from traps_pipeline.protocol.cells import Cell
from traps_pipeline.scoring.score_rows import METRICS
from traps_pipeline.storage.parquet import TableStore
from traps_pipeline.storage.workspace import Workspace

CELL = Cell.parse("chaotic|oracle__standard__run1")


def test_an_input_that_changes_while_a_stage_is_at_work_leaves_the_stage_stale(
    study: Checkout, monkeypatch: pytest.MonkeyPatch
) -> None:
    workspace, write = Workspace.open(study.workspace), TableStore.write

    def write_behind_a_change(tables: TableStore, table: Any, *rest: Any, **about: Any) -> str:
        """Let somebody else write a verdict between the metrics' reading and their writing."""
        if table.name == METRICS.name:
            state, verdicts = tables.state(VERDICTS, CELL.partition), tables.read(VERDICTS, CELL.partition)
            assert state is not None
            write(tables, VERDICTS, CELL.partition, verdicts.assign(abstained=True), state.inputs, code=state.code)
        return write(tables, table, *rest, **about)

    workspace.tables.path(METRICS, {"dataset": "chaotic"}).unlink()
    with monkeypatch.context() as patch:
        patch.setattr(TableStore, "write", write_behind_a_change)
        finished = study.traps("run", EXPERIMENT, "--until", "metrics")
    assert finished.code == 0, finished.out + finished.err
    status = Lineage(workspace).status("metrics", "chaotic")
    (reason,) = status.reasons
    assert status.kind == "stale" and f"verdicts/{CELL.key}" in reason
