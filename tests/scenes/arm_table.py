"""The table of arms in docs/arms.md, which `python -m tests.scenes.arm_table` writes from their definitions."""

from __future__ import annotations

from tests.build.page_tables import PageTable
from traps_pipeline.protocol.datasets import extra_datasets_of
from traps_pipeline.scenes.variants.arms import ARMS

ON_PAGE = PageTable("arms.md", "arm")


def table() -> str:
    """Return the arms as a Markdown table."""
    lines = ["| arm | of | takes away | certificate |", "| --- | --- | --- | --- |"]
    for arm in ARMS.values():
        of = [taxonomy for taxonomy in ("occlusion", "chaotic") if arm.name in extra_datasets_of(taxonomy)]
        lines.append(f"| `{arm.name}` | {', '.join(of)} | {arm.takes_away} | {arm.promises} |")
    return "\n".join(lines)


if __name__ == "__main__":
    ON_PAGE.write(table() + "\n")
