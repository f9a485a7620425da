"""Write tables and figures in all formats, with the same bytes on every build.

A `PrintedTable` is a frame of numbers with printed columns; it becomes CSV (unrounded numbers), LaTeX, Markdown,
text for a terminal and HTML (printed numbers). Its texts are untrusted: each medium escapes them.
"""

from __future__ import annotations

import html
import io
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, fields, replace
from functools import cache, cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from traps_pipeline.base.paths import ASSETS
from traps_pipeline.base.sheets import csv_bytes
from traps_pipeline.base.terminal import TextTable, finalize_value, plain
from traps_pipeline.models.registry.entries import is_reference
from traps_pipeline.report.latex_tables import latex, latex_of_plain, latex_table
from traps_pipeline.report.numbers import NONE, as_numbers

if TYPE_CHECKING:
    import jinja2
    import pandas as pd
    from matplotlib.figure import Figure

TEMPLATES = Path(__file__).parent / "templates"
STYLE = ASSETS / "figures.mplstyle"
NOT_RUN = "not run"
REFERENCE_ROWS = "Reference rows"  # of strategies and rules, which no text calls models
FIGURE_KINDS = ("pdf", "svg", "png")

COLUMN_IN, PAGE_IN = 3.3, 6.8  # widths of a figure of one column, and of two
# Okabe and Ito's palette without its yellow, which is too light for a hollow marker, and with its black as grey.
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00", "#4D4D4D")
MARKERS = ("o", "s", "^", "D", "v", "P", "X", "<", "p", ">", "h", "*", "d")  # with 7 colours: 91 models
INK, SOFT, GRID = "#1b1f27", "#667085", "#d0d5dd"

# A range is a text of two numbers; it is aligned and linked like a number.
Unit = Literal["text", "range", "count", "percent", "fraction", "ratio", "p"]
DIGITS: Mapping[str, int] = {"percent": 1, "fraction": 3, "ratio": 1, "count": 0, "p": 4}


@dataclass(frozen=True)
class SourceItems:
    """The items behind a number; an empty field means all."""

    dataset: str = ""
    model: str = ""
    regime: str = ""
    side: str = ""


class NotRun(Exception):
    """Raised for a figure without data; the message gives the reason, for people."""


Trace = Callable[[Mapping[str, Any], str], SourceItems | None]  # row and field -> the items behind that number


# --- numbers as printed -----------------------------------------------------------------------------------------------


def fraction(value: float | None, digits: int = 3) -> str:
    """Return a number as printed, with a typographic minus sign; a dash for null."""
    import pandas as pd

    if value is None or pd.isna(value):
        return NONE
    if value in (float("inf"), float("-inf")):
        return "∞" if value > 0 else "−∞"
    text = f"{value:.{digits}f}"
    return text.replace("-", "−") if float(text) else text.removeprefix("-")


def percent(value: float | None, digits: int = 1) -> str:
    """Return a share (0 to 1) in percent, without the sign."""
    return fraction(None if value is None else 100 * value, digits)


