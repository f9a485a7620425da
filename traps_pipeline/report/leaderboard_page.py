"""Show the leaderboard (docs/spec.md 5 and 10) as text, Markdown and HTML tables.

Model ids, epochs and versions are untrusted text: each medium escapes them.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import pandas as pd

from traps_pipeline.base.terminal import TextTable
from traps_pipeline.models.registry.judges import BY_RULES, ONE_JUDGE, is_judged_by_rules
from traps_pipeline.protocol.datasets import ARMS, DATASETS
from traps_pipeline.protocol.regimes import REGIMES
from traps_pipeline.report.tables.table_columns import (
    EPOCH,
    MISSING,
    MODEL,
    PECS,
    REGIME,
    RUNS,
    SHARES,
    J,
    N,
    cell_trace,
    interval,
    meanings,
)
from traps_pipeline.report.terms import (
    BROKEN_MARK,
    BROKEN_TEXTS,
    ENOUGH,
    INCOMPLETE_MARK,
    MISSING_MARK,
    OVERRULED_ABOVE,
    OVERRULED_MARK,
    ROBUST_TERMS,
    TITLES,
)
from traps_pipeline.report.writing import (
    NONE,
    NOT_RUN,
    Column,
    PrintedTable,
    SourceItems,
    fraction,
    percent,
    table_markdown,
    table_text,
)
from traps_pipeline.scoring.analyses import null_single_deviations
from traps_pipeline.scoring.metrics import joined_epochs
from traps_pipeline.scoring.score_rows import LEADERBOARD
from traps_pipeline.storage.tables import records

BOUNDS = "If missing: worst, best"
# Columns shown only if their count, or that of another field, is not 0, because the table is already wide.
OPTIONAL = {
    Column("n_refused", "Refused", "count"): "n_refused",
    Column("n_empty", "Empty", "count"): "n_empty",
    Column("n_truncated", "Cut off", "count"): "n_truncated",
    Column("n_unfinished", "Unfinished", "count"): "n_unfinished",
    Column("n_degenerate", "Degenerate", "count"): "n_degenerate",
    Column("n_unread", "Unread", "count"): "n_unread",
    Column("broken", "Broken %", "percent"): "broken",
    Column("n_not_json", "Not JSON", "count"): "n_not_json",
    Column("n_rejects", "Rejects premise", "count"): "n_rejects",
    Column("n_overruled", "Overruled", "count", mark="overruled_mark"): "n_overruled",
    Column("bounds", BOUNDS, "range"): "n_missing",
}
Robust = Mapping[tuple[str, str], Mapping[str, Any]]  # ROBUST rows by model and regime
ROBUST_COLUMNS = (
    Column("conjunction", "Conjunction %", "range", group=True),
    Column("robust", "Robust", "range"),
    Column("inference_acc", "Inferred %", "range"),
)
LEGEND = {
    "Acc": "share of control items answered correctly",
    "AbsRec": "abstention recall: share of void items, which cannot be answered, that the model abstains on",
    "FalseAbs": "share of control items, which can be answered, that the model abstains on",
    "J": "AbsRec − FalseAbs, from −1 to 1; 0 for every strategy that does not distinguish void from control",
    "PECS": "Acc × max(0, J), from 0 to 1; computed per run, then averaged. J is clipped at 0 here, so chance alone "
    "lifts a random strategy slightly above 0; look at the column J, which is not clipped",
    "95 % CI": "interval of PECS, Bayesian bootstrap over scenarios with one unseen",
    "±": "population standard deviation over runs",
    "n": "pairs (one control, one void) per run",
    "Missing": f"items over all runs without an answer or a majority; {MISSING_MARK} shares are over the other items",
    INCOMPLETE_MARK: f"incomplete: fewer than {ENOUGH} of items answered; an overall figure is incomplete if that of "
    "any dataset is",
    BROKEN_MARK: f"broken: {BROKEN_TEXTS}; an overall figure is broken if that of any dataset is",
    "Refused": "items over all runs that the model or its provider refused; they are among the missing ones",
    "Empty": "items over all runs answered with no text; they are among the missing ones",
    "Cut off": "items over all runs whose text reached the limit of tokens before an answer; they are among the "
    "missing ones",
    "Unfinished": "items over all runs whose answer ended for an unknown reason (column finish_reason of the "
    "answers); they are among the missing ones",
    "Degenerate": "items over all runs answered with punctuation alone or with a text that repeats itself; they are "
    "among the missing ones, and no judge takes them for abstentions",
    "Unread": "items over all runs answered with a text in a form that the rule judges do not read; they are among the "
    "missing ones: neither abstentions nor correct",
    "Broken %": "share of items whose text is empty, cut off, unfinished, degenerate or unread",
    "Not JSON": "items of the JSON regime, over all runs, whose text is not the object that the prompt asks for; they "
    "are judged as they stand",
    "Rejects premise": "void items over all runs whose answer says that something which the question takes for granted "
    "is not so, in the panel's view; counted apart from abstention, which decides AbsRec",
    "Overruled": "control items over all runs on which code reads another value out of a judge's vote than the judge's "
    f"own word on it says; {OVERRULED_MARK} on more than 1 % of the controls",
    BOUNDS: "PECS of all items if every missing decision were the worst for the model (a control wrong and abstained "
    "on, a void not abstained on), and if every one were the best; computed per run, then averaged",
    **ROBUST_TERMS,
    "Epoch": "the evaluation campaign; figures of different epochs are not put in one ratio",
    "Overall": "equal-weight mean over the four datasets",
}


def leaderboard_text(board: pd.DataFrame, robust: pd.DataFrame | None = None, notes: Sequence[str] = ()) -> str:
    """Return LEADERBOARD rows as text, a table per panel, with ROBUST and notes."""
    return "\n".join(table.text() for table in leaderboard_tables(board, robust, notes))


def leaderboard_tables(
    board: pd.DataFrame, robust: pd.DataFrame | None = None, notes: Sequence[str] = ()
) -> list[TextTable]:
    """Return what `leaderboard_text` says, a table per panel."""
    return [table_text(table) for table in leaderboards(board, robust, notes, brief=True)]


def leaderboard_markdown(board: pd.DataFrame, robust: pd.DataFrame | None = None, notes: Sequence[str] = ()) -> str:
    """Return LEADERBOARD rows as Markdown, with ROBUST, notes and a legend."""
    terms = [f"- **{term}**: {meaning}" for term, meaning in legend(board, robust).items()]
    tables = leaderboards(board, robust, notes, brief=True)
    return "\n".join([*map(table_markdown, tables), *terms]) + "\n"


def leaderboards(
    board: pd.DataFrame, robust: pd.DataFrame | None = None, notes: Sequence[str] = (), *, brief: bool = False
) -> list[PrintedTable]:
    """Return each panel's tables of LEADERBOARD rows: ranking, then other datasets.

    The ranking is of `overall`, or the board's first dataset if no model has all four. An entry without a row comes
    last. notes: further notes of the first table. brief: only the first table of each panel, with fewer columns.
    """
    tables = [table for suffix, part in _rows_by_panel(board) for table in _panel_tables(part, robust, brief, suffix)]
    return [replace(tables[0], notes=[*tables[0].notes, *notes]), *tables[1:]]


def _rows_by_panel(board: pd.DataFrame) -> list[tuple[str, pd.DataFrame]]:
    """Return rows by panel, with their tables' suffix; entries of several come last."""
    if board.empty:
        return [("", board)]
    entry_panels = board.groupby(["model", "regime"])["panel"].transform(joined_epochs)
    panels = sorted(set(entry_panels), key=lambda names: (names.count("+"), names))
    return [(f"_{number}" if number else "", board.loc[entry_panels == name]) for number, name in enumerate(panels)]


