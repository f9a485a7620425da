"""What mkdocs does for this project beyond its settings: README as the first page, files that pages link to, reference.

A page of `docs/` links to the rest of the repository (`../CONTRIBUTING.md`); on the site such a file lies below
`repository/`. The reference is written from docstrings, tables and the classes that check YAML. The notebook becomes a
page with what its cells printed and drew.
"""

from __future__ import annotations

import ast
import json
import posixpath
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from mkdocs.structure.files import File, Files

from tools.markdown import prose

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "traps_pipeline"
NOTEBOOK, NOTEBOOK_PAGE = ROOT / "docs" / "inside.ipynb", "inside.md"
LINK = re.compile(r"(\]\()(?!\w+:|#)([^)\s#]+)")
OUTSIDE = "repository"


def on_files(files: Files, config: Any) -> Files:
    """Add the first page, every file of the repository that a page links to, and the reference."""
    waiting = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
    seen = set(waiting)
    while waiting:
        page = waiting.pop()
        for target in _targets(page):
            if target not in seen and target.is_file():
                seen.add(target)
                waiting += [target] if target.suffix == ".md" else []
    for path in sorted(seen):
        if not path.is_relative_to(ROOT / "docs"):  # mkdocs finds these itself
            files.append(File.generated(config, _place(path), content=path.read_bytes()))
    files.append(File.generated(config, NOTEBOOK_PAGE, content=notebook_page()))
    for place, content in reference().items():
        files.append(File.generated(config, place, content=content))
    return files


def on_page_markdown(markdown: str, page: Any, config: Any, files: Files) -> str:
    """Return point links at where the files lie on the site. Links in code are left alone."""
    source = _source(page.file.src_uri)
    if source is None:
        return markdown
    here = posixpath.dirname(page.file.src_uri)

    def moved(found: re.Match[str]) -> str:
        target = (source.parent / found[2]).resolve()
        return found[1] + (posixpath.relpath(_place(target), here or ".") if target.is_relative_to(ROOT) else found[2])

    parts = re.split(r"(^```.*?^```$)", markdown, flags=re.DOTALL | re.MULTILINE)
    return "".join(part if part.startswith("```") else LINK.sub(moved, part) for part in parts)


def _targets(page: Path) -> Iterator[Path]:
    text = re.sub(r"^```.*?^```$", "", page.read_text(encoding="utf-8"), flags=re.DOTALL | re.MULTILINE)
    yield from ((page.parent / found[2]).resolve() for found in LINK.finditer(text))


def _place(path: Path) -> str:
    """Return where a file of the repository lies on the site."""
    if path == ROOT / "README.md":
        return "index.md"
    if path == NOTEBOOK:
        return NOTEBOOK_PAGE
    if path.is_relative_to(ROOT / "docs"):
        return path.relative_to(ROOT / "docs").as_posix()
    return f"{OUTSIDE}/{path.relative_to(ROOT).as_posix()}"


def _source(place: str) -> Path | None:
    """Return the file of the repository behind a page of the site; None for a generated page."""
    if place == "index.md":
        return ROOT / "README.md"
    if place.startswith(("reference/", "families")):
        return None
    return ROOT / place.removeprefix(f"{OUTSIDE}/") if place.startswith(f"{OUTSIDE}/") else ROOT / "docs" / place


def notebook_page() -> str:
    """Return the notebook as Markdown: its texts, and its code with what each cell printed and drew."""
    parts = []
    for cell in json.loads(NOTEBOOK.read_text(encoding="utf-8"))["cells"]:
        source = "".join(cell["source"])
        parts.append(source if cell["cell_type"] == "markdown" else f"```python\n{source}\n```")
        for output in cell.get("outputs", ()):
            if output["output_type"] == "stream":
                parts.append(f"```text\n{''.join(output['text'])}```")
            else:
                parts.append(f"![what the cell draws](data:image/png;base64,{output['data']['image/png']})")
    return "\n\n".join(parts) + "\n"


# --- the reference ----------------------------------------------------------------------------------------------------


def reference() -> dict[str, str | bytes]:
    """Return each page by its place: Python, tables, YAML fields, certificates, and families with pictures."""
    from tools.family_pages import family_pages
    from tools.reference_pages import certificates_page, tables_page, yaml_page

    head = "# Python\n\nFor everyone who opens a study in a [notebook](../inside.md): the module whose names stay."
    python = f"{head}\n\n{_module(PACKAGE / 'inside.py')}"
    pages = {"python": python, "tables": tables_page(), "yaml": yaml_page(), "certificates": certificates_page()}
    return {f"reference/{name}.md": page for name, page in pages.items()} | family_pages()


def _module(path: Path) -> str:
    """Return the section of a module: its docstring, and its public classes and functions."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    name = ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")
    members = "\n".join(_members(tree, ""))
    about = ast.get_docstring(tree)
    return f"## {name}\n\n{prose(about)}\n\n{members}" if members else ""


def _members(tree: ast.Module | ast.ClassDef, owner: str) -> Iterator[str]:
    for node in tree.body:
        if not isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef) or node.name.startswith("_"):
            continue
        about = ast.get_docstring(node)
        if about is None:
            continue
        head = f"{'####' if owner else '###'} `{owner}{node.name}`"
        yield f"{head}\n\n```python\n{_signature(node)}\n```\n\n{prose(about)}\n"
        if isinstance(node, ast.ClassDef):
            yield from _members(node, f"{node.name}.")


def _signature(node: ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef) -> str:
    if isinstance(node, ast.ClassDef):
        fields = [f"    {ast.unparse(one)}" for one in node.body if isinstance(one, ast.AnnAssign)]
        bases = f"({', '.join(map(ast.unparse, node.bases))})" if node.bases else ""
        return "\n".join([f"class {node.name}{bases}:" if fields else f"class {node.name}{bases}", *fields])
    kind = "async def" if isinstance(node, ast.AsyncFunctionDef) else "def"
    returns = f" -> {ast.unparse(node.returns)}" if node.returns else ""
    return f"{kind} {node.name}({ast.unparse(node.args)}){returns}"
