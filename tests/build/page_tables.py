"""Tables of pages of docs that are written from definitions: a test holds the page against them."""

from __future__ import annotations

import re
from dataclasses import dataclass

from tests.conftest import ROOT


@dataclass(frozen=True)
class PageTable:
    """The table of a page whose first column has this heading."""

    page: str
    heading: str

    def written(self) -> str:
        """The table as it stands on the page."""
        text = (ROOT / "docs" / self.page).read_text(encoding="utf-8")
        (found,) = re.findall(rf"^\| {self.heading} \|.*\n(?:\|.*\n)+", text, re.MULTILINE)
        return found

    def write(self, table: str) -> None:
        """Put the table on the page."""
        path = ROOT / "docs" / self.page
        path.write_text(path.read_text(encoding="utf-8").replace(self.written(), table), encoding="utf-8")