def _panel_tables(board: pd.DataFrame, robust: pd.DataFrame | None, brief: bool, suffix: str) -> list[PrintedTable]:
    datasets = set(board["dataset"])
    ranked_dataset = next((name for name in TITLES if name in datasets), "overall")
    other_datasets = [name for name in DATASETS if name in datasets and name != ranked_dataset]
    other_tables = [
        _leaderboard(board.loc[board["dataset"] == name], name, [], {}, brief, suffix)
        for name in ([] if brief else other_datasets)
    ]
    rows = []
    if robust is not None and ranked_dataset == "overall":
        rows = records(robust)
    row_of = {(row["model"], row["regime"]): row for row in rows}
    entries = {*zip(board["model"], board["regime"], strict=True)}
    row_of = {key: row for key, row in row_of.items() if key in entries}
    return [_leaderboard(board, ranked_dataset, other_datasets, row_of, brief, suffix), *other_tables]


def legend(board: pd.DataFrame, robust: pd.DataFrame | None = None) -> dict[str, str]:
    """Return the entries of LEGEND for the board's columns and marks."""
    optional_terms = {column.heading: field for column, field in OPTIONAL.items()}
    optional_terms |= {INCOMPLETE_MARK: "incomplete", BROKEN_MARK: "is_broken"}
    unused_terms = {term for term, field in optional_terms.items() if not (board.loc[:, field] > 0).any()}
    unused_terms |= {*ROBUST_TERMS} if robust is None or robust.empty else set()
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
    sentence += "; figures of different panels are not ranked or compared" * has_several_panels
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
    board: pd.DataFrame, dataset: str, others: Sequence[str], beside: Robust, brief: bool, suffix: str
) -> PrintedTable:
    rows = _entries(board, dataset, others)
    columns = [MODEL, REGIME, replace(PECS, bar=True), Column("ci", "95 % CI", "range"), *SHARES, J]
    for name in others:
        title = name.replace("_ill_posed", " ill-posed") if brief else TITLES[name]  # a comma would end it in a list
        columns.append(Column(name, f"PECS {title}", "fraction", mark=f"{name}_mark", group=name == others[0]))
    if beside:
        rows, columns = _with_robust(rows, beside), [*columns, *ROBUST_COLUMNS]
    columns += [replace(N, mark="n_mark", group=True), RUNS, replace(MISSING, mark="missing_mark")]
    columns += [column for column, field in OPTIONAL.items() if (rows.loc[:, field] > 0).any()]
    columns += [
        column for column in (EPOCH, Column("benchmark_version", "Version")) if rows.loc[:, column.field].nunique() > 1
    ]
    marks = [mark for name in ("n_mark", "missing_mark", "model_mark", "overruled_mark") for mark in rows[name]]
    notes = [*meanings(marks), *_notes_on_arms(beside)]
    if brief:
        columns = [replace(c, spread="") for c in columns if c.field not in ("n_runs", "epoch", "benchmark_version")]
    else:
        is_mixed = board["panel"].str.contains("+", regex=False).any()
        notes = ["not ranked: each entry is of several panels" if is_mixed else "ranked by PECS", *notes]
    return PrintedTable(
        f"leaderboard_{dataset}{suffix}", TITLES[dataset], rows, columns, notes, "this study has no leaderboard yet",
        _trace,
        dash="not all four datasets evaluated, or nothing decided" if dataset == "overall" else "nothing decided",
        lead=provenance(board),
    )  # fmt: skip


