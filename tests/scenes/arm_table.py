"""The table of arms in docs/arms.md, which `python -m tests.scenes.arm_table` writes from their definitions."""

from __future__ import annotations

from tests.build.page_tables import PageTable
from traps_pipeline.scenes.variants.arms import table

ON_PAGE = PageTable("arms.md", "arm")

if __name__ == "__main__":
    ON_PAGE.write(table() + "\n")
