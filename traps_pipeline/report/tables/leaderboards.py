"""Tabulate leaderboards, overall and by dataset (docs/spec.md 5.2 and 10)."""

from __future__ import annotations

from typing import TYPE_CHECKING

from traps_pipeline.protocol.datasets import DATASETS
from traps_pipeline.protocol.regimes import PAPER_REGIMES
from traps_pipeline.report.result_frames import Results
from traps_pipeline.report.tables.table_columns import (
    COUNT_COLUMNS,
    DATASET,
    EPOCH,
    MODEL,
    PECS,
    REGIME,
    SHARE_COLUMNS,
    J,
    best_first,
    cell_trace,
    epochs,
    interval,
    mark_notes,
    no_overall,
    ranks,
    sort_rows,
    with_marks,
    with_titles,
)
from traps_pipeline.report.terms import TITLE_OF
from traps_pipeline.report.writing import Column, PrintedTable, SourceItems, Trace
from traps_pipeline.scoring import analyses
from traps_pipeline.scoring.published import published_overall

if TYPE_CHECKING:
    import pandas as pd


def overall(results: Results) -> list[PrintedTable]:
    """Return the overall leaderboard by PECS, without the replication families."""
    return [_overall(results, "overall", "Overall leaderboard", replication=False)]


def replication_overall(results: Results) -> list[PrintedTable]:
    """Return the leaderboard over all datasets, of models of the replication group."""
    return [_overall(results, "replication_overall", "Replication families, overall", replication=True)]


def _overall(results: Results, name: str, title: str, replication: bool) -> PrintedTable:
    rows = with_marks(results.overall)
    rows = rows.loc[rows["model"].isin(analyses.models_of(group="replication")) == replication]
    columns = [MODEL, REGIME, PECS, *SHARE_COLUMNS, J]
    notes = [epochs(results.cells), "equal-weight mean over the four datasets", *mark_notes(rows)]
    if results.is_study:
        records = rows.to_dict("records")
        rows = rows.assign(ci=[interval(row) for row in records], ranks=[ranks(row) for row in records])
        columns[3:3] = [Column("ci", "95 % CI", "range"), Column("ranks", "Rank", "range")]
        notes.append("rank by PECS within the regime; 2–4: paired contrasts (Holm) do not separate these ranks")
        published_scores = (
            published_overall().loc[:, ["model", "regime", "pecs"]].rename(columns={"pecs": "published_pecs"})
        )
        rows = rows.merge(published_scores, on=["model", "regime"], how="left")
        if rows["published_pecs"].notna().any():
            columns.append(Column("published_pecs", "published PECS", "fraction"))
            notes.append("published PECS: as printed in the paper, from its own benchmark and epochs")
    return PrintedTable(
        name, title, best_first(rows), [*columns, *COUNT_COLUMNS], notes, no_overall(results, replication), cell_trace
    )


def per_dataset(results: Results) -> list[PrintedTable]:
    """Return PECS of every model and regime on each dataset, and overall."""
    import pandas as pd

    cells = with_marks(results.cells)
    cells = cells.loc[~cells["model"].isin(analyses.models_of(group="replication"))]
    index = ["model", "regime"]
    rows = cells[index].drop_duplicates()
    columns = [MODEL, REGIME]
    for dataset in DATASETS:
        names = {"pecs": dataset, "pecs_std": f"{dataset}_std", "mark": f"{dataset}_mark", "n_pairs": f"{dataset}_n"}
        part = cells.loc[cells["dataset"] == dataset, [*index, *names]].rename(columns=names)
        rows = rows.merge(part, on=index, how="left")
        heading = _n(TITLE_OF[dataset], part[f"{dataset}_n"])
        columns.append(Column(dataset, heading, "fraction", spread=f"{dataset}_std", mark=f"{dataset}_mark"))
    names = {"pecs": "mean", "pecs_std": "mean_std", "mark": "mean_mark"}
    overall = with_marks(results.overall).reindex(columns=pd.Index([*index, *names])).rename(columns=names)
    rows = rows.merge(overall, on=index, how="left")
    columns.append(Column("mean", "Mean", "fraction", spread="mean_std", mark="mean_mark"))
    rows = rows.sort_values("mean", ascending=False, na_position="last", ignore_index=True, kind="stable")
    notes = [epochs(cells), "mean: overall, over the runs that have all four datasets", *mark_notes(cells)]
    trace: Trace = lambda row, field: SourceItems(field if field in DATASETS else "", row["model"], row["regime"])  # noqa: E731
    return [PrintedTable("per_dataset", "PECS by dataset", rows, columns, notes, results.why("cells"), trace)]


def replication_per_dataset(results: Results) -> list[PrintedTable]:
    """Return the replication families' metrics on each dataset."""
    cells = with_marks(results.cells)
    rows = cells.loc[cells["model"].isin(analyses.models_of(group="replication"))]
    rows = sort_rows(with_titles(rows), ["model", "dataset", "regime"])
    columns = [MODEL, DATASET, REGIME, PECS, *SHARE_COLUMNS, *COUNT_COLUMNS, EPOCH]
    notes = [epochs(rows), *mark_notes(rows)]
    reason = "no model of the replication families"
    title = "Replication families, by dataset"
    return [PrintedTable("replication_per_dataset", title, rows, columns, notes, reason, cell_trace)]


def _n(title: str, counts: pd.Series) -> str:
    """Return a heading with the number of pairs, if it is the same in all rows."""
    known_counts = counts.dropna().unique()
    return f"{title} (n = {int(known_counts[0])})" if len(known_counts) == 1 else title


def expanded(results: Results) -> list[PrintedTable]:
    """Return Acc, AbsRec, FalseAbs, PECS of every model, by dataset and regime."""
    cells = with_marks(results.cells)
    tables = []
    for dataset in DATASETS:
        for regime in PAPER_REGIMES:
            rows = cells.loc[(cells["dataset"] == dataset) & (cells["regime"] == regime)]
            notes = [epochs(rows), *mark_notes(rows)]
            tables.append(
                PrintedTable(
                    f"expanded_{dataset}_{regime}", f"{TITLE_OF[dataset]}, {regime}", best_first(rows),
                    [MODEL, *SHARE_COLUMNS, PECS, *COUNT_COLUMNS, EPOCH], notes, "no model was asked here", cell_trace,
                )
            )  # fmt: skip
    return tables
