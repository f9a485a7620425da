"""docs/inside.ipynb from docs/inside.md, cell by cell, so that the two never differ: run `tools/inside_notebook.py`.

A block of Python is a code cell, and what stands between two is a text cell. Nothing is run: the test of the page runs
its blocks, and another one compares the notebook with what this writes.
"""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

from traps_pipeline.base.digests import digest

DOCS = Path(__file__).resolve().parent.parent / "docs"
_BLOCK = re.compile(r"^```python\n(.*?)^```$", re.DOTALL | re.MULTILINE)


def notebook(page: str) -> str:
    """The notebook (nbformat 4.5, without outputs) of a page of Markdown, as the text of its file."""
    parts = _BLOCK.split(page)  # text, code, text, code, ...
    cells = [_cell(number, part.strip("\n")) for number, part in enumerate(parts) if part.strip()]
    about = {
        "kernelspec": {"display_name": "Python 3", "language": "python", "name": "python3"},
        "language_info": {"name": "python"},
    }
    whole = {"cells": cells, "metadata": about, "nbformat": 4, "nbformat_minor": 5}
    return json.dumps(whole, ensure_ascii=False, indent=1) + "\n"


def _cell(number: int, text: str) -> dict[str, Any]:
    common = {"id": digest([number, text])[:12], "metadata": {}, "source": text.splitlines(keepends=True)}
    if number % 2:
        return {"cell_type": "code", **common, "execution_count": None, "outputs": []}
    return {"cell_type": "markdown", **common}


def main() -> None:
    """Write the notebook beside its page."""
    page = (DOCS / "inside.md").read_text(encoding="utf-8")
    (DOCS / "inside.ipynb").write_text(notebook(page), encoding="utf-8", newline="\n")


if __name__ == "__main__":
    main()
