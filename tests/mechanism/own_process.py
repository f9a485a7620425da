"""A cell steered, or a study patched, by a process of its own: `start("steer", workspace, entry)`.

It prints a line of JSON: how many answers or passes it made itself, and what the cell or the study then has.
"""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import asdict
from pathlib import Path
from typing import Any, Literal

import pytest

from tests.conftest import ROOT
from tests.mechanism.study import register
from traps_pipeline.mechanism import patching_stage
from traps_pipeline.mechanism.patching_effects import RecordedPass, trace_pass
from traps_pipeline.models.registry.entries import ModelEntry
from traps_pipeline.protocol.cells import Extraction, SteeringCell
from traps_pipeline.storage.workspace import Workspace

CELL = SteeringCell.make("chaotic", "tiny", "standard", "guided")
STANDARD = Extraction("tiny", "standard")


def start(work: Literal["steer", "patch"], workspace: Path, entry: ModelEntry) -> subprocess.Popen[str]:
    """Begin to steer CELL, or to patch the study's pairs."""
    command = [sys.executable, "-m", "tests.mechanism.own_process", work, str(workspace), entry.model_dump_json()]
    return subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True)


def printed(process: subprocess.Popen[str]) -> dict[str, Any]:
    """Wait for what a process prints in the end."""
    return json.loads(process.communicate()[0].splitlines()[-1])


def patch_pairs(workspace: Workspace, entry: ModelEntry, patch: pytest.MonkeyPatch) -> dict[str, Any]:
    margins = list[float]()

    def counting(*args: Any) -> RecordedPass:
        made = trace_pass(*args)
        margins.append(made.margin)
        return made

    patch.setattr(patching_stage, "trace_pass", counting)
    rows = patching_stage.patching_rows(workspace, entry, STANDARD)
    return {"made": len(margins), "content": [asdict(row) for row in rows]}


def main(work: str, workspace: str, described: str) -> None:
    entry = ModelEntry.model_validate_json(described)
    with pytest.MonkeyPatch.context() as patch:
        register(patch, entry)
        found = patch_pairs(Workspace.open(Path(workspace)), entry, patch)
    print(json.dumps(found), flush=True)


if __name__ == "__main__":
    main(*sys.argv[1:])
