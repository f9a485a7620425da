"""A table has the same content in every format, escaped for it; a file has the same bytes on every build."""

from __future__ import annotations

import io
import re

import numpy as np
import pandas as pd
import pytest

from tests.build.latex import latex_cells
from traps_pipeline.report.latex_tables import LONG, latex, latex_table
from traps_pipeline.report.writing import (
    NOT_RUN,
    Column,
    PrintedTable,
    SourceItems,
    figure_files,
    figure_style,
    new_figure,
    table_files,
    table_html,
)

HOSTILE = r"<b>\input{/etc/passwd}</b> $x_1$ & 5 % #~^{|`*"
COLUMNS = (
    Column("model", "Model"),
    Column("acc", "Acc %", "percent", spread="acc_std", mark="mark"),
    Column("j", "J", "fraction"),
    Column("gap", "Gap", "ratio"),
    Column("n", "n", "count"),
)


def table(**other):
    """Two rows: one whole, one hostile and with gaps."""
    rows = pd.DataFrame(
        {
            "model": ["plain", HOSTILE],
            "acc": [0.1234, np.nan],
            "acc_std": [0.01, np.nan],
            "mark": ["†", ""],
            "j": [-0.5, 0.25],
            "gap": [np.inf, np.nan],
            "n": [202, 202],
            "epoch": ["e1", "e1"],
        }
    )
    return PrintedTable("results", "Results & more", rows, COLUMNS, ["epoch e1"], **other)


def test_cells_are_printed_in_their_units_with_spread_and_mark():
    first, second = table().cells
    assert first == ["plain", "12.3 ± 1.0 †", "−0.500", "∞", "202"]
    assert second[1:] == ["–", "0.250", "–", "202"]


def test_a_p_value_is_never_printed_as_0():
    column = Column("p", "p", "p")
    assert [column.text({"p": p}) for p in (0.0, 0.00009, 0.0001, 0.5, None, np.nan)] == [
        "< 0.0001", "< 0.0001", "0.0001", "0.5000", "–", "–",
    ]  # fmt: skip


def test_a_dash_and_a_spread_are_explained_where_they_occur():
    note, *meanings = table().remarks
    assert (note, [meaning.partition(" ")[0] for meaning in meanings]) == ("epoch e1", ["±", "–"])
    whole = PrintedTable("t", "T", pd.DataFrame({"n": [1]}), [Column("n", "n", "count")])
    assert whole.remarks == []


def test_every_latex_character_of_a_text_is_printed_and_commands_nothing():
    assert latex("a_b & 5 % $x$ #{}") == r"a\_b \& 5 \% \$x\$ \#\{\}"
    assert latex('Δ "so"') == r"$\Delta$ ''so''"
    assert latex("\\~^") == r"\textbackslash{}\textasciitilde{}\textasciicircum{}"
    text = table_files(table())["results.tex"].decode()
    assert r"\input" not in text
    assert r"\caption{Results \& more. epoch e1." in text
    cells = latex_cells(text)
    assert [len(row) for row in cells] == [5, 5]
    assert cells[0][1].strip() == r"12.3 $\pm$ 1.0 \dag{}"
    bare = re.sub(r"\\[{}]", "", text)  # escaped braces aside, they balance
    assert bare.count("{") == bare.count("}")


def test_markdown_keeps_a_hostile_text_in_its_cell():
    lines = [line for line in table_files(table())["results.md"].decode().splitlines() if line.startswith("|")]
    assert {len(re.findall(r"(?<!\\)\|", line)) for line in lines} == {6}
    assert "<b>" not in lines[-1]
    assert r"\$x\_1\$" in lines[-1]


def test_html_escapes_texts_and_links_numbers_to_their_items():
    page = table_html(
        table(trace=lambda row, field: SourceItems(model="m")), lambda behind: f"items/{behind.model}.html#<x>"
    )
    assert "<b>" not in page
    assert "&lt;b&gt;" in page
    assert page.count("<a href=") == 6  # of eight numbers two are dashes
    assert "#&lt;x&gt;" in page
    assert "<a " not in table_html(table())


def test_csv_holds_the_numbers_behind_what_is_printed():
    frame = pd.read_csv(io.BytesIO(table_files(table())["results.csv"]))
    assert list(frame.columns) == ["model", "acc", "acc_std", "j", "gap", "n", "mark", "epoch"]
    assert frame["acc"][0] == 0.1234
    assert frame["model"][1] == HOSTILE
    assert np.isnan(frame["acc"][1])


def test_a_table_without_rows_says_not_run_and_why_everywhere():
    empty = PrintedTable("t", "T", pd.DataFrame(columns=["model", "acc"]), COLUMNS[:2], why="nobody was asked")
    files = table_files(empty)
    for text in (files["t.md"].decode(), files["t.tex"].decode(), table_html(empty)):
        assert NOT_RUN in text and "nobody was asked" in text
    assert files["t.csv"].decode().splitlines() == ["model,acc,acc_std"]


@pytest.mark.slow
def test_files_have_the_same_bytes_on_a_second_build():
    assert table_files(table()) == table_files(table())
    with figure_style():
        figures = [new_figure(1, 1), new_figure(1, 1)]
        for figure in figures:
            figure.add_subplot().set_title("Doubt")
    files, again = (figure_files("f", figure) for figure in figures)
    assert files == again
    assert [content[:4] for content in files.values()] == [b"%PDF", b"<?xm", b"\x89PNG"]
    assert b"CreationDate" not in files["f.pdf"]
    assert b"<dc:date>" not in files["f.svg"]


@pytest.mark.parametrize("count", [LONG, LONG + 1])
def test_latex_is_what_the_styler_of_pandas_writes(count: int):
    """Rows of short and of long tables, by the library whose templates `latex_table` replaces."""
    rows = [[f"model {k}", f"0.{k}"] for k in range(count)]
    styler = pd.DataFrame(rows, columns=pd.Index(["Model", "J"])).style.hide(axis="index")
    long = count > LONG
    expected = styler.to_latex(
        hrules=True,
        caption="A table.",
        label="tab:a",
        column_format="lr",
        environment="longtable" if long else None,
        position=None if long else "t",
        position_float=None if long else "centering",
    )
    assert latex_table("A table.", "tab:a", ["Model", "J"], rows, "lr") == expected
