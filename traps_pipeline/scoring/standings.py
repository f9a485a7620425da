"""Average scores over runs, per dataset and overall, with deviations (docs/spec.md 5.2)."""

from collections import Counter
from collections.abc import Callable, Sequence
from typing import Any, cast

import numpy as np
import pandas as pd

from traps_pipeline.models.registry.entries import reference_rows
from traps_pipeline.protocol.datasets import DATASETS
from traps_pipeline.protocol.metric_words import BROKEN_COUNTS, METRIC_WORDS
from traps_pipeline.scoring.bootstrap import ENTRY, limits_of
from traps_pipeline.scoring.metrics import (
    BOUNDS,
    CELL,
    CELL_METRICS,
    COUNT_COLUMNS,
    REJECTION_COLUMNS,
    joined_epochs,
    joined_in_groups,
    joined_versions,
    n_items,
    pecs_of,
)
from traps_pipeline.scoring.score_rows import BROKEN_ABOVE, INCOMPLETE_BELOW, LEADERBOARD

_RUN = ["model", "regime", "run"]
_SUMMED = ["n_missing", "n_items", *COUNT_COLUMNS]


def leaderboard(metrics: pd.DataFrame, intervals: pd.DataFrame, contrasts: pd.DataFrame) -> pd.DataFrame:
    """Return LEADERBOARD rows: `standings` with intervals, and ranks from CONTRASTS."""
    board = standings(metrics).merge(intervals, on=ENTRY, how="left", validate="one_to_one")
    return board.join(_ranks(board, contrasts)).loc[:, LEADERBOARD.names]


def standings(metrics: pd.DataFrame) -> pd.DataFrame:
    """Return the leaderboard's scores, without intervals and ranks.

    metrics: METRICS rows of the scopes `all` and, for `pecs_by_family`, `sub_scenario:`; others are ignored. Mean and
    population standard deviation (ddof 0) over runs. `overall` takes the equal-weight mean over the four datasets
    within each run first; a run that lacks a dataset is left out of it, and a model and regime without a complete run
    has no overall row. A metric that is null in one run is null here, so that every mean is over `n_runs` runs. Items
    without a text count in no metric; if there are too many of them, the entry is `incomplete`.
    """
    groups = _runs(metrics).groupby(ENTRY, sort=True)
    means = group_metric(groups, [*CELL_METRICS, "pecs_by_family", *BOUNDS])
    deviations = group_metric(groups, CELL_METRICS, np.std)
    sums = cast(pd.DataFrame, groups[_SUMMED].sum())
    sums[REJECTION_COLUMNS] = groups[REJECTION_COLUMNS].sum(min_count=1)
    board = means.join([deviations.add_suffix("_std"), sums])
    board["n_runs"] = groups["run"].nunique()
    board["epoch"] = joined_in_groups(groups, "epoch", joined_epochs)
    board["panel"] = joined_in_groups(groups, "panel", joined_epochs)
    board["benchmark_version"] = joined_in_groups(groups, "benchmark_version", joined_versions)
    board["answered"] = board["n_answered"] / board["n_items"]
    board["incomplete"] = _spread_flags(cast(pd.Series, board["answered"] < INCOMPLETE_BELOW))
    board["broken"] = board[[*BROKEN_COUNTS]].sum(axis=1) / board["n_items"]
    board["is_broken"] = _spread_flags(cast(pd.Series, board["broken"] > BROKEN_ABOVE))
    board[["n_pairs", "n_items"]] = groups[["n_pairs", "n_items"]].max()  # of a run, where counts are over runs
    return board.reset_index()


def means_over_runs(metrics: pd.DataFrame) -> pd.DataFrame:
    """Return the leaderboard's means of METRICS rows over runs: CELL_METRICS by ENTRY."""
    return group_metric(_runs(metrics).groupby(ENTRY, sort=True), CELL_METRICS)


def _runs(metrics: pd.DataFrame) -> pd.DataFrame:
    """Return METRICS rows with n_items, by model, regime, dataset (or overall), run."""
    cells = metrics.loc[metrics["scope"] == "all"]
    cells = cells.assign(n_items=n_items(cells)).merge(_family_pecs(metrics), on=CELL, how="left")
    return pd.concat([cells, _overall_runs(cells)], ignore_index=True)


def _family_pecs(metrics: pd.DataFrame) -> pd.DataFrame:
    """Return CELL and `pecs_by_family`: PECS of means that weigh families equally.

    The paper calls a family a sub-scenario.
    """
    families = metrics.loc[metrics["scope"].str.startswith("sub_scenario:")].groupby(CELL)
    shares = group_metric(families, ["acc", "abs_rec", "false_abs"])
    pecs = pecs_of(shares["acc"].to_numpy(float), (shares["abs_rec"] - shares["false_abs"]).to_numpy(float))
    return shares.assign(pecs_by_family=pecs)[["pecs_by_family"]].reset_index()


