"""The table of variations in docs/hypotheses.md, written from their definitions.

`python -m tests.scenes.variation_table` writes it; a test holds the page against it.
"""

from __future__ import annotations

import re

from tests.conftest import ROOT
from traps_pipeline.scenes.variants.variations import table

PAGE = ROOT / "docs" / "hypotheses.md"
TABLE = re.compile(r"^\| variation: change \|.*\n(?:\|.*\n)+|^VARIATIONS\n", re.MULTILINE)


def written() -> str:
    """The table as it stands on the page."""
    (found,) = TABLE.findall(PAGE.read_text(encoding="utf-8"))
    return found


if __name__ == "__main__":
    PAGE.write_text(PAGE.read_text(encoding="utf-8").replace(written(), table() + "\n"), encoding="utf-8")