def _with_robust(rows: pd.DataFrame, beside: Robust) -> pd.DataFrame:
    """Return the rows with ROBUST_COLUMNS as printed."""
    robust_rows = [beside.get((row["model"], row["regime"])) for row in rows.to_dict("records")]
    formats = {"conjunction": percent, "robust": fraction, "inference_acc": percent}
    return rows.assign(
        **{name: [as_(row[name]) if row else NOT_RUN for row in robust_rows] for name, as_ in formats.items()}
    )


def _notes_on_arms(beside: Robust) -> list[str]:
    """Return notes on each entry's arms, and on why pairs and arms are not joined."""
    entries: dict[tuple[str, ...], list[str]] = {}
    for (model, regime), row in beside.items():
        entries.setdefault(tuple(row["arms"]), []).append(f"{model} {regime}")
    notes = [
        f"{', '.join(names) if len(entries) > 1 else 'all'} over {len(arms)} of {len(ARMS)} arms: {', '.join(arms)}"
        for arms, names in entries.items()
    ]
    refusals = dict.fromkeys(row["refused"] for row in beside.values() if row["refused"])
    return [*notes, *(f"no conjunction and no robust figure: {reason}" for reason in refusals)]


def _trace(row: Mapping[str, Any], field: str) -> SourceItems | None:
    if row.get(field) == NOT_RUN:
        return None
    return cell_trace({**row, "dataset": field} if field in DATASETS else row, field)


def _entries(board: pd.DataFrame, dataset: str, others: Sequence[str]) -> pd.DataFrame:
    """Return one row per (model, regime), best first.

    Without a row of the dataset, counts are sums over all rows.
    """
    rows, entries = [], dict[tuple[str, str], dict[str, dict[str, Any]]]()
    for row in null_single_deviations(board).to_dict("records"):
        entries.setdefault((row["model"], row["regime"]), {})[row["dataset"]] = row
    for dataset_rows in entries.values():
        main_row = dataset_rows.get(dataset)
        counted_rows = list(dataset_rows.values()) if main_row is None else [main_row]
        entry: dict[str, Any] = {name: counted_rows[0][name] for name in ("model", "regime")} | (main_row or {})
        summed_columns = ("n_pairs", "n_missing", "n_refused", "n_empty", "n_truncated", "n_unfinished", "n_degenerate")
        entry |= {
            n: sum(row[n] for row in counted_rows) for n in (*summed_columns, "n_unread", "n_not_json", "n_rejects")
        }
        overruled = [row["n_overruled"] for row in counted_rows if pd.notna(row["n_overruled"])]
        n_controls = sum(row["n_pairs"] * row["n_runs"] for row in counted_rows)
        entry["n_overruled"] = sum(overruled) if overruled else None
        entry["overruled_mark"] = OVERRULED_MARK if sum(overruled) > OVERRULED_ABOVE * n_controls else ""
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
    marks = [
        "mark",
        "n_mark",
        "model_mark",
        "missing_mark",
        "overruled_mark",
        "ci",
        "bounds",
        *others,
        *(f"{name}_mark" for name in others),
    ]
    return pd.DataFrame(sorted(rows, key=_rank), columns=pd.Index([*columns, *marks]))


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
