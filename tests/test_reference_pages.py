"""The generated reference: every table with its columns, every field of a YAML file with its meaning."""

from __future__ import annotations

import re

from tests.tables import TABLES
from tools.reference_pages import tables_page, yaml_page


def sections(page: str) -> dict[str, list[list[str]]]:
    """The rows of the table below each heading."""
    named = {}
    for section in page.split("\n## ")[1:]:
        lines = [line for line in section.splitlines() if line.startswith("| ")][2:]
        named[section.partition("\n")[0]] = [re.split(r" (?<!\\)\| ?", line.strip("| ")) for line in lines]
    return named


def test_each_table_has_its_columns() -> None:
    page = sections(tables_page())
    assert {*TABLES} < {*page} and {"items of a release", "items of a release, held out"} < {*page}
    for name, table in TABLES.items():
        assert [row[0].strip("*`") for row in page[name]] == table.names
        assert all(len(row) == 3 and row[2] for row in page[name])


def test_each_field_that_people_write_has_a_meaning_and_each_section_is_there() -> None:
    page = sections(yaml_page())
    for name in ("An experiment", "study.yaml", "A model", "A judge", "A correction", "MechanismSettings"):
        assert all(len(row) == 4 and row[3] for row in page[name]), name
    links = re.findall(r"\]\(#([a-z]+)\)", yaml_page())
    assert {*links} <= {name.lower() for name in page}
