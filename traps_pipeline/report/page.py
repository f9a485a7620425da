"""The leaderboard for a terminal, a README and a browser (docs/spec.md 5 and 10).

All three show the same entries in the same order. Model ids, epochs and versions are untrusted text: each renderer
escapes them for its medium.
"""

from __future__ import annotations

import base64
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import pandas as pd

from traps_pipeline.partitions import DATASETS, REGIMES, SHORT
from traps_pipeline.report.writing import (
    NONE,
    Behind,
    Table,
    environment,
    fraction,
    markdown,
    percent,
    plain,
    table_html,
)
from traps_pipeline.scoring.leaderboard import INCOMPLETE_BELOW

MISSING_MARK = "†"
INCOMPLETE_MARK = "‡"
WIDE_PX = 1300  # a picture of more pixels across is a page's width
# The side whose items a share is of.
SIDE_OF = {"acc": "control", "false_abs": "control", "abs_rec": "void"}
ENOUGH = f"{100 * INCOMPLETE_BELOW:g} %"
WORST_BEST = "if missing: worst, best"
# Headings of columns that are shown only where some count is not 0, with that count: the table is wide already.
OPTIONAL = {"refused": "n_refused", "empty": "n_empty", WORST_BEST: "n_missing"}
TITLES = {
    "overall": "Overall",
    "occlusion": "Occlusion",
    "occlusion_ill_posed": "Occlusion, ill-posed",
    "chaotic": "Chaotic",
    "chaotic_ill_posed": "Chaotic, ill-posed",
}
LEGEND = {
    "Acc": "share of control items answered correctly",
    "AbsRec": "abstention recall: share of void items, which cannot be answered, that the model abstains on",
    "FalseAbs": "share of control items, which can be answered, that the model abstains on",
    "J": "AbsRec − FalseAbs, from −1 to 1; 0 for every strategy that does not tell void from control",
    "PECS": "Acc × max(0, J), from 0 to 1; computed per run, then averaged. J is clipped at 0 here, so chance "
    "alone lifts a random strategy slightly above 0: the J beside it, which is not clipped, tells",
    "95 % CI": "percentile interval of PECS, cluster bootstrap over scenarios",
    "±": "population standard deviation over runs",
    "n": "pairs (one control, one void) a run",
    "missing": f"items over all runs without an answer or a majority; {MISSING_MARK} shares rest on the others",
    INCOMPLETE_MARK: f"incomplete: fewer than {ENOUGH} of items answered, that is, with a text, whole or truncated; an "
    "overall figure is incomplete where that of any dataset is",
    "refused": "items over all runs that the model or its provider refused; among the missing",
    "empty": "items over all runs answered with no text; among the missing",
    WORST_BEST: "PECS of all items if every missing decision were as bad for the model as can be (a control wrong and "
    "abstained on, a void not abstained on) and as good as can be; computed per run, then averaged",
    "epoch": "the evaluation campaign; figures of different epochs are not put in one ratio",
    "Overall": "equal-weight mean over the four datasets",
}


@dataclass(frozen=True)
class Block:
    """One side of a card: whose results, and a PNG (base64) or tables (title, escaped HTML)."""

    source: str
    png: str = ""
    tables: Sequence[tuple[str, str]] = ()
    size: str = "column"


@dataclass(frozen=True)
class Card:
    """A figure, or tables, of the study beside the paper's."""

    name: str
    title: str
    blocks: Sequence[Block]


@dataclass(frozen=True)
class Entry:
    """One model under one regime: its LEADERBOARD rows by dataset; `main` is the row that it is ranked by."""

    model: str
    regime: str
    rows: Mapping[str, Mapping[str, Any]]
    main: Mapping[str, Any] | None

    @property
    def counted(self) -> Sequence[Mapping[str, Any]]:
        """The rows that its counts are of: the ranked one, or all that are there for an entry without one."""
        return [self.main] if self.main is not None else list(self.rows.values())

    @property
    def incomplete(self) -> bool:
        """Whether too few items of what is counted have a text."""
        return any(row["incomplete"] for row in self.counted)

    def total(self, count: str) -> int:
        """A count of items or pairs."""
        return sum(row[count] for row in self.counted)


def leaderboard_text(board: pd.DataFrame) -> str:
    """LEADERBOARD rows as an aligned table for a terminal, best first; control characters in ids become `?`."""
    scope, entries = entries_of(board)
    extra = optional_columns(entries)
    header = ["model", "regime", *_headings(), "n", "missing", *extra]
    lines = [[plain(e.model), plain(e.regime), *_figures(e), *_counts(e, extra)] for e in entries]
    header, *lines = zip(*map(_hung, zip(header, *lines, strict=True)), strict=True)
    widths = [max(map(len, column)) for column in zip(header, *lines, strict=True)]
    table = [_aligned(cells, widths) for cells in (header, ["-" * w for w in widths], *lines)]
    notes = [f"{mark} {note}" for mark, note in _notes(board).items()]
    parts = [f"PECS, {TITLES[scope].lower()}. {plain(provenance(board))}", "", *table]
    return "\n".join([*parts, *([""] if notes else []), *notes]) + "\n"


