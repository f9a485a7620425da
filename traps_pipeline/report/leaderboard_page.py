"""Show the leaderboard (docs/spec.md 5 and 10) as text, Markdown and HTML tables.

Model ids, epochs and versions are untrusted text: each medium escapes them.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import pandas as pd

from traps_pipeline.base.terminal import TextTable
from traps_pipeline.base.wording import count_noun
from traps_pipeline.models.registry.judges import BY_RULES, ONE_JUDGE, is_judged_by_rules
from traps_pipeline.protocol.datasets import DATASETS
from traps_pipeline.protocol.metric_words import COUNT_WORDS, METRIC_WORDS
from traps_pipeline.protocol.regimes import REGIMES
from traps_pipeline.report.tables.table_columns import (
    EPOCH,
    MISSING,
    MODEL,
    OTHER_METRICS,
    PECS,
    REGIME,
    RUNS,
    SHARE_COLUMNS,
    N,
    cell_trace,
    interval,
    meanings,
    two_events_trace,
)
from traps_pipeline.report.tables.two_way_table import COLUMNS as TWO_WAY_TABLE
from traps_pipeline.report.terms import (
    BROKEN_MARK,
    BROKEN_TEXTS,
    ENOUGH,
    INCOMPLETE_MARK,
    MISSING_MARK,
    OVERRULED_ABOVE,
    OVERRULED_MARK,
    TITLE_OF,
    TWO_WAY_MEANINGS,
)
from traps_pipeline.report.writing import NONE, Column, PrintedTable, SourceItems, fraction, table_markdown, table_text
from traps_pipeline.scoring.analyses import null_single_deviations
from traps_pipeline.scoring.metrics import joined_epochs
from traps_pipeline.scoring.score_rows import LEADERBOARD

LACKING = 0.2  # share of a model's answers without a decision above which a study says so first
_UNDECIDED = ("undecided by the panel", "look at its votes (traps why ITEM)")
BOUNDS = "If missing: worst, best"
_COUNTS = [count for count in COUNT_WORDS.values() if count.heading]
# Columns shown only if their count, or that of another field, is not 0, because the table is already wide.
OPTIONAL = {
    **{
        Column(c.name, c.heading, "count", mark="overruled_mark" if c.name == "n_overruled" else ""): c.name
        for c in _COUNTS
    },
    Column("broken", "Broken %", "percent"): "broken",
    Column("bounds", BOUNDS, "range"): "n_missing",
}
_SUMMED = ("n_pairs", "n_missing", *(column.field for column in OPTIONAL if column.unit == "count"))
TWO_WAY_COLUMNS = [
    replace(column, interval=False, group=column.field == "conjunction")
    for column in TWO_WAY_TABLE
    if column.heading in TWO_WAY_MEANINGS
]
LEGEND = {
    **{metric.heading: metric.meaning for metric in METRIC_WORDS.values()},
    "95 % CI": "interval of PECS, Bayesian bootstrap over scenarios with one unseen",
    "±": "population standard deviation over runs",
    "n": "pairs (one control, one void; a held-out set asks one of both) per run",
    "Missing": f"items over all runs without an answer or a majority; {MISSING_MARK} shares are over the other items",
    INCOMPLETE_MARK: f"incomplete: fewer than {ENOUGH} of items answered; an overall metric is incomplete if that of "
    "any dataset is",
    BROKEN_MARK: f"broken: {BROKEN_TEXTS}; an overall metric is broken if that of any dataset is",
    **{
        count.heading: f"{count.meaning}; over all runs{', among the missing ones' if count.outcomes else ''}"
        for count in _COUNTS
    },
    "Broken %": "share of items whose text is empty, cut off, unfinished, degenerate or unread",
    BOUNDS: "PECS of all items if every missing decision were the worst for the model (a control wrong and abstained "
    "on, a void not abstained on), and if every one were the best; computed per run, then averaged",
    **TWO_WAY_MEANINGS,
    "Epoch": "the evaluation campaign; metrics of different epochs are not put in one ratio",
    "Overall": "equal-weight mean over the four datasets",
}


def leaderboard_text(board: pd.DataFrame, two_way: pd.DataFrame | None = None, notes: Sequence[str] = ()) -> str:
    """Return LEADERBOARD rows as text, a table per panel, with TWO_WAY and notes."""
    return "\n".join(table.text() for table in leaderboard_tables(board, two_way, notes))


def leaderboard_tables(
    board: pd.DataFrame, two_way: pd.DataFrame | None = None, notes: Sequence[str] = ()
) -> list[TextTable]:
    """Return the leaderboard as text: one table per panel, headed by what is missing."""
    first, *others = (table_text(table) for table in leaderboards(board, two_way, notes, brief=True))
    lacking = shortfall(board)
    return [replace(first, title=f"{lacking}\n{first.title}") if lacking else first, *others]


def leaderboard_markdown(board: pd.DataFrame, two_way: pd.DataFrame | None = None, notes: Sequence[str] = ()) -> str:
    """Return LEADERBOARD rows as Markdown, with TWO_WAY, notes and a legend."""
    terms = [f"- **{term}**: {meaning}" for term, meaning in legend(board, two_way).items()]
    tables, lacking = leaderboards(board, two_way, notes, brief=True), shortfall(board)
    return "\n".join([*([f"{lacking}\n"] if lacking else []), *map(table_markdown, tables), *terms]) + "\n"


def leaderboards(
    board: pd.DataFrame, two_way: pd.DataFrame | None = None, notes: Sequence[str] = (), *, brief: bool = False
) -> list[PrintedTable]:
    """Return the tables of LEADERBOARD rows, panel by panel: ranking, then the other datasets.

    The ranking is of `overall`, or the board's first dataset if no model has all four. An entry without a row comes
    last. notes: further notes of the first table. brief: only the first table of each panel, with fewer columns.
    """
    tables = [table for suffix, part in _rows_by_panel(board) for table in _panel_tables(part, two_way, brief, suffix)]
    return [replace(tables[0], notes=[*tables[0].notes, *notes]), *tables[1:]]


def _rows_by_panel(board: pd.DataFrame) -> list[tuple[str, pd.DataFrame]]:
    """Return rows by panel, with their tables' suffix; entries of several come last."""
    if board.empty:
        return [("", board)]
    entry_panels = board.groupby(["model", "regime"])["panel"].transform(joined_epochs)
    panels = sorted(set(entry_panels), key=lambda names: (names.count("+"), names))
    return [(f"_{number}" if number else "", board.loc[entry_panels == name]) for number, name in enumerate(panels)]


