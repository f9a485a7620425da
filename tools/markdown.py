"""Write docstrings and tables as Markdown, for the generated pages of the documentation."""

from __future__ import annotations

import re
from collections.abc import Sequence


def prose(text: str | None) -> str:
    """Return a docstring as Markdown: paragraphs as they are, indented parts and examples as code."""
    text = re.sub(r"^Examples\n-+\n", "Example:\n\n", text or "", flags=re.MULTILINE)
    return "\n\n".join(map(_paragraph, text.split("\n\n")))


def _paragraph(text: str) -> str:
    if text.startswith(">>> "):
        return f"```pycon\n{text}\n```"
    return text if text.startswith("    ") else escaped(text)


def escaped(text: str) -> str:
    """Return prose that Markdown takes for nothing else; code in backticks stays code."""
    parts = re.split(r"(`[^`]*`)", text)
    return "".join(part if part.startswith("`") else re.sub(r"([*_<>\[\]#|])", r"\\\1", part) for part in parts)


def markdown_table(headings: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a table; a bar in a cell stays a bar."""
    lines = [headings, ["---" for _ in headings], *rows]
    return "\n".join("| " + " | ".join(re.sub(r"(?<!\\)\|", r"\\|", cell) for cell in line) + " |" for line in lines)
