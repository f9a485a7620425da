"""The table of checks in docs/local.md, which `python -m tests.models.local.check_table` writes from what the families'
tiny checkpoints give."""

from __future__ import annotations

from tests import local_models
from tests.build.page_tables import PageTable
from tools.tiny_checkpoints import FAMILIES, Family
from traps_pipeline.mechanism.adapter_checks import CHECKS, Subject, brightening_clip

ON_PAGE = PageTable("local.md", "check")
NAMES: dict[Family, str] = {"qwen3-vl": "Qwen3-VL", "gemma-4": "Gemma 4", "llava-next-video": "LLaVA-NeXT-Video"}


def table() -> str:
    """Every check of every family's tiny checkpoint, as Markdown. Raises TrapsError where one does not hold."""
    subjects = [Subject(local_models.model(family), *brightening_clip()) for family in FAMILIES]
    lines = [f"| check | promise | {' | '.join(NAMES[family] for family in FAMILIES)} |", f"|{' --- |' * 5}"]
    lines += [
        f"| {check.name} | {check.promise} | {' | '.join(check.found(subject) for subject in subjects)} |"
        for check in CHECKS
    ]
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    ON_PAGE.write(table())
