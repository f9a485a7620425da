"""Compute each cell's Acc, FalseAbs, AbsRec, J, PECS, Naive (docs/spec.md 5.1)."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from functools import cache
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from traps_pipeline.models.request import JUDGED_OUTCOMES
from traps_pipeline.protocol.metric_words import COUNT_WORDS, METRIC_WORDS
from traps_pipeline.scoring.score_rows import METRICS

if TYPE_CHECKING:
    import pandas as pd

CELL = ["dataset", "model", "regime", "run"]
CELL_METRICS = [*METRIC_WORDS, "naive"]
BOUNDS = ["pecs_low", "pecs_high"]
# The outcomes in each count of items. An item is answered if its answer is judged, even if the judges are undecided.
OUTCOMES = {"n_answered": JUDGED_OUTCOMES} | {c.name: c.outcomes for c in COUNT_WORDS.values() if c.outcomes}
COUNT_COLUMNS = [*OUTCOMES, "n_not_json"]
REJECTION_COLUMNS = [count.name for count in COUNT_WORDS.values() if count.is_of_decisions]
# For each decision, how often it was yes (numerator) and how often it was made (denominator, `_of`); every metric is
# computed from these six counts.
COUNTS = ["correct", "correct_of", "false_abs", "false_abs_of", "abs_rec", "abs_rec_of"]
# The columns of each scope. A label belongs to a sub-scenario: the count 1 of one scene is not the bucket 1 of another.
SCOPED_BY: Mapping[str, tuple[str, ...]] = {
    "category": ("category",),
    "sub_scenario": ("sub_scenario",),
    "label": ("sub_scenario", "control_answer"),
}


def decision_counts(verdicts: pd.DataFrame) -> pd.DataFrame:
    """Return for every verdict the COUNTS, 0 or 1 each, as a frame (items, 6) of int64.

    The index is that of the verdicts. A null decision counts in no denominator: shares are over decided items.
    """
    import pandas as pd

    control = verdicts["side"].eq("control")
    abstained, correct = (verdicts[name].astype("boolean") for name in ("abstained", "correct"))
    is_decided = abstained.notna()
    counts = {
        "correct": control & correct.fillna(False),
        "correct_of": control & correct.notna(),
        "false_abs": control & abstained.fillna(False),
        "false_abs_of": control & is_decided,
        "abs_rec": ~control & abstained.fillna(False),
        "abs_rec_of": ~control & is_decided,
    }
    return pd.DataFrame({name: flags.astype("int64") for name, flags in counts.items()})


def n_items(counts: Any) -> Any:
    """Return the number of items behind METRICS rows: each item has one outcome."""
    return sum(counts[name] for name in OUTCOMES)


def pecs_of(acc: np.ndarray, j: np.ndarray) -> np.ndarray:
    """Return PECS = Acc x max(0, J), elementwise; NaN where either is."""
    return acc * np.maximum(j, 0.0)


def cell_metrics(verdicts: pd.DataFrame, scoped_by: Mapping[str, tuple[str, ...]] = SCOPED_BY) -> pd.DataFrame:
    """Return METRICS rows of one dataset, from its VERDICTS rows.

    There is one row per cell and scope: `all`, `category:x`, `sub_scenario:x`, and `label:x/y` (y: the control's answer
    in the sub-scenario x; both sides of the pair); `scoped_by` (prefix to columns) may name fewer. Metrics are
    fractions; a metric whose denominator is 0 is null, and so is every metric computed from it. `n_missing` counts the
    asked items that lack a decision: abstained or correct on a control, abstained on a void. BOUNDS show how far the
    missing decisions could move PECS; they are never null.
    Every share has its n and its Wilson interval.

    Raises ValueError if the verdicts are of several datasets, whose versions may differ (docs/spec.md 5.1).
    """
    datasets = sorted(verdicts["dataset"].unique())
    if len(datasets) > 1:
        raise ValueError(f"verdicts of several datasets {datasets}: score one dataset at a time")
    groups = _with_scopes(verdicts, scoped_by).groupby([*CELL, "scope"], sort=True)
    sums = cast("pd.DataFrame", groups[[*COUNTS, "complete", "controls", *COUNT_COLUMNS]].sum())
    sums[REJECTION_COLUMNS] = groups[REJECTION_COLUMNS].sum(min_count=1)
    sums["n_pairs"] = groups["pair_id"].nunique()
    sums["n_missing"] = n_items(sums) - sums["complete"]
    sums["epoch"] = joined_in_groups(groups, "epoch", joined_epochs)
    sums["panel"] = joined_in_groups(groups, "panel", joined_epochs)
    sums["benchmark_version"] = joined_in_groups(groups, "benchmark_version", joined_versions)
    return sums.assign(**_metrics(sums), **_bounds(sums), **_wilson(sums)).reset_index().loc[:, METRICS.names]


def joined_in_groups(groups: Any, column: str, joined: Callable[[Iterable[str]], str]) -> pd.Series:
    """Return a column's joined values by group, as `agg(joined)`, at once for groups with the same values."""
    import pandas as pd

    index, of_values = groups.size().index, cache(joined)
    rows = pd.DataFrame({"group": groups.ngroup(), "value": groups.obj[column]}).drop_duplicates()
    values: list[list[str]] = [[] for _ in index]
    for group, value in zip(rows["group"].tolist(), rows["value"].tolist(), strict=True):
        if group >= 0:  # else a key is missing
            values[group].append(value)
    return pd.Series([of_values(tuple(sorted(names))) for names in values], index, dtype="str")


