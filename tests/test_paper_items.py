"""The table of the paper's items names files and tests that exist, and the page is made from it."""

from __future__ import annotations

import ast
from functools import cache

from tools.paper_items import PAGE, ROOT, STATUSES, items, page

ITEMS = items()


@cache
def names_in(path: str) -> set[str]:
    """The names of the tests in a file; those that are skipped or expected to fail are none."""
    tree = ast.parse((ROOT / path).read_text(encoding="utf-8"))
    found = [node for node in tree.body if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)]
    marked = {node.name for node in found for mark in node.decorator_list if {"skip", "xfail"} & _names(mark)}
    return {node.name for node in found if node.name.startswith("test_")} - marked


def _names(node: ast.AST) -> set[str]:
    return {part.attr for part in ast.walk(node) if isinstance(part, ast.Attribute)}


def test_the_215_items_are_numbered_in_order() -> None:
    assert [int(row["n"]) for row in ITEMS] == list(range(1, 216))
    assert {row["status"] for row in ITEMS} <= set(STATUSES)


def test_every_items_place_and_test_exist() -> None:
    for row in ITEMS:
        assert not row["place"] or (ROOT / row["place"]).is_file(), row
        path, _, name = row["test"].partition("::")
        assert not row["test"] or name in names_in(path), row
        assert (row["place"] and row["test"]) if row["status"] == "there" else row["note"], row


def test_the_page_is_what_the_data_give() -> None:
    assert PAGE.read_text(encoding="utf-8") == page()