def _panel_tables(board: pd.DataFrame, two_way: pd.DataFrame | None, brief: bool, suffix: str) -> list[PrintedTable]:
    datasets = set(board["dataset"])
    ranked_dataset = next((name for name in TITLE_OF if name in datasets), "overall")
    other_datasets = [name for name in DATASETS if name in datasets and name != ranked_dataset]
    beside = two_way if ranked_dataset == "overall" else None
    other_tables = [
        _leaderboard(board.loc[board["dataset"] == name], name, [], None, brief, suffix)
        for name in ([] if brief else other_datasets)
    ]
    return [_leaderboard(board, ranked_dataset, other_datasets, beside, brief, suffix), *other_tables]


def shortfall(board: pd.DataFrame) -> str:
    """Return a sentence on why models lack answers, and what to change; empty if none lacks a fifth of them."""
    rows = board.loc[board["dataset"] != "overall"]
    rows = rows.assign(asked=rows["n_items"].astype(int) * rows["n_runs"].astype(int))
    sums = rows.groupby("model", sort=False)[["asked", "n_missing"]].sum()
    models = [*sums.index[sums["n_missing"] > LACKING * sums["asked"]]]
    if not models:
        return ""
    lacking = rows.loc[rows["model"].isin(models)]
    counts = {(c.participle, c.remedy): int(lacking[c.name].sum()) for c in COUNT_WORDS.values() if c.participle}
    counts[_UNDECIDED] = int(lacking["n_missing"].sum()) - sum(counts.values())
    reasons = sorted(((count, *words) for words, count in counts.items() if count > 0), key=lambda reason: -reason[0])
    (first, participle, _), *others = reasons
    were = f"{'was' if first == 1 else 'were'} {participle}"
    text = f"{first:,} of {count_noun(int(lacking['asked'].sum()), 'answer')} {were}"
    text += "".join(f", {count:,} {words}" for count, words, _ in others)
    names = ", ".join(models[:3]) + (f" and {len(models) - 3} more" if len(models) > 3 else "")
    return f"{names}: {text}: {', or '.join(dict.fromkeys(remedy for _, _, remedy in reasons[:2]))}."