def _overall_runs(cells: pd.DataFrame) -> pd.DataFrame:
    """Return METRICS of each (model, regime, run) that has all four datasets."""
    groups = cells.groupby(_RUN, sort=True)
    complete_runs = cells.loc[groups["dataset"].transform("nunique") == len(DATASETS)].groupby(_RUN, sort=True)
    counts = cast(pd.DataFrame, complete_runs[["n_pairs", *_SUMMED]].sum())
    counts[REJECTION_COLUMNS] = complete_runs[REJECTION_COLUMNS].sum(min_count=1)
    overall = group_metric(complete_runs, [*CELL_METRICS, "pecs_by_family", *BOUNDS]).join(counts)
    overall["epoch"] = joined_in_groups(complete_runs, "epoch", joined_epochs)
    overall["panel"] = joined_in_groups(complete_runs, "panel", joined_epochs)
    overall["benchmark_version"] = joined_in_groups(complete_runs, "benchmark_version", joined_versions)
    return overall.reset_index().assign(dataset="overall")


def _spread_flags(wrong: pd.Series) -> pd.Series:
    """Return flags by ENTRY; those of `overall` are set if any dataset's is."""
    anywhere = cast(pd.Series, wrong.groupby(level=["model", "regime"]).transform("any")).astype(bool)
    return wrong | (anywhere & (wrong.index.get_level_values("dataset") == "overall"))


def group_metric(groups: Any, columns: Sequence[str], metric: Callable[..., np.ndarray] = np.mean) -> pd.DataFrame:
    """Return a metric of each group's values in some columns, indexed by group.

    It is null if any value is null, so that no mean silently uses fewer values. Groups of one size are one array.
    """
    index, rows_of = groups.size().index, groups.indices
    places, values = [rows_of[key] for key in index], groups.obj[[*columns]].to_numpy(float)
    sizes, table = np.array([len(rows) for rows in places]), np.full((len(index), len(columns)), np.nan)
    for size in np.unique(sizes):
        rows = np.stack([rows for rows in places if len(rows) == size])
        table[sizes == size] = metric(np.ascontiguousarray(values[rows].swapaxes(1, 2)), axis=-1)
    return pd.DataFrame(table, index, pd.Index(columns))


def _ranks(board: pd.DataFrame, contrasts: pd.DataFrame) -> pd.DataFrame:
    """Return rank, rank_low and rank_high within the panel, on `board`'s index.

    Null without PECS, and if the row is of several panels. Reference rows have ranks of their own.
    """
    is_separable = contrasts["separable"].astype("boolean").fillna(False)
    left, right = (contrasts[name].isin(reference_rows()) for name in ("left_model", "right_model"))
    is_ranking = (contrasts["kind"] == "models") & (contrasts["metric"] == "pecs") & (left == right)
    separable = contrasts.loc[is_ranking & is_separable]
    wins, losses = Counter[tuple[str, ...]](), Counter[tuple[str, ...]]()
    for row in separable.to_dict("records"):
        winner, loser = (row["left_model"], row["right_model"])[:: 1 if row["difference"] > 0 else -1]
        wins[winner, row["left_regime"], row["dataset"]] += 1
        losses[loser, row["left_regime"], row["dataset"]] += 1
    entries = list(board[ENTRY].itertuples(index=False, name=None))
    peers = board.groupby(["regime", "dataset", "panel", board["model"].isin(reference_rows())])["pecs"]
    ranks = {
        "rank": peers.rank(method="min", ascending=False),
        "rank_low": pd.Series([1 + losses[entry] for entry in entries], board.index),
        "rank_high": peers.transform("count") - pd.Series([wins[entry] for entry in entries], board.index),
    }
    is_ranked = board["pecs"].notna() & ~board["panel"].str.contains("+", regex=False)
    return pd.DataFrame(ranks).where(is_ranked).astype("Int64")


def wrong_intervals(board: pd.DataFrame) -> int:
    """Return the number of intervals that are out of order or outside their score's limits."""
    n_wrong = 0
    for metric in METRIC_WORDS:
        low, high = (board[f"{metric}_ci_{end}"].to_numpy(float) for end in ("low", "high"))
        lowest, highest = limits_of(metric)
        n_wrong += int(((low < lowest) | (low > high) | (high > highest)).sum())
    return n_wrong