# --- tables -----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Column:
    """A printed column: the frame's field, its heading, and its format.

    Shares are fractions in the frame; `percent` prints them times 100. `spread` names the field of a standard
    deviation, which is printed after ±; `mark` names a field of text, such as a dagger, which is printed after the
    number; `interval`: whether its `_ci_low` and `_ci_high` follow in brackets. For pages: the style of the cells (a
    row's head, an emphasised number, a tag), whether a fraction is also drawn as a bar, and a group begins here.
    """

    field: str
    heading: str
    unit: Unit = "text"
    digits: int | None = None
    spread: str = ""
    mark: str = ""
    look: Literal["", "head", "strong", "tag"] = ""
    bar: bool = False
    group: bool = False
    interval: bool = False

    @property
    def is_number(self) -> bool:
        """Whether the column holds numbers, which are aligned to the right."""
        return self.unit != "text"

    def text(self, row: Mapping[str, Any]) -> str:
        """Return a table's cell as text; a dash where there is no number."""
        return _joined(self.parts(row))

    def parts(self, row: Mapping[str, Any], plain: Callable[[object], str] = plain) -> tuple[str, str, str]:
        """Return a cell's text or number, spread and mark, as printed; empty if none. plain: makes a text plain."""
        import pandas as pd

        value = row.get(self.field)
        if row.get("model") == REFERENCE_ROWS:
            return value or "", "", ""
        if self.unit in ("text", "range"):
            return "" if value is None or value is pd.NA or value != value else plain(value), "", ""
        printed = self._number(value)
        low, high = (self._number(row.get(f"{self.field}_ci_{end}")) for end in ("low", "high"))
        if self.interval and NONE not in (printed, low):
            printed += f" [{low}, {high}]"
        spread = self._number(row.get(self.spread)) if self.spread and printed != NONE else NONE
        mark = row.get(self.mark) if self.mark else ""
        return printed, "" if spread == NONE else spread, plain(mark) if isinstance(mark, str) and mark else ""

    def _number(self, value: Any) -> str:
        digits = DIGITS[self.unit] if self.digits is None else self.digits
        if self.unit == "p" and value is not None and value < 10**-digits:
            return f"< {10**-digits:.{digits}f}"
        return percent(value, digits) if self.unit == "percent" else fraction(value, digits)


def _joined(parts: tuple[str, str, str]) -> str:
    printed, spread, mark = parts
    return printed + (f" ± {spread}" if spread else "") + (f" {mark}" if mark else "")


@dataclass(frozen=True)
class PrintedTable:
    """A table for people: a frame, its printed columns, and notes (epoch, n, gaps).

    A table without rows says that it was not run, and `why`; if it was run and is legitimately empty, it prints `none`
    instead. Reference rows come last, below a heading. `trace` returns the items behind a number, or None; `dash` and
    `deviation` are the meanings of a dash and of ±; `lead` is a sentence after the title.
    """

    name: str
    title: str
    rows: pd.DataFrame
    columns: Sequence[Column]
    notes: Sequence[str] = ()
    why: str = ""
    trace: Trace | None = None
    none: str = ""
    dash: str = f"{NOT_RUN}, or undefined because no item is decided"
    lead: str = ""
    deviation: str = "± population standard deviation over runs"

    @cached_property
    def parts(self) -> list[list[tuple[str, str, str]]]:
        """The text or number, spread and mark of each cell, as printed: a list per row."""
        of_text = cache(plain)  # a column has few different texts
        return [[column.parts(row, of_text) for column in self.columns] for row in self.records]

    @cached_property
    def cells(self) -> list[list[str]]:
        """The printed text of each cell: a list per row."""
        return [[*map(_joined, row)] for row in self.parts]

    @cached_property
    def records(self) -> list[dict[str, Any]]:
        """The rows as mappings: of models, then a heading and reference rows."""
        rows: list[dict[str, Any]] = self.rows.to_dict("records")  # pyright: ignore[reportAssignmentType]
        if not self.columns or self.columns[0].field != "model":
            return rows
        models, others = ([row for row in rows if is_reference(row["model"]) == kind] for kind in (False, True))
        return [*models, *([{"model": REFERENCE_ROWS}, *others] if others else [])]

    @property
    def content(self) -> str:
        """A text of all that the table prints, links and exports; equal content gives equal files."""
        words = [getattr(self, field.name) for field in fields(self) if field.name not in ("rows", "trace")]
        return repr([*words, [*self.rows.columns], self.records])

    @cached_property
    def marked(self) -> set[Column]:
        """The columns with a mark on some number; their other cells leave space for one."""
        return {column for k, column in enumerate(self.columns) if any(row[k][2] for row in self.parts)}

    @property
    def absence(self) -> str:
        """The text that replaces the rows of a table without rows; empty if there are any."""
        return "" if len(self.rows) else self.none or (f"{NOT_RUN}: {self.why}" if self.why else NOT_RUN)

    @property
    def remarks(self) -> list[str]:
        """The notes, with the meaning of ± and of a dash if the table has them."""
        cells = [cell for row in self.cells for cell, column in zip(row, self.columns, strict=True) if column.is_number]
        dashes = [f"{NONE} {self.dash}"] if any(cell.startswith(NONE) for cell in cells) else []
        spreads = [self.deviation] if any("±" in cell for cell in cells) else []
        return [*(note for note in self.notes if note), *spreads, *dashes]

    @property
    def data(self) -> pd.DataFrame:
        """A frame of the printed cells' numbers: columns and their spreads, then all other fields."""
        import pandas as pd

        printed_fields = [field for column in self.columns for field in (column.field, column.spread) if field]
        fields = dict.fromkeys([*printed_fields, *map(str, self.rows.columns)])
        data = self.rows.reindex(columns=pd.Index(list(fields)))
        words = {column.field for column in self.columns if column.unit == "text"}
        texts = [str(name) for name, kind in data.dtypes.items() if kind.kind == "O" and name not in words]
        return data.assign(**{field: as_numbers(pd.Series(data[field])) for field in texts})


