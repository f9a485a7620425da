"""Share columns and sentences between tables."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from traps_pipeline.models.registry.entries import load_models
from traps_pipeline.protocol import metric_words
from traps_pipeline.protocol.datasets import DATASETS, SHORT, TWO_EVENTS
from traps_pipeline.protocol.metric_words import METRIC_WORDS
from traps_pipeline.protocol.regimes import REGIMES
from traps_pipeline.report.result_frames import Results
from traps_pipeline.report.terms import INCOMPLETE_MARK, MARKS, MISSING_MARK, SIDE_OF, TITLE_OF
from traps_pipeline.report.writing import Column, PrintedTable, SourceItems, fraction

if TYPE_CHECKING:
    import pandas as pd

MODEL, REGIME = Column("model", "Model", look="head"), Column("regime", "Regime", look="tag")
DATASET = Column("title", "Dataset")
N, MISSING, RUNS = (
    Column("n_pairs", "n", "count"),
    Column("n_missing", "Missing", "count"),
    Column("n_runs", "Runs", "count"),
)
EPOCH = Column("epoch", "Epoch")
_METRICS = {
    metric.name: Column(metric.name, metric.heading, metric.unit, spread=f"{metric.name}_std")
    for metric in METRIC_WORDS.values()
}
SHARE_COLUMNS = tuple(_METRICS[name] for name in metric_words.SHARES)
J, PECS = _METRICS["j"], replace(_METRICS["pecs"], mark="mark", look="strong")
OTHER_METRICS = tuple(column for name, column in _METRICS.items() if name != "pecs" and column not in SHARE_COLUMNS)
COUNT_COLUMNS = (N, RUNS, MISSING)
COUNTED = ("n_pairs", "n_runs", "n_missing", "incomplete")


def cell_trace(row: Mapping[str, Any], field: str) -> SourceItems | None:
    """Return the items behind a number by model, regime and, if any, dataset."""
    if field.startswith("published"):
        return None
    dataset = row.get("dataset")
    side = SIDE_OF.get(field, "")
    return SourceItems(dataset if dataset in DATASETS else "", row["model"], row["regime"], side)


def two_events_trace(row: Mapping[str, Any], field: str) -> SourceItems:
    """Return the items of two events behind a model's and regime's number."""
    return SourceItems(TWO_EVENTS, row["model"], row["regime"])


def with_marks(rows: pd.DataFrame) -> pd.DataFrame:
    """Return the rows with `mark`: ‡ if incomplete, else † if items are missing."""
    incomplete = rows["incomplete"].eq(True).to_numpy(bool)
    missing = rows["n_missing"].fillna(0).to_numpy(float) > 0
    return rows.assign(mark=np.where(incomplete, INCOMPLETE_MARK, np.where(missing, MISSING_MARK, "")))


def with_titles(rows: pd.DataFrame) -> pd.DataFrame:
    """Return the rows with `title`, the printed name of the dataset."""
    return rows.assign(title=rows.loc[:, "dataset"].map(TITLE_OF))


def combined_counts(sides: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return the counts (COUNTED) of a comparison: fewest pairs and runs, sum of missing items."""
    if not sides:
        return dict.fromkeys(COUNTED)
    counts = {name: min(side[name] for side in sides) for name in ("n_pairs", "n_runs")}
    missing = sum(side["n_missing"] for side in sides)
    return {**counts, "n_missing": missing, "incomplete": any(side["incomplete"] for side in sides)}


def with_counts(rows: pd.DataFrame, entries: pd.DataFrame, sides: Sequence[Sequence[str]]) -> pd.DataFrame:
    """Return rows that compare entries, `marked` and with COUNTED. sides: their columns of model, regime, dataset."""
    import pandas as pd

    entry_of = {(e["model"], e["regime"], e["dataset"]): e for e in entries.to_dict("records")}
    keys = [[tuple(row[name] for name in side) for side in sides] for row in rows.to_dict("records")]
    counts = [combined_counts([entry_of[key] for key in entry_keys if key in entry_of]) for entry_keys in keys]
    return with_marks(rows.join(pd.DataFrame(counts, index=rows.index, columns=pd.Index(COUNTED))))


def entries(results: Results) -> pd.DataFrame:
    """Return rows of (model, dataset, regime): each dataset's, then those of `overall`."""
    import pandas as pd

    return pd.concat([results.cells, results.overall.assign(dataset="overall")], ignore_index=True)


