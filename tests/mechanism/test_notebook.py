"""The notebook of docs has what its cells print and draw; `test_inside` runs it on another study."""

from __future__ import annotations

import ast
import json

from tools.docs_hooks import notebook_page
from tools.inside_notebook import NOTEBOOK, identity


def test_every_cell_of_the_notebook_was_run_as_it_stands_and_keeps_what_it_printed_and_drew() -> None:
    written = json.loads(NOTEBOOK.read_text(encoding="utf-8"))
    code = [cell for cell in written["cells"] if cell["cell_type"] == "code"]
    pictures = [output for cell in code for output in cell["outputs"] if output["output_type"] == "display_data"]
    assert all(cell["outputs"] for cell in code) and len(pictures) >= 2
    assert [cell["execution_count"] for cell in code] == [*range(1, len(code) + 1)]
    changed = [cell["source"][0] for cell in written["cells"] if cell["id"] != identity(cell["source"])]
    assert not changed, "cells were changed: run `python -m tools.inside_notebook`"
    assert (written["nbformat"], written["nbformat_minor"]) == (4, 5)


def test_the_notebook_uses_nothing_below_the_researchers_interface() -> None:
    written = json.loads(NOTEBOOK.read_text(encoding="utf-8"))
    code = "\n".join("".join(cell["source"]) for cell in written["cells"] if cell["cell_type"] == "code")
    imports = [node for node in ast.walk(ast.parse(code)) if isinstance(node, ast.Import | ast.ImportFrom)]
    names = {f"{getattr(node, 'module', '')}.{alias.name}".strip(".") for node in imports for alias in node.names}
    assert names == {"traps_pipeline.inside", "matplotlib.pyplot", "pandas"}


def test_the_page_of_the_site_has_texts_code_output_and_pictures_in_order() -> None:
    page, (head, *_) = notebook_page(), json.loads(NOTEBOOK.read_text(encoding="utf-8"))["cells"]
    assert page.startswith("# ") and page.startswith("".join(head["source"]))
    first, printed, drawn = (page.index(part) for part in ("```python\n", "```text\n", "](data:image/png;base64,"))
    assert first < printed < drawn and page.count("```") % 2 == 0
