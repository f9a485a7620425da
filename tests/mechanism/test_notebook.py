"""The notebook of docs is its page, cell by cell; `test_inside` runs the page's blocks."""

from __future__ import annotations

import json
import re

from tests.conftest import ROOT
from tools.inside_notebook import notebook

DOCS = ROOT / "docs"


def test_the_notebook_is_what_its_page_makes() -> None:
    page = (DOCS / "inside.md").read_text(encoding="utf-8")
    assert (DOCS / "inside.ipynb").read_text(encoding="utf-8") == notebook(page), (
        "docs/inside.md was changed: run `python tools/inside_notebook.py`"
    )


def test_its_code_cells_are_the_blocks_that_run_and_its_text_is_all_the_rest() -> None:
    page = (DOCS / "inside.md").read_text(encoding="utf-8")
    made = json.loads((DOCS / "inside.ipynb").read_text(encoding="utf-8"))
    code = ["".join(cell["source"]) for cell in made["cells"] if cell["cell_type"] == "code"]
    assert [f"{block}\n" for block in code] == re.findall(r"^```python\n(.*?)^```$", page, re.DOTALL | re.MULTILINE)
    assert all(compile(block, "cell", "exec") for block in code) and len(code) >= 6
    text = "".join("".join(cell["source"]) for cell in made["cells"] if cell["cell_type"] == "markdown")
    rest = re.sub(r"^```python\n.*?^```$", "", page, flags=re.DOTALL | re.MULTILINE)
    assert "".join(text.split()) == "".join(rest.split())
    assert (made["nbformat"], made["nbformat_minor"]) == (4, 5) and len({c["id"] for c in made["cells"]}) == len(
        made["cells"]
    )


def test_a_page_by_hand() -> None:
    made = json.loads(notebook("# One\n\n```python\na = 1\nb = 2\n```\n\n```\nno python\n```\n"))
    assert [(cell["cell_type"], "".join(cell["source"])) for cell in made["cells"]] == [
        ("markdown", "# One"),
        ("code", "a = 1\nb = 2"),
        ("markdown", "```\nno python\n```"),
    ]