def mark_notes(rows: pd.DataFrame) -> list[str]:
    """Return notes that explain the marks (‡, §, ...) in rows of a leaderboard."""
    return meanings(rows["mark"])


def meanings(marks: Iterable[str]) -> list[str]:
    """Return a note that explains each of the marks (‡, §, ...), once."""
    used_marks = set(marks)
    return [f"{mark} {meaning}" for mark, meaning in MARKS.items() if mark in used_marks]


def epochs(rows: pd.DataFrame) -> str:
    """Return a note on the only epoch, or on mixed ones; empty without rows."""
    dated_rows = rows.dropna(subset=["epoch"]) if "epoch" in rows else rows.iloc[:0]
    epoch_names = sorted({part for epoch in dated_rows["epoch"] for part in str(epoch).split("+")})
    if len(epoch_names) <= 1:
        return f"epoch {epoch_names[0]}" if epoch_names else ""
    groups: dict[str, list[str]] = {}
    for key, part in dated_rows.groupby("dataset", sort=False) if "dataset" in dated_rows else []:
        names = " and ".join(sorted(set(part["epoch"].astype(str))))
        groups.setdefault(names, []).append(SHORT.get(str(key), str(key)))
    main_epoch = max(groups, key=lambda name: len(groups[name]), default="")
    parts = [f"{', '.join(keys)}: {epoch}" for epoch, keys in groups.items() if epoch != main_epoch]
    if not parts:
        return f"mixed epochs ({' and '.join(epoch_names)})"
    return f"mixed epochs ({'; '.join([*parts, f'else {main_epoch}'])})"


def printed_columns(results: Results, rows: pd.DataFrame, columns: Sequence[Column]) -> list[Column]:
    """Return a table's columns: all for a study, the printed ones for the paper."""
    is_complete = results.is_study or not len(rows)
    return [c for c in columns if is_complete or c.field not in rows or not rows.loc[:, c.field].isna().all()]


def best_first(rows: pd.DataFrame) -> pd.DataFrame:
    """Return the rows by decreasing PECS, nulls last."""
    return rows.sort_values("pecs", ascending=False, na_position="last", ignore_index=True, kind="stable")


def sort_rows(rows: pd.DataFrame, by: Sequence[str]) -> pd.DataFrame:
    """Return the rows sorted by columns; datasets, regimes and models in their own order, not by letters."""
    orders: dict[str, Sequence[str]] = {"dataset": [*DATASETS, "overall"], "regime": REGIMES, "model": [*load_models()]}

    def place(values: pd.Series) -> pd.Series:
        order = orders.get(str(values.name))
        return values if order is None else values.map({v: k for k, v in enumerate(order)}).fillna(len(order))

    return rows.sort_values(list(by), key=place, ignore_index=True, kind="stable")


def interval(row: Mapping[str, Any]) -> str:
    """Return the interval of a row's PECS as printed; empty if there is none."""
    low, high = row.get("pecs_ci_low"), row.get("pecs_ci_high")
    return "" if low != low or low is None else f"[{fraction(low)}, {fraction(high)}]"


def ranks(row: Mapping[str, Any]) -> str:
    """Return the range of a row's ranks that contrasts do not separate, as printed."""
    import pandas as pd

    low, high = row.get("rank_low"), row.get("rank_high")
    return "" if low is None or pd.isna(low) else f"{low:.0f}" if low == high else f"{low:.0f}–{high:.0f}"


def frame(rows: Sequence[Mapping[str, Any]], columns: Sequence[str]) -> pd.DataFrame:
    """Return a list of rows as a frame; without rows, an empty frame with these columns."""
    import pandas as pd

    return pd.DataFrame(list(rows)) if rows else pd.DataFrame(columns=pd.Index(list(columns)))


def rightly_empty(table: PrintedTable, run: bool) -> PrintedTable:
    """Return the table; if it was computed and has no rows, it prints `why`, not "not run"."""
    return replace(table, none=table.why) if run and not len(table.rows) else table


def no_overall(results: Results, replication: bool) -> str:
    """Return a sentence that says why a table has no row over all datasets."""
    if replication:
        return "no model of the replication families has all four datasets"
    return "no model has all four datasets" if len(results.cells) else results.why("cells")
