"""A study patched by a process of its own: `python -m tests.mechanism.patch_cell WORKSPACE ENTRY_JSON`.

Prints a line of JSON: the number of recorded passes, and the rows.
"""

from __future__ import annotations

import json
import sys
from dataclasses import asdict
from pathlib import Path
from typing import Any

import pytest

from tests.mechanism.study import register
from traps_pipeline.mechanism import patching_stage
from traps_pipeline.mechanism.patching_effects import RecordedPass, record
from traps_pipeline.models.registry import ModelEntry
from traps_pipeline.protocol.cells import Extraction
from traps_pipeline.storage.workspace import Workspace


def main(place: str, described: str) -> None:
    """Patch the study's pairs and count the passes."""
    entry, workspace = ModelEntry.model_validate_json(Path(described).read_text("utf-8")), Workspace.open(Path(place))
    passes = 0

    def counting(*args: Any) -> RecordedPass:
        nonlocal passes
        passes += 1
        return record(*args)

    with pytest.MonkeyPatch.context() as patch:
        register(patch, entry)
        patch.setattr(patching_stage, "record", counting)
        rows = patching_stage.patching_rows(workspace, entry, Extraction("tiny", "standard"))
    print(json.dumps({"passes": passes, "rows": [asdict(row) for row in rows]}), flush=True)


if __name__ == "__main__":
    main(*sys.argv[1:])
