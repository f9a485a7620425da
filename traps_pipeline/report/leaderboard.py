"""The leaderboard of a study (docs/spec.md 5 and 10): one table for a terminal, a README, Dagster and a page.

Model ids, epochs and versions are untrusted text: each medium escapes them.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import pandas as pd

from traps_pipeline.partitions import ARMS, DATASETS, REGIMES, SHORT
from traps_pipeline.report.tables.shared import (
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
from traps_pipeline.report.terms import ENOUGH, INCOMPLETE_MARK, MISSING_MARK, ROBUST_TERMS, TITLES
from traps_pipeline.report.writing import (
    NONE,
    NOT_RUN,
    Behind,
    Column,
    PrintedTable,
    fraction,
    table_markdown,
    table_text,
)
from traps_pipeline.scoring.analyses import of_several_runs
from traps_pipeline.scoring.tables import LEADERBOARD

BOUNDS = "If missing: worst, best"
# Columns that are shown only if their count, or that of another field, is not 0, because the table is wide already.
OPTIONAL = {
    Column("n_refused", "Refused", "count"): "n_refused",
    Column("n_empty", "Empty", "count"): "n_empty",
    Column("bounds", BOUNDS, "range"): "n_missing",
}
Robust = Mapping[tuple[str, str], Mapping[str, Any]]  # ROBUST rows by model and regime
ROBUST_COLUMNS = (Column("pecs_r", "PECS-R", "range", group=True), Column("gap", "gap", "range"))
LEGEND = {
    "Acc": "share of control items answered correctly",
    "AbsRec": "abstention recall: share of void items, which cannot be answered, that the model abstains on",
    "FalseAbs": "share of control items, which can be answered, that the model abstains on",
    "J": "AbsRec − FalseAbs, from −1 to 1; 0 for every strategy that does not distinguish void from control",
    "PECS": "Acc × max(0, J), from 0 to 1; computed per run, then averaged. J is clipped at 0 here, so chance alone "
    "lifts a random strategy slightly above 0; look at the column J, which is not clipped",
    "95 % CI": "percentile interval of PECS, cluster bootstrap over scenarios",
    "±": "population standard deviation over runs",
    "n": "pairs (one control, one void) per run",
    "Missing": f"items over all runs without an answer or a majority; {MISSING_MARK} shares are over the other items",
    INCOMPLETE_MARK: f"incomplete: fewer than {ENOUGH} of items answered, that is, with a text, whole or truncated; an "
    "overall figure is incomplete if that of any dataset is",
    "Refused": "items over all runs that the model or its provider refused; they are among the missing ones",
    "Empty": "items over all runs answered with no text; they are among the missing ones",
    BOUNDS: "PECS of all items if every missing decision were the worst for the model (a control wrong and abstained "
    "on, a void not abstained on), and if every one were the best; computed per run, then averaged",
    **ROBUST_TERMS,
    "Epoch": "the evaluation campaign; figures of different epochs are not put in one ratio",
    "Overall": "equal-weight mean over the four datasets",
}


def leaderboard_text(board: pd.DataFrame, robust: pd.DataFrame | None = None) -> str:
    """LEADERBOARD rows, with the figures of ROBUST rows, as a table for standard output, best first."""
    return table_text(leaderboards(board, robust, brief=True)[0])


def leaderboard_markdown(board: pd.DataFrame, robust: pd.DataFrame | None = None) -> str:
    """LEADERBOARD rows, with the figures of ROBUST rows, as a Markdown table with its legend, best first."""
    terms = [f"- **{term}**: {meaning}" for term, meaning in legend(board, robust).items()]
    return "\n".join([table_markdown(leaderboards(board, robust, brief=True)[0]), *terms]) + "\n"


def leaderboards(board: pd.DataFrame, robust: pd.DataFrame | None = None, *, brief: bool = False) -> list[PrintedTable]:
    """Tables of LEADERBOARD rows: first the one that ranks the entries, then one for each other dataset. The overall
    table has the figures of ROBUST rows, if there are any.

    The first table is `overall`; if no model has all four datasets it is the first dataset of the board. An entry
    without a row in it comes last. brief: without deviations, runs and epochs.
    """
    datasets = set(board["dataset"])
    ranked = next((name for name in TITLES if name in datasets), "overall")
    others = [name for name in DATASETS if name in datasets and name != ranked]
    own = [_leaderboard(board.loc[board["dataset"] == name], name, [], {}, brief) for name in others]
    rows = []
    if robust is not None and ranked == "overall":  # a null text that was read from a file is NaN
        rows = robust.astype(object).where(robust.notna(), None).to_dict("records")
    beside = {(row["model"], row["regime"]): row for row in rows}
    return [_leaderboard(board, ranked, others, beside, brief), *own]


def legend(board: pd.DataFrame, robust: pd.DataFrame | None = None) -> dict[str, str]:
    """The entries of LEGEND for the columns and marks that the board has."""
    needed = {column.heading: field for column, field in OPTIONAL.items()} | {INCOMPLETE_MARK: "incomplete"}
    absent = {term for term, field in needed.items() if not (board.loc[:, field] > 0).any()}
    absent |= {*ROBUST_TERMS} if robust is None or robust.empty else set()
    return {term: meaning for term, meaning in LEGEND.items() if term not in absent}


def provenance(board: pd.DataFrame) -> str:
    """A sentence that names the benchmark versions and epochs of the board's figures."""
    versions = _distinct(board["benchmark_version"].unique(), " + ")
    epochs = _distinct(board["epoch"].unique(), "+")
    return (
        f"Benchmark version{'s' * (len(versions) > 1)} {', '.join(versions) or NONE}; "
        f"epoch{'s' * (len(epochs) > 1)} {', '.join(epochs) or NONE}."
    )


