"""Run docs/inside.ipynb where its study is, and keep what each cell printed and drew:
`python -m tools.inside_notebook`."""

from __future__ import annotations

import base64
import io
import json
from contextlib import redirect_stdout
from pathlib import Path
from typing import Any

from traps_pipeline.base.digests import digest

NOTEBOOK = Path(__file__).resolve().parent.parent / "docs" / "inside.ipynb"


def identity(source: list[str]) -> str:
    """Return the id of a cell that was run as it stands."""
    return digest("".join(source))[:12]


def execute(cells: list[dict[str, Any]]) -> dict[str, Any]:
    """Run the code cells one after another and fill in their outputs; returns the names that they define."""
    import matplotlib as mpl

    mpl.use("agg")
    import matplotlib.pyplot as plt

    names: dict[str, Any] = {}
    code = [cell for cell in cells if cell["cell_type"] == "code"]
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
    """Run the notebook in place."""
    notebook = json.loads(NOTEBOOK.read_text(encoding="utf-8"))
    execute(notebook["cells"])
    for cell in notebook["cells"]:
        cell["id"] = identity(cell["source"])
    text = json.dumps(notebook, ensure_ascii=False, indent=1) + "\n"
    NOTEBOOK.write_text(text, encoding="utf-8", newline="\n")


if __name__ == "__main__":
    main()