def leaderboard_markdown(board: pd.DataFrame) -> str:
    """LEADERBOARD rows as a Markdown table with its legend, best first; ids are escaped."""
    scope, entries = entries_of(board)
    extra = optional_columns(entries)
    header = ["model", "regime", *_headings(), "n", "missing", *extra]
    lines = [[markdown(e.model), markdown(e.regime), *_figures(e), *_counts(e, extra)] for e in entries]
    rule = ["---", "---", *["---:"] * (len(header) - 2)]
    table = ["| " + " | ".join(cells) + " |" for cells in (header, rule, *lines)]
    legend = [f"- **{term}**: {meaning}" for term, meaning in _legend(board).items()]
    return "\n".join([f"**{TITLES[scope]}.** {markdown(provenance(board))}", "", *table, "", *legend]) + "\n"


def report_html(
    board: pd.DataFrame,
    figures: Mapping[str, bytes] | None = None,
    chapters: Sequence[tuple[str, Sequence[Card]]] = (),
    address: Callable[[Behind], str] | None = None,
    title: str = "TRAPSBench report",
) -> str:
    """One page: the leaderboard, a table a dataset, figures (title -> PNG bytes, inlined), legend, then the chapters.

    With `address`, every number is a link to the items behind it. The page opens from disk and asks the network for
    nothing; its content policy forbids it.
    """

    def behind(row: Mapping[str, Any], name: str) -> str:
        dataset = row["dataset"] if row["dataset"] in DATASETS else ""
        return address(Behind(dataset, row["model"], row["regime"], SIDE_OF.get(name, ""))) if address else ""

    templates = environment().overlay()
    formats: dict[str, Callable[..., str]] = {"fraction": fraction, "percent": percent, "count_of": count_of}
    templates.filters = {**templates.filters, **formats}
    scope, entries = entries_of(board)
    present = [name for name in DATASETS if any(name in e.rows for e in entries)]
    sections = [_section(name, entries) for name in present if name != scope]
    return templates.get_template("report.html.j2").render(
        title=title,
        provenance=provenance(board),
        main=_section(scope, entries),
        main_datasets=[(name, TITLES[name]) for name in present] if scope == "overall" else [],
        sections=sections,
        figures={name: base64.b64encode(png).decode() for name, png in (figures or {}).items()},
        chapters=chapters,
        behind=behind,
        all_items=address(Behind()) if address else "",
        legend=_legend(board),
        notes=_notes(board),
        incomplete_mark=INCOMPLETE_MARK,
    )


def picture_block(source: str, png: bytes, full: bool = False) -> Block:
    """A picture as a card's block; the PNG's own width says whether it is one column's or a page's. full: as wide as
    the screen allows."""
    size = "full" if full else "page" if int.from_bytes(png[16:20], "big") > WIDE_PX else "column"
    return Block(source, base64.b64encode(png).decode(), size=size)


def table_block(source: str, tables: Sequence[Table], address: Callable[[Behind], str] | None) -> Block:
    """Tables as a card's block."""
    return Block(source, tables=[(table.title, table_html(table, address)) for table in tables])


def entries_of(board: pd.DataFrame) -> tuple[str, list[Entry]]:
    """The dataset that entries are ranked by, and the entries, best first, those without a rank last.

    That is `overall`; on a board where no model has all four datasets it is the first dataset present.
    """
    records: list[dict[str, Any]] = board.to_dict("records")  # pyright: ignore[reportAssignmentType]
    scope = next((name for name in TITLES if any(r["dataset"] == name for r in records)), "overall")
    found: dict[tuple[str, str], dict[str, Mapping[str, Any]]] = {}
    for record in records:
        found.setdefault((record["model"], record["regime"]), {})[record["dataset"]] = record
    entries = [Entry(model, regime, rows, rows.get(scope)) for (model, regime), rows in found.items()]
    return scope, sorted(entries, key=_rank)


def provenance(board: pd.DataFrame) -> str:
    """Which benchmark versions and campaigns the board's figures come from."""
    versions = _distinct(board["benchmark_version"].unique(), " + ")
    epochs = _distinct(board["epoch"].unique(), "+")
    return (
        f"Benchmark version{'s' * (len(versions) > 1)} {', '.join(versions) or NONE}; "
        f"epoch{'s' * (len(epochs) > 1)} {', '.join(epochs) or NONE}."
    )


def optional_columns(entries: Iterable[Entry]) -> list[str]:
    """Headings of OPTIONAL that any of these entries needs."""
    entries = list(entries)
    return [heading for heading, name in OPTIONAL.items() if any(entry.total(name) for entry in entries)]


