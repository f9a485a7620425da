"""Names in back-quotes, in docstrings and comments of the package, are those of something."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

from tests.conftest import ROOT

QUOTED = re.compile(r"`([A-Za-z_][\w.]*\w)(?:\([^`]*\))?`")
WORD = re.compile(r"\w+")
COMMENT = re.compile(r"(?:^|\s)# .*")
# Placeholders, as `of_COLUMN`, and beginnings and ends of names, as `_deg`.
PATTERN = re.compile(r"\w*[A-Z]{3,}\w*|_[a-z]{1,3}")
DEFINED_ELSEWHERE = {
    *("settexture", "makePlane", "discrete", "AssetCheckResult", "Markup", "logit_bias"),  # by libraries and providers
    *("domino_0", "layer_000", "control_low", "guided_results"),  # put together when run
    *("model__regime__steered", "model__directionregime__inferenceregime"),  # keys of partitions, in words
    "reservations",  # a table of the ledger, without the prefix of all its tables
}
OTHER = (
    *("traps_pipeline/**/*.js", "traps_pipeline/**/*.j2", "assets/**/*.yaml", "assets/**/*.csv", "scene_specs/*.yaml"),
    *("tools/**/*.py", "tests/*/**/*.py", "bench/*.py", "*.py"),
)


def said_and_named(text: str) -> tuple[list[tuple[int, str]], set[str]]:
    """Docstrings and comments of a module, with their lines, and all words of the rest."""
    said, lines = list[tuple[int, str]](), text.splitlines()
    for node in ast.walk(ast.parse(text)):
        for part in getattr(node, "body", []) if isinstance(node, ast.stmt | ast.mod) else []:
            if isinstance(part, ast.Expr) and isinstance(part.value, ast.Constant):
                said.append((part.lineno, "\n".join(lines[part.lineno - 1 : part.end_lineno])))
                lines[part.lineno - 1 : part.end_lineno] = [""] * ((part.end_lineno or 0) - part.lineno + 1)
    for number, line in enumerate(lines):
        if found := COMMENT.search(line):
            said.append((number + 1, found[0]))
            lines[number] = line[: found.start()]
    return said, {*WORD.findall("\n".join(lines))}


def unknown(said: list[tuple[int, str]], known: set[str]) -> Iterator[str]:
    """The line and name of each quoted name of which a part is not known."""
    for line, text in said:
        for found in QUOTED.finditer(text):
            parts = [part for part in found[1].split(".") if not PATTERN.fullmatch(part)]
            if not {*parts} <= known:
                yield f"{line + text.count(chr(10), 0, found.start())}: {found[1]}"


def test_a_quoted_name_is_that_of_something() -> None:
    said: dict[Path, list[tuple[int, str]]] = {}
    known = {*DEFINED_ELSEWHERE}
    for path in (ROOT / "traps_pipeline").rglob("*.py"):
        said[path], named = said_and_named(path.read_text(encoding="utf-8"))
        known |= named | {*path.relative_to(ROOT).with_suffix("").parts, "py"}
    for path in (path for pattern in OTHER for path in ROOT.glob(pattern)):
        known |= {*WORD.findall(path.read_text(encoding="utf-8")), path.stem}
    found = [f"{path.relative_to(ROOT)}:{one}" for path, lines in said.items() for one in unknown(lines, known)]
    assert sum(map(len, said.values())) > 5000
    assert not found, "\n".join(found)


def test_a_name_that_no_longer_exists_is_told_with_its_line() -> None:
    text = '"""Say it.\n\nAs `kept.gone_away` of `SOME_NAME` does."""\nkept = 1  # `kept`, not `left_over()`\n'
    said, named = said_and_named(text)
    assert list(unknown(said, named)) == ["3: kept.gone_away", "4: left_over"]