def legend(board: pd.DataFrame, two_way: pd.DataFrame | None = None) -> dict[str, str]:
    """Return the meaning, by term, of each column and mark that the leaderboard shows."""
    optional_terms = {column.heading: field for column, field in OPTIONAL.items()}
    optional_terms |= {INCOMPLETE_MARK: "incomplete", BROKEN_MARK: "is_broken"}
    unused_terms = {term for term, field in optional_terms.items() if not (board.loc[:, field].astype(float) > 0).any()}
    if two_way is None or not two_way["n_scenarios"].to_numpy().any():
        unused_terms |= {*TWO_WAY_MEANINGS}
    return {term: meaning for term, meaning in LEGEND.items() if term not in unused_terms}


def provenance(board: pd.DataFrame) -> str:
    """Return a sentence with the board's panels, benchmark versions and epochs."""
    versions = _distinct(board["benchmark_version"].unique(), " + ")
    epochs = _distinct(board["epoch"].unique(), "+")
    return (
        f"{judged_by(board)} Benchmark version{'s' * (len(versions) > 1)} {', '.join(versions) or NONE}; "
        f"epoch{'s' * (len(epochs) > 1)} {', '.join(epochs) or NONE}."
    )


def judged_by(board: pd.DataFrame) -> str:
    """Return a sentence that names the panels, and warns against comparing them."""
    panels = _distinct(board["panel"].unique(), "+")
    names = [_panel_in_words(panel) for panel in panels]
    has_several_panels = len(panels) > 1
    sentence = f"Judged by the panel{'s' * has_several_panels} {' and '.join(names) or NONE}"
    sentence += "; metrics of different panels are not ranked or compared" * has_several_panels
    rows = board[["panel", "model"]].drop_duplicates().itertuples(index=False, name=None)
    rule_judged_models = sorted({model for panel, model in rows if is_judged_by_rules(panel, model)})
    names_shown = ", ".join(rule_judged_models[:5]) + (
        f" and {len(rule_judged_models) - 5} more" if len(rule_judged_models) > 5 else ""
    )
    return f"{sentence}." + (f" {BY_RULES[0].upper()}{BY_RULES[1:]}: {names_shown}." if rule_judged_models else "")


def _panel_in_words(panel: str) -> str:
    name, _, version = panel.partition("@")
    one_judge_note = ", one judge, so that nothing is known of agreement" if version.endswith(ONE_JUDGE) else ""
    return f"{name} (version {version.removesuffix(ONE_JUDGE)}{one_judge_note})"


def _distinct(values: Iterable[Any], separator: str) -> list[str]:
    return sorted({part for value in values for part in str(value).split(separator) if part})


def _leaderboard(
    board: pd.DataFrame, dataset: str, others: Sequence[str], two_way: pd.DataFrame | None, brief: bool, suffix: str
) -> PrintedTable:
    rows = _entries(board, dataset, others)
    columns = [MODEL, REGIME, replace(PECS, bar=True), Column("ci", "95 % CI", "range"), *SHARE_COLUMNS, *OTHER_METRICS]
    for name in others:
        title = name.replace("_ill_posed", " ill-posed") if brief else TITLE_OF[name]  # a comma would end it in a list
        columns.append(Column(name, f"PECS {title}", "fraction", mark=f"{name}_mark", group=name == others[0]))
    refusals = list[str]()
    if two_way is not None and len(shown := rows[["model", "regime"]].merge(two_way.loc[two_way["n_scenarios"] > 0])):
        rows = rows.merge(shown[["model", "regime", *(column.field for column in TWO_WAY_COLUMNS)]], "left")
        columns += TWO_WAY_COLUMNS
        refusals = [f"no metric of two events: {reason}" for reason in shown["refused"].dropna().unique()]
    columns += [replace(N, mark="n_mark", group=True), RUNS, replace(MISSING, mark="missing_mark")]
    columns += [column for column, field in OPTIONAL.items() if (rows.loc[:, field] > 0).any()]
    columns += [
        column for column in (EPOCH, Column("benchmark_version", "Version")) if rows.loc[:, column.field].nunique() > 1
    ]
    marks = [mark for name in ("n_mark", "missing_mark", "model_mark", "overruled_mark") for mark in rows[name]]
    notes = [*meanings(marks), *refusals]
    if brief:
        columns = [replace(c, spread="") for c in columns if c.field not in ("n_runs", "epoch", "benchmark_version")]
    else:
        is_mixed = board["panel"].str.contains("+", regex=False).any()
        notes = ["not ranked: each entry is of several panels" if is_mixed else "ranked by PECS", *notes]
    return PrintedTable(
        f"leaderboard_{dataset}{suffix}", TITLE_OF[dataset], rows, columns, notes, "this study has no leaderboard yet",
        _trace,
        dash="not all four datasets evaluated, or nothing decided" if dataset == "overall" else "nothing decided",
        lead=provenance(board),
    )  # fmt: skip