def count_of(entry: Entry, heading: str) -> str:
    """What an entry shows under `n`, `missing` or a heading of OPTIONAL; the same in every medium but for styling."""
    if heading == "n":
        return _marked(str(entry.total("n_pairs")), INCOMPLETE_MARK, entry.incomplete)
    if heading == "missing":
        return _marked(str(entry.total("n_missing")), MISSING_MARK, entry.total("n_missing") > 0)
    if heading != WORST_BEST:
        return str(entry.total(OPTIONAL[heading]))
    row = entry.main
    return f"[{fraction(row['pecs_low'])}, {fraction(row['pecs_high'])}]" if row and row["n_missing"] else NONE


def _marked(text: str, mark: str, applies: bool) -> str:
    return f"{text} {mark}" if applies else text


def _headings() -> list[str]:
    return ["PECS", "95 % CI", "Acc %", "AbsRec %", "FalseAbs %", "J", *(f"PECS {short}" for short in SHORT.values())]


def _figures(entry: Entry) -> list[str]:
    """Printed figures of one entry in the order of `_headings`."""
    per_dataset = [_pecs(entry.rows[name]) if name in entry.rows else NONE for name in SHORT]
    row = entry.main
    if row is None:
        return [NONE] * 6 + per_dataset
    low, high = fraction(row["pecs_ci_low"]), fraction(row["pecs_ci_high"])
    interval = NONE if NONE in (low, high) else f"[{low}, {high}]"
    shares = [percent(row[name]) for name in ("acc", "abs_rec", "false_abs")]
    return [_pecs(row), interval, *shares, fraction(row["j"]), *per_dataset]


def _pecs(row: Mapping[str, Any]) -> str:
    return _marked(fraction(row["pecs"]), INCOMPLETE_MARK, row["incomplete"])


def _counts(entry: Entry, extra: Sequence[str]) -> list[str]:
    """n, missing and the optional columns of one entry."""
    return [count_of(entry, heading) for heading in ("n", "missing", *extra)]


def _section(dataset: str, entries: Sequence[Entry]) -> dict[str, Any]:
    """What the template shows of one dataset: entries that have it, best first, and which provenance columns differ."""
    ranked = sorted((Entry(e.model, e.regime, e.rows, e.rows.get(dataset)) for e in entries), key=_rank)
    there = [e for e in ranked if e.main is not None or dataset == "overall"]
    rows = [e.main for e in there if e.main is not None]
    shared = {name: len({r[name] for r in rows}) <= 1 for name in ("epoch", "benchmark_version")}
    return {
        "name": dataset,
        "title": TITLES[dataset],
        "entries": there,
        "extra": optional_columns(there),
        "marked": any(e.incomplete for e in there),  # an overall row is incomplete if one of its datasets is
        "shared": shared,
        "first": rows[0] if rows else None,
    }


def _rank(entry: Entry) -> tuple[bool, float, str, int]:
    """Best PECS first, nulls last; ties by model, then in the regimes' own order."""
    value = entry.main["pecs"] if entry.main is not None else None
    score = float("nan") if value is None else float(value)
    return score != score, 0.0 if score != score else -score, entry.model, (*REGIMES, entry.regime).index(entry.regime)


def _distinct(values: Iterable[Any], separator: str) -> list[str]:
    return sorted({part for value in values for part in str(value).split(separator) if part})


def _legend(board: pd.DataFrame) -> dict[str, str]:
    """LEGEND without the mark and the columns that nothing on the board calls for."""
    needed_for = {**OPTIONAL, INCOMPLETE_MARK: "incomplete"}
    absent = {term for term, name in needed_for.items() if not _any(board, name)}
    return {term: meaning for term, meaning in LEGEND.items() if term not in absent}


def _notes(board: pd.DataFrame) -> dict[str, str]:
    """What the marks on the board mean, by mark."""
    notes = {
        MISSING_MARK: "Some items have no answer or no majority of the judges; shares rest on the decided ones.",
        INCOMPLETE_MARK: f"incomplete: fewer than {ENOUGH} of items answered.",
    }
    called_for_by = {MISSING_MARK: "n_missing", INCOMPLETE_MARK: "incomplete"}
    return {mark: note for mark, note in notes.items() if _any(board, called_for_by[mark])}


def _any(board: pd.DataFrame, column: str) -> bool:
    return bool((board[column] > 0).any())


def _hung(column: Sequence[str]) -> list[str]:
    """A column's cells with room behind those without a mark, so that figures stay under each other."""
    marked = [cell.endswith((f" {MISSING_MARK}", f" {INCOMPLETE_MARK}")) for cell in column]
    return [cell if has or not any(marked) else f"{cell}  " for cell, has in zip(column, marked, strict=True)]


def _aligned(cells: Sequence[str], widths: Sequence[int]) -> str:
    """The first two columns (words) to the left, the others (numbers) to the right."""
    padded = [c.ljust(w) if k < 2 else c.rjust(w) for k, (c, w) in enumerate(zip(cells, widths, strict=True))]
    return "  ".join(padded).rstrip()
