"""The table of certificates in docs/scenes.md, which `python -m tests.scenes.certificate_table` writes from them."""

from __future__ import annotations

from tests.build.page_tables import PageTable
from traps_pipeline.scenes.certification.certificates import table

ON_PAGE = PageTable("scenes.md", "certificate")

if __name__ == "__main__":
    ON_PAGE.write(table() + "\n")