def _distinct(values: Iterable[Any], separator: str) -> list[str]:
    return sorted({part for value in values for part in str(value).split(separator) if part})


def _leaderboard(board: pd.DataFrame, dataset: str, others: Sequence[str], beside: Robust, brief: bool) -> PrintedTable:
    rows = _entries(board, dataset, others)
    columns = [MODEL, REGIME, replace(PECS, bar=True), Column("ci", "95 % CI", "range"), *SHARES, J]
    for name in others:
        heading = f"PECS {SHORT[name] if brief else TITLES[name]}"
        columns.append(Column(name, heading, "fraction", mark=f"{name}_mark", group=name == others[0]))
    if beside:
        rows, columns = _with_robust(rows, beside), [*columns, *ROBUST_COLUMNS]
    columns += [replace(N, mark="n_mark", group=True), RUNS, replace(MISSING, mark="missing_mark")]
    columns += [column for column, field in OPTIONAL.items() if (rows.loc[:, field] > 0).any()]
    columns += [
        column for column in (EPOCH, Column("benchmark_version", "Version")) if rows.loc[:, column.field].nunique() > 1
    ]
    notes = [*meanings([*rows["n_mark"], *rows["missing_mark"]]), *_notes_on_arms(beside)]
    if brief:
        columns = [replace(c, spread="") for c in columns if c.field not in ("n_runs", "epoch", "benchmark_version")]
    else:
        notes = ["ranked by PECS", *notes]
    return PrintedTable(
        f"leaderboard_{dataset}", TITLES[dataset], rows, columns, notes, "this study has no leaderboard yet", _trace,
        dash="not all four datasets evaluated, or nothing decided" if dataset == "overall" else "nothing decided",
        lead=provenance(board),
    )  # fmt: skip


def _with_robust(rows: pd.DataFrame, beside: Robust) -> pd.DataFrame:
    """The rows with PECS-R and gap as printed; PECS-R has the number of its arms unless these are all."""
    found = [beside.get((row["model"], row["regime"])) for row in rows.to_dict("records")]
    return rows.assign(
        pecs_r=[fraction(row["pecs_r"]) + _of_arms(row) if row else NOT_RUN for row in found],
        gap=[fraction(row["gap"]) if row else NOT_RUN for row in found],
    )


def _of_arms(row: Mapping[str, Any]) -> str:
    return f" ({len(row['arms'])} of {len(ARMS)} arms)" if len(row["arms"]) < len(ARMS) else ""


def _notes_on_arms(beside: Robust) -> list[str]:
    """Notes that name the arms of each PECS-R, and the reasons why there is no gap."""
    entries: dict[tuple[str, ...], list[str]] = {}
    for (model, regime), row in beside.items():
        entries.setdefault(tuple(row["arms"]), []).append(f"{model} {regime}")
    notes = [
        f"PECS-R{' of ' + ', '.join(names) if len(entries) > 1 else ''} is over {len(arms)} of {len(ARMS)} arms: "
        + ", ".join(arms)
        for arms, names in entries.items()
    ]
    refused = dict.fromkeys(row["refused"] for row in beside.values() if row["refused"])
    return [*notes, *(f"no gap: {why}" for why in refused)]


def _trace(row: Mapping[str, Any], field: str) -> Behind | None:
    if row.get(field) == NOT_RUN:
        return None
    return cell_trace({**row, "dataset": field} if field in DATASETS else row, field)


def _entries(board: pd.DataFrame, dataset: str, others: Sequence[str]) -> pd.DataFrame:
    """One row per (model, regime), best first: its LEADERBOARD row of the dataset, PECS of the others, and marks. For
    an entry without a row of the dataset the counts are sums over all its rows."""
    found = []
    for _, rows in of_several_runs(board).groupby(["model", "regime"], sort=False):
        by_dataset = {row["dataset"]: row for row in rows.to_dict("records")}
        main = by_dataset.get(dataset)
        counted = list(by_dataset.values()) if main is None else [main]
        entry: dict[str, Any] = {name: counted[0][name] for name in ("model", "regime")} | (main or {})
        entry |= {n: sum(row[n] for row in counted) for n in ("n_pairs", "n_missing", "n_refused", "n_empty")}
        entry["mark"] = INCOMPLETE_MARK if main and main["incomplete"] else ""
        entry["n_mark"] = INCOMPLETE_MARK if any(row["incomplete"] for row in counted) else ""
        entry["missing_mark"] = MISSING_MARK if entry["n_missing"] else ""
        entry["ci"] = (main and interval(main)) or NONE
        entry["bounds"] = _bounds(main) if main and main["n_missing"] else ""
        for name in others:
            row = by_dataset.get(name)
            entry |= {name: row["pecs"], f"{name}_mark": INCOMPLETE_MARK if row["incomplete"] else ""} if row else {}
        found.append(entry)
    own = [column.name for column in LEADERBOARD.columns]
    marks = ["mark", "n_mark", "missing_mark", "ci", "bounds", *others, *(f"{name}_mark" for name in others)]
    return pd.DataFrame(sorted(found, key=_rank), columns=pd.Index([*own, *marks]))


def _bounds(row: Mapping[str, Any]) -> str:
    return f"[{fraction(row['pecs_low'])}, {fraction(row['pecs_high'])}]"


def _rank(entry: Mapping[str, Any]) -> tuple[bool, float, str, int]:
    """Sort key: best PECS first, nulls last; ties by model, then in the order of the regimes."""
    pecs = float(entry.get("pecs", float("nan")))
    null = pecs != pecs
    regimes = (*REGIMES, entry["regime"])
    return null, 0.0 if null else -pecs, entry["model"], regimes.index(entry["regime"])
