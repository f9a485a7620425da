"""Records of a study's own checkout, altered."""

from __future__ import annotations

import json
from pathlib import Path

from tests.conftest import Checkout


def edit_record(study: Checkout, file: str, line: int, **changes: object) -> Path:
    path = study.root / "scene_specs" / "released" / f"{file}.jsonl"
    lines = path.read_text().splitlines()
    lines[line - 1] = json.dumps(json.loads(lines[line - 1]) | changes)
    path.write_text("\n".join(lines) + "\n")
    return path
