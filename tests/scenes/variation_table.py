"""The table of variations in docs/hypotheses.md, which `python -m tests.scenes.variation_table` writes from them."""

from __future__ import annotations

from tests.build.page_tables import PageTable
from traps_pipeline.scenes.variants.variations import variation_table

ON_PAGE = PageTable("hypotheses.md", "variation: change")

if __name__ == "__main__":
    ON_PAGE.write(variation_table() + "\n")
