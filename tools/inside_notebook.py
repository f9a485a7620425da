"""docs/inside.ipynb from docs/inside.md, cell by cell, with what each cell printed and drew: run
`python -m tools.inside_notebook` where the page's study is.

A block of Python is a code cell; what stands between two is a text cell.
"""

from __future__ import annotations

import base64
import io
import json
import re
from contextlib import redirect_stdout
from pathlib import Path
from typing import Any

from traps_pipeline.base.digests import digest

DOCS = Path(__file__).resolve().parent.parent / "docs"
_BLOCK = re.compile(r"^```python\n(.*?)^```$", re.DOTALL | re.MULTILINE)


def cells(page: str) -> list[dict[str, Any]]:
    """Return the cells (nbformat 4.5, without outputs) of a page of Markdown."""
    parts = _BLOCK.split(page)  # text, code, text, code, ...
    return [_cell(number, part.strip("\n")) for number, part in enumerate(parts) if part.strip()]


def _cell(number: int, text: str) -> dict[str, Any]:
    common = {"id": digest([number, text])[:12], "metadata": {}, "source": text.splitlines(keepends=True)}
    if number % 2:
        return {"cell_type": "code", **common, "execution_count": None, "outputs": []}
    return {"cell_type": "markdown", **common}


def execute(made: list[dict[str, Any]]) -> dict[str, Any]:
    """Run the code cells one after another and fill in their outputs; returns the names that they define."""
    import matplotlib as mpl

    mpl.use("agg")
    import matplotlib.pyplot as plt

    names: dict[str, Any] = {}
    code = [cell for cell in made if cell["cell_type"] == "code"]
    for count, cell in enumerate(code, start=1):
        with redirect_stdout(io.StringIO()) as printed:
            exec(compile("".join(cell["source"]), f"cell {count}", "exec"), names)
        text = printed.getvalue().splitlines(keepends=True)
        cell["outputs"] = [{"output_type": "stream", "name": "stdout", "text": text}] if text else []
        for number in plt.get_fignums():
            picture = io.BytesIO()
            plt.figure(number).savefig(picture, dpi=80, bbox_inches="tight", metadata={"Software": None})
            plt.close(number)
            data = {"image/png": base64.b64encode(picture.getvalue()).decode(), "text/plain": ["<Figure>"]}
            cell["outputs"].append({"output_type": "display_data", "data": data, "metadata": {}})
        cell["execution_count"] = count
    return names


def main() -> None:
    """Run the page and write the notebook beside it."""
    notebook_cells = cells((DOCS / "inside.md").read_text(encoding="utf-8"))
    execute(notebook_cells)
    about = {
        "kernelspec": {"display_name": "Python 3", "language": "python", "name": "python3"},
        "language_info": {"name": "python"},
    }
    notebook = {"cells": notebook_cells, "metadata": about, "nbformat": 4, "nbformat_minor": 5}
    text = json.dumps(notebook, ensure_ascii=False, indent=1) + "\n"
    (DOCS / "inside.ipynb").write_text(text, encoding="utf-8", newline="\n")


if __name__ == "__main__":
    main()