def joined_epochs(epochs: Iterable[str]) -> str:
    """Return distinct campaigns or panels, split at `+`, sorted and joined by `+`."""
    return "+".join(sorted({part for epoch in set(epochs) for part in epoch.split("+") if part}))


def joined_versions(versions: Iterable[str]) -> str:
    """Return distinct benchmark versions, split at ` + `, sorted and joined."""
    return " + ".join(sorted({part for version in versions for part in version.split(" + ")}))


def _with_scopes(verdicts: pd.DataFrame, scoped_by: Mapping[str, tuple[str, ...]]) -> pd.DataFrame:
    """Return verdicts with counts, once per scope: (1 + len(scoped_by)) x items rows."""
    import pandas as pd

    counts = decision_counts(verdicts)
    is_control = verdicts["side"].eq("control")
    is_complete = np.where(is_control, counts["correct_of"] & counts["false_abs_of"], counts["abs_rec_of"])
    outcomes = {name: verdicts["outcome"].isin(kinds).astype("int64") for name, kinds in OUTCOMES.items()}
    is_not_json = verdicts["is_json"].eq(False).astype("int64")
    rejects_premise = verdicts["rejects_premise"].astype("boolean").where(~is_control)
    is_answered = rejects_premise & ~verdicts["abstained"].astype("boolean").fillna(False)
    optional = (rejects_premise, is_answered, verdicts["overruled"].astype("boolean"))
    rejections = {name: f.astype("Int64") for name, f in zip(REJECTION_COLUMNS, optional, strict=True)}
    flags = counts.assign(
        complete=is_complete, controls=is_control.astype("int64"), **outcomes, n_not_json=is_not_json, **rejections
    )
    items = pd.concat([verdicts[[*CELL, "pair_id", "epoch", "panel", "benchmark_version"]], flags], axis=1)
    scopes = [pd.Series("all", index=items.index)]
    for prefix, columns in scoped_by.items():
        parts = zip(*(verdicts[column].astype("str") for column in columns), strict=True)
        scopes.append(pd.Series([f"{prefix}:{'/'.join(part)}" for part in parts], index=items.index))
    return pd.concat([items.assign(scope=scope) for scope in scopes], ignore_index=True)


