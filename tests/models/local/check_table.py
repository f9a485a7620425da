"""The table of checks in docs/local.md, which `python -m tests.models.local.check_table` writes from what the families'
tiny checkpoints give."""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory

from tests.build.page_tables import PageTable
from traps_pipeline.mechanism.adapter_checks import CHECKS, tiny_subject
from traps_pipeline.models.local.tiny import FAMILIES, Family

ON_PAGE = PageTable("local.md", "check")
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


if __name__ == "__main__":
    with TemporaryDirectory() as name:
        ON_PAGE.write(table(Path(name)))
