"""The notebook of docs is its page, cell by cell, with outputs; `test_inside` runs the page's blocks."""

from __future__ import annotations

import json

from tests.conftest import ROOT
from tools.inside_notebook import cells, execute

DOCS = ROOT / "docs"


def test_the_notebook_is_its_page_with_what_every_cell_printed_and_drew() -> None:
    page = (DOCS / "inside.md").read_text(encoding="utf-8")
    written = json.loads((DOCS / "inside.ipynb").read_text(encoding="utf-8"))
    code = [cell for cell in written["cells"] if cell["cell_type"] == "code"]
    pictures = [output for cell in code for output in cell["outputs"] if output["output_type"] == "display_data"]
    assert all(cell["outputs"] for cell in code) and len(pictures) >= 3
    assert [cell["execution_count"] for cell in code] == [*range(1, len(code) + 1)]
    plain = [
        cell | ({"outputs": [], "execution_count": None} if cell["cell_type"] == "code" else {})
        for cell in written["cells"]
    ]
    assert plain == cells(page), "docs/inside.md was changed: run `python -m tools.inside_notebook`"
    assert (written["nbformat"], written["nbformat_minor"]) == (4, 5)


def test_a_page_by_hand_is_run_and_what_it_prints_and_draws_is_kept() -> None:
    made = cells("# One\n\n```python\na = 1\nprint(a)\n```\n\n```\nno python\n```\n\n```python\na = a + 1\n"
                 "import matplotlib.pyplot as plt\nplt.plot([a])\n```\n")  # fmt: skip
    assert [cell["cell_type"] for cell in made] == ["markdown", "code", "markdown", "code"]
    assert execute(made)["a"] == 2
    assert made[1]["outputs"] == [{"output_type": "stream", "name": "stdout", "text": ["1\n"]}]
    (picture,) = made[3]["outputs"]
    assert picture["data"]["image/png"].startswith("iVBOR") and made[3]["execution_count"] == 2