def _metrics(sums: pd.DataFrame) -> dict[str, np.ndarray]:
    """Return CELL_METRICS of every cell, (cells,) each."""
    acc, false_abs, abs_rec = (_share(sums, name) for name in ("correct", "false_abs", "abs_rec"))
    metrics = {name: metric.formula(acc, false_abs, abs_rec) for name, metric in METRIC_WORDS.items()}
    return metrics | {"naive": acc * abs_rec}


def _bounds(sums: pd.DataFrame) -> dict[str, np.ndarray]:
    """Return PECS if every missing decision were bad, and if good, (cells,) each.

    Each decision is bounded separately, since an item may lack only one; PECS rises with Acc and AbsRec and falls with
    FalseAbs, so that these two are its exact extremes. If nothing is missing both equal PECS bit for bit.
    """
    controls, voids = sums["controls"].to_numpy(float), (n_items(sums) - sums["controls"]).to_numpy(float)
    low, high = dict[str, np.ndarray](), dict[str, np.ndarray]()
    for name, asked in (("correct", controls), ("false_abs", controls), ("abs_rec", voids)):
        yes, undecided = sums[name].to_numpy(float), asked - sums[f"{name}_of"].to_numpy(float)
        low[name] = yes / np.maximum(asked, 1)
        high[name] = np.where(asked > 0, (yes + undecided) / np.maximum(asked, 1), 1.0)  # of nothing asked: anything
    return {
        "pecs_low": pecs_of(low["correct"], low["abs_rec"] - high["false_abs"]),
        "pecs_high": pecs_of(high["correct"], high["abs_rec"] - low["false_abs"]),
    }


def wilson(yes: np.ndarray, of: np.ndarray, z: float = 1.959963984540054) -> tuple[np.ndarray, np.ndarray]:
    """Return Wilson's (95 %) interval of yes / of, (n,) each; NaN where of is 0."""
    of = np.where(of > 0, of, np.nan)
    share, square = yes / of, z**2 / of
    centre = (share + square / 2) / (1 + square)
    half_width = z / (1 + square) * np.sqrt(share * (1 - share) / of + square / (4 * of))
    return np.maximum(centre - half_width, 0.0), np.minimum(centre + half_width, 1.0)


def _wilson(sums: pd.DataFrame) -> dict[str, np.ndarray]:
    """Return the denominator of each share, and the share's interval: (cells,) each."""
    columns = {}
    for metric, name in (("acc", "correct"), ("false_abs", "false_abs"), ("abs_rec", "abs_rec")):
        totals = sums[f"{name}_of"].to_numpy("int64")
        low, high = wilson(sums[name].to_numpy(float), totals.astype(float))
        columns |= {f"n_{metric}": totals, f"{metric}_low": low, f"{metric}_high": high}
    return columns


def _share(sums: pd.DataFrame, name: str) -> np.ndarray:
    """Return numerator over denominator, (cells,); NaN where the denominator is 0."""
    totals = sums[f"{name}_of"].to_numpy(float)
    return sums[name].to_numpy(float) / np.where(totals > 0, totals, np.nan)


def wrong_metrics(cells: pd.DataFrame) -> int:
    """Return the number of metrics in METRICS rows that break their definition.

    A metric is wrong if it is a share or bound outside [0, 1], or a PECS that is not Acc x max(0, J) or lies outside
    its bounds. Null metrics (nothing decided) are not wrong.
    """
    acc, abs_rec, false_abs, pecs = (cells[name].to_numpy(float) for name in ("acc", "abs_rec", "false_abs", "pecs"))
    low, high = (cells[name].to_numpy(float) for name in BOUNDS)
    outside = sum(int(((share < 0) | (share > 1)).sum()) for share in (acc, abs_rec, false_abs, low, high))
    unbounded = int(((low > high) | (pecs < low - 1e-12) | (pecs > high + 1e-12)).sum())
    return outside + unbounded + int((np.abs(pecs - acc * np.maximum(abs_rec - false_abs, 0)) > 1e-12).sum())
