"""A cell of made-up items, answers, votes and verdicts."""

from __future__ import annotations

from datetime import datetime

from traps_pipeline.judging.judging_rows import VERDICTS, VOTES
from traps_pipeline.models.asking.answer_rows import RESPONSES
from traps_pipeline.protocol.cells import Cell, Evaluation
from traps_pipeline.storage.benchmark_tables import ITEMS

HOSTILE = '<script>alert(1)</script> \\textbf{bold} $x$ <img src="http://evil.example/x.png"> & "quoted"'
CELL = Cell("chaotic", Evaluation("oracle", "standard", 1))
DEFAULTS = {str: "x", int: 1, float: 0.5, bool: True, list[str]: ["x"], datetime: datetime(2026, 1, 1)}


def row(table, **values):
    """A row of a table with these values; nullable columns are null, others hold some value of their type."""
    filled = {c.name: None if c.nullable else DEFAULTS[c.type] for c in table.columns}
    return table.row_type(**(filled | values))


def write_cell(workspace, cell=CELL, text=HOSTILE):
    """A pair of `cell` with one answer a side, of which the control's is `text`, the void's is missing."""
    part = cell.partition
    both = [(f"{cell.dataset}:plinko-0001:{side}", side) for side in ("control", "void")]
    shared = {"scenario_id": "plinko-0001", "dataset": cell.dataset, "sub_scenario": "plinko"}
    items = [
        row(ITEMS, item_id=i, side=s, question=f"Where, {HOSTILE}?", clip=f"clips/plinko-0001/{s}.mp4", **shared)
        for i, s in both
    ]
    answers = [
        row(RESPONSES, item_id=both[0][0], side="control", outcome="answer", text=text, reasoning=HOSTILE, **part),
        row(RESPONSES, item_id=both[1][0], side="void", outcome="refused", **part),
    ]
    votes = [
        row(VOTES, item_id=both[0][0], side="control", task="abstention", judge="rule-1", abstained=False,
            confidence="high", rationale=HOSTILE, **part),
        row(VOTES, item_id=both[0][0], side="control", task="correctness", judge="rule-1", valid=False,
            invalid_reason="not JSON", **part),
    ]  # fmt: skip
    verdicts = [
        row(VERDICTS, item_id=i, side=s, abstained=False if s == "control" else None, scenario_id="plinko-0001", **part)
        for i, s in both
    ]
    workspace.tables.write(ITEMS, {"dataset": cell.dataset}, items, {})
    for table, rows in ((RESPONSES, answers), (VOTES, votes), (VERDICTS, verdicts)):
        workspace.tables.write(table, part, rows, {})