def table_files(table: PrintedTable) -> dict[str, bytes]:
    """Return a table's files: `name.csv` (fractions), `.tex` and `.md`."""
    return {
        f"{table.name}.csv": csv_bytes(table.data),
        f"{table.name}.tex": table_latex(table).encode(),
        f"{table.name}.md": table_markdown(table).encode(),
    }


def table_markdown(table: PrintedTable) -> str:
    """Return a table in Markdown with its title and notes; texts are escaped."""
    title = f"**{markdown(table.title)}.** {markdown(table.lead)}" if table.lead else f"**{markdown(table.title)}**"
    lines = [title, ""]
    if table.absence:
        lines += [markdown(table.absence)]
    else:
        rule = ["---:" if column.is_number else "---" for column in table.columns]
        header = [markdown(column.heading) for column in table.columns]
        body = [[markdown(cell) for cell in row] for row in table.cells]
        lines += ["| " + " | ".join(cells) + " |" for cells in (header, rule, *body)]
    notes = [markdown(note) for note in table.remarks]
    return "\n".join([*lines, *([""] if notes else []), *(f"- {note}" for note in notes)]) + "\n"


def table_text(table: PrintedTable) -> TextTable:
    """Return a table with its title and notes as standard output prints it."""
    title = f"{table.title}. {table.lead}" if table.lead else table.title
    if table.absence:
        return TextTable(title, [], [], [], table.absence, table.remarks)
    columns = [(_with_marks if c in table.marked else _without_marks)(c, table.records) for c in table.columns]
    headings, *rows = zip(*columns, strict=True)
    left = [k for k, c in enumerate(table.columns) if not c.is_number or c in table.marked]
    return TextTable(title, headings, rows, left, "", table.remarks)


def _without_marks(column: Column, records: Sequence[Mapping[str, Any]]) -> list[str]:
    return [column.heading, *(column.text(row) for row in records)]