def _trace(row: Mapping[str, Any], field: str) -> SourceItems | None:
    if any(field == column.field for column in TWO_WAY_COLUMNS):
        return two_events_trace(row, field)
    return cell_trace({**row, "dataset": field} if field in DATASETS else row, field)


def _entries(board: pd.DataFrame, dataset: str, others: Sequence[str]) -> pd.DataFrame:
    """Return one row per (model, regime), best first. Without a row of the dataset, counts are sums over all rows."""
    rows, entries = [], dict[tuple[str, str], dict[str, dict[str, Any]]]()
    for row in null_single_deviations(board).to_dict("records"):
        entries.setdefault((row["model"], row["regime"]), {})[row["dataset"]] = row
    for dataset_rows in entries.values():
        main_row = dataset_rows.get(dataset)
        counted_rows = list(dataset_rows.values()) if main_row is None else [main_row]
        entry: dict[str, Any] = {name: counted_rows[0][name] for name in ("model", "regime")} | (main_row or {})
        entry |= {name: _total(row[name] for row in counted_rows) for name in _SUMMED}
        n_controls = sum(row["n_items"] * row["n_runs"] for row in counted_rows) / 2  # in a held-out set about half
        is_marked = (entry["n_overruled"] or 0) > OVERRULED_ABOVE * n_controls
        entry["overruled_mark"] = OVERRULED_MARK if is_marked else ""
        entry["mark"] = _mark(main_row) if main_row else ""
        entry["n_mark"] = INCOMPLETE_MARK if any(row["incomplete"] for row in counted_rows) else ""
        entry["model_mark"] = BROKEN_MARK if any(row["is_broken"] for row in counted_rows) else ""
        entry["missing_mark"] = MISSING_MARK if entry["n_missing"] else ""
        entry["ci"] = (main_row and interval(main_row)) or NONE
        entry["bounds"] = _bounds(main_row) if main_row and main_row["n_missing"] else ""
        for name in others:
            row = dataset_rows.get(name)
            entry |= {name: row["pecs"], f"{name}_mark": _mark(row)} if row else {}
        rows.append(entry)
    columns = [column.name for column in LEADERBOARD.columns]
    kinds = ("mark", "n_mark", "model_mark", "missing_mark", "overruled_mark", "ci", "bounds")
    marks = [*kinds, *others, *(f"{name}_mark" for name in others)]
    return pd.DataFrame(sorted(rows, key=_rank), columns=pd.Index([*columns, *marks]))


def _total(counts: Iterable[Any]) -> float:
    """Return the sum of the known counts; NaN if none is known, as rejections to a panel that is not asked."""
    known_counts = [count for count in counts if not pd.isna(count)]
    return sum(known_counts) if known_counts else float("nan")


def _mark(row: Mapping[str, Any]) -> str:
    """Return the marks of a PECS: too few answers, or too many broken ones."""
    return (INCOMPLETE_MARK if row["incomplete"] else "") + (BROKEN_MARK if row["is_broken"] else "")


def _bounds(row: Mapping[str, Any]) -> str:
    return f"[{fraction(row['pecs_low'])}, {fraction(row['pecs_high'])}]"


def _rank(entry: Mapping[str, Any]) -> tuple[bool, float, str, int]:
    """Return the sort key: best PECS first, nulls last, ties by model and regime."""
    pecs = float(entry.get("pecs", float("nan")))
    is_null = pecs != pecs
    regimes = (*REGIMES, entry["regime"])
    return is_null, 0.0 if is_null else -pecs, entry["model"], regimes.index(entry["regime"])
