"""The table of arms in docs/arms.md, which `python -m tests.scenes.arm_table` writes from their definitions."""

from __future__ import annotations

from tests.build.page_tables import PageTable
from traps_pipeline.protocol.datasets import extra_datasets_of, sides_of
from traps_pipeline.scenes.variants.arms import ARMS

ON_PAGE = PageTable("arms.md", "arm")


def table() -> str:
    """Return the arms as a Markdown table."""
    lines = ["| arm | of | asks | takes away | certificate |", "| --- | --- | --- | --- | --- |"]
    for arm in ARMS.values():
        of = [taxonomy for taxonomy in ("occlusion", "chaotic") if arm.name in extra_datasets_of(taxonomy)]
        asks = {"control": "must be answered", "void": "must be abstained on"}
        asked = ", ".join(asks[side] for side in sides_of(arm.name))
        lines.append(f"| `{arm.name}` | {', '.join(of)} | {asked} | {arm.takes_away} | {arm.promises} |")
    return "\n".join(lines)


if __name__ == "__main__":
    ON_PAGE.write(table() + "\n")