def _with_marks(column: Column, records: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return heading and cells of a marked column: numbers right, marks after them."""
    marks = ["", *(column.parts(row)[2] for row in records)]
    numbers = _without_marks(replace(column, mark=""), records)
    number_width, mark_width = max(map(len, numbers)), max(map(len, marks))
    return [f"{number:>{number_width}} {mark:{mark_width}}" for number, mark in zip(numbers, marks, strict=True)]


def table_latex(table: PrintedTable) -> str:
    """Return a floating `table` with booktabs rules (`\\usepackage{booktabs}`).

    More than `latex_tables.LONG` rows become a `longtable`, which breaks over pages (`\\usepackage{longtable}`); notes
    are in the caption.
    """
    parts = [table.title, *([table.lead] if table.lead else []), *table.remarks]
    caption, label = latex(". ".join(part.rstrip(".") for part in parts) + "."), f"tab:{table.name}"
    if table.absence:
        return latex_table(caption, label, [""], [[latex(table.absence)]], "l")
    headings = [latex(column.heading) for column in table.columns]
    rows = [[*map(latex_of_plain, row)] for row in table.cells]
    return latex_table(caption, label, headings, rows, "".join("r" if c.is_number else "l" for c in table.columns))


def table_html(table: PrintedTable, address: Callable[[SourceItems], str] | None = None) -> str:
    """Return a table's HTML, in a scrolling box with notes; `address`: link to the items."""

    def link(row: Mapping[str, Any], column: Column, printed: str) -> str | None:
        is_known = column.is_number and printed not in ("", NONE)
        trace = table.trace(row, column.field) if is_known and table.trace and address else None
        return address(trace) if trace and address else None

    columns = [
        (column, "th" if column.look == "head" else "td", _classes(column), column in table.marked)
        for column in table.columns
    ]
    rows = [
        [
            (each, *parts, link(row, each[0], parts[0]), row.get(each[0].field))
            for each, parts in zip(columns, cells, strict=True)
        ]
        for row, cells in zip(table.records, table.parts, strict=True)
    ]
    return environment().get_template("table.html.j2").render(table=table, columns=columns, rows=rows)


def _classes(column: Column) -> str:
    """Return the style classes of a column's cells."""
    names = ("" if column.is_number else "word", "range" * (column.interval or column.unit == "range"), column.look)
    return " ".join(filter(None, (*names, "first" if column.group else "")))


@cache
def environment(folder: Path = TEMPLATES) -> jinja2.Environment:
    """Return the Jinja2 environment of pages: it escapes, and refuses unknown names."""
    import jinja2

    return jinja2.Environment(
        loader=jinja2.FileSystemLoader(folder),
        autoescape=True,
        finalize=finalize_value,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )


def markdown(text: object) -> str:
    """Return the text escaped for a Markdown table's cell: neither HTML nor markup acts in it."""
    return re.sub(r"([\\`*_{}\[\]()#+!|~$])", r"\\\1", html.escape(plain(text), quote=False))


# --- figures ----------------------------------------------------------------------------------------------------------


@contextmanager
def figure_style() -> Iterator[None]:
    """Apply the style of figures, for drawing and saving (the SVG salt needs both)."""
    import matplotlib.style

    with matplotlib.style.context(STYLE):
        yield


def new_figure(
    width: float, height: float, dpi: float | None = None, layout: Literal["constrained"] | None = "constrained"
) -> Figure:
    """Return an empty figure (inches) with a canvas; layout None: nothing moves."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), dpi=dpi, layout=layout)
    FigureCanvasAgg(figure)
    return figure


def freeze_layout(figure: Figure) -> None:
    """Freeze the layout engine's result, which every save would otherwise repeat."""
    with figure_style():
        if (engine := figure.get_layout_engine()) is not None:
            engine.execute(figure)  # drawing without rendering does this and then draws all artists
        figure.set_layout_engine(None)  # "none" would leave a placeholder, for which each save draws everything twice


def figure_bytes(figure: Figure, kind: str = "png") -> bytes:
    """Return the figure as a PDF, SVG, PNG or WebP file, the same on every call."""
    no_dates = {"svg": {"Date": None}, "pdf": {"CreationDate": None}, "png": {"Software": None}}
    with figure_style():
        if figure.get_layout_engine() is not None:
            freeze_layout(figure)
        stream = io.BytesIO()
        figure.savefig(stream, format=kind, metadata=no_dates.get(kind))  # pyright: ignore[reportArgumentType]
    return stream.getvalue()


def figure_files(name: str, figure: Figure) -> dict[str, bytes]:
    """Return the figure as `name.pdf`, `name.svg` and `name.png`."""
    return {f"{name}.{kind}": figure_bytes(figure, kind) for kind in FIGURE_KINDS}
