"""Labels of people, and a study whose answers they label."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from tests.judging.conftest import answered_study
from traps_pipeline.judging.confabulation import sample_id
from traps_pipeline.judging.judging_rows import CONFABULATION, ConfabulationRow
from traps_pipeline.people.judge_validation import LABEL_COLUMNS
from traps_pipeline.protocol.cells import Cell, Evaluation
from traps_pipeline.protocol.ratings import AXES
from traps_pipeline.storage.workspace import Workspace

MODEL = "qwen3-vl-think"
HEAD = ",".join(LABEL_COLUMNS)
GOOD = [f"{who},{sample},1,0,no,TRUE" for who in ("ann", "bob") for sample in ("s1", "s2")]


def written(path: Path, *lines: str) -> Path:
    (path / "labels.csv").write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path / "labels.csv"


def labelled_study(root: Path, texts: Sequence[str]) -> Workspace:
    """A study whose judge has called every failure a hallucinated premise and nothing else."""
    cell = Cell("chaotic", Evaluation(MODEL, "standard", 1))
    workspace = answered_study(root, {cell: {(k, "void"): text for k, text in enumerate(texts)}})
    shared: dict[str, Any] = {**dict.fromkeys(CONFABULATION.names, "x"), **cell.partition, **dict.fromkeys(AXES, False)}
    shared |= {"n_failures": 9, "created_at": datetime.now(UTC), "valid": True, "hallucinated_premise": True}
    shared |= {"void_kind": "truncation", "evidence": "output"}
    rows = []
    for k, text in enumerate(texts):
        item = f"chaotic:s-{k:04d}:void"
        own = {"item_id": item, "sample_id": sample_id(cell, item, text.rpartition("<think>")[2], None)}
        rows.append(ConfabulationRow(**(shared | own)))
    workspace.tables.write(CONFABULATION, {}, rows, {})
    return workspace
