"""The table of checks in docs/local.md, written from what the families' tiny checkpoints give.

`python -m tests.models.local.check_table` writes it; a test holds the page against it.
"""

from __future__ import annotations

import re
from pathlib import Path
from tempfile import TemporaryDirectory

from tests.conftest import ROOT
from traps_pipeline.mechanism.adapter_checks import CHECKS, tiny_subject
from traps_pipeline.models.local.tiny import FAMILIES, Family

PAGE = ROOT / "docs" / "local.md"
TABLE = re.compile(r"^\| check \|.*\n(?:\|.*\n)+|^CHECKS\n", re.MULTILINE)
NAMES: dict[Family, str] = {"qwen3-vl": "Qwen3-VL", "gemma-4": "Gemma 4", "llava-next-video": "LLaVA-NeXT-Video"}


def table(folder: Path) -> str:
    """Every check of every family's tiny checkpoint, as Markdown. Raises TrapsError where one does not hold."""
    subjects = [tiny_subject(family, folder) for family in FAMILIES]
    lines = [f"| check | promise | {' | '.join(NAMES[family] for family in FAMILIES)} |", f"|{' --- |' * 5}"]
    lines += [
        f"| {check.name} | {check.promise} | {' | '.join(check.found(subject) for subject in subjects)} |"
        for check in CHECKS
    ]
    return "\n".join(lines) + "\n"


def written() -> str:
    """The table as it stands on the page."""
    (found,) = TABLE.findall(PAGE.read_text(encoding="utf-8"))
    return found


if __name__ == "__main__":
    with TemporaryDirectory() as name:
        PAGE.write_text(PAGE.read_text(encoding="utf-8").replace(written(), table(Path(name))), encoding="utf-8")
