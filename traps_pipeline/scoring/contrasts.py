"""Compare models and regimes in pairs, with Holm's correction.

See docs/scoring.md, "Intervals". Two entries of the leaderboard share their resamples (`bootstrap`), so the difference
of their draws is a paired difference, in which the difficulty of the scenarios cancels. McNemar's test compares two
regimes item by item. Answers to different items, or to one item in different epochs, are not compared (`epochs`): the
row gives the reason and no difference.
"""

from collections.abc import Iterator, Sequence
from itertools import combinations
from math import comb, erfc, inf, sqrt
from typing import Any, cast

import numpy as np
import pandas as pd

from traps_pipeline.base.errors import TrapsError
from traps_pipeline.protocol.datasets import DATASETS
from traps_pipeline.protocol.regimes import REGIMES
from traps_pipeline.scoring.bootstrap import (
    ENTRY,
    RESAMPLED_METRICS,
    RESAMPLES,
    ResampledMetrics,
    difference,
    interval,
    limits_of,
    resample,
)
from traps_pipeline.scoring.epochs import Origin, answered_items, refusal
from traps_pipeline.scoring.metrics import CELL, cell_metrics
from traps_pipeline.scoring.score_rows import CONTRASTS, REGIME_TESTS
from traps_pipeline.scoring.standings import means_over_runs, standings

CONTRASTED_METRICS = ("pecs", "j")
SEPARABLE_BELOW = 0.05
VERSION_SIDES = ("n_missing", "epoch", "benchmark_version")  # columns that `version_contrasts` has for each side
_FAMILY = ["kind", "dataset", "metric", "_regime"]
_SIDE_COLUMNS = (("left_model", "left_regime"), ("right_model", "right_regime"))
_SIDES = [column for columns in _SIDE_COLUMNS for column in columns]
_AT_ONCE = 16  # paired differences whose resamples are in memory at once: so few that their memory is used again
_Side = tuple[str, str]  # model, regime


def contrasts(resampled: ResampledMetrics, metrics: pd.DataFrame, verdicts: pd.DataFrame) -> pd.DataFrame:
    """Return CONTRASTS rows: differences of models and of regimes, with intervals from the bootstrap.

    METRICS rows give the means, VERDICTS rows the items and epochs. The rows compare every pair of models under each
    regime and every pair of regimes of each model, in PECS and in J, on each dataset, and overall if both sides have a
    run of all four.
    """
    items_of, sizes = answered_items(verdicts), _scenarios(verdicts)
    rows: list[dict[str, Any]] = []
    for kind, dataset, left, right in _pairs([entry for entry in resampled.entries if entry in items_of]):
        refusal_reason = refusal(items_of[(*left, dataset)], items_of[(*right, dataset)])
        row = {
            "kind": kind,
            "dataset": dataset,
            "_regime": left[1] if kind == "models" else "",
            "refused": refusal_reason,
        }
        row |= dict(zip(_SIDES, (*left, *right), strict=True))
        rows += [{**row, "metric": metric} for metric in CONTRASTED_METRICS]
    places = {entry: row for row, entry in enumerate(resampled.entries)}
    means = means_over_runs(metrics).loc[:, [*CONTRASTED_METRICS]].to_dict("index")
    for metric in CONTRASTED_METRICS:
        compared_rows = [row for row in rows if row["metric"] == metric and row["refused"] is None]
        for first in range(0, len(compared_rows), _AT_ONCE):
            part = compared_rows[first : first + _AT_ONCE]
            sides = [[(row[model], row[regime], row["dataset"]) for row in part] for model, regime in _SIDE_COLUMNS]
            draws = [resampled.metric(metric)[[places[entry] for entry in side]] for side in sides]
            observed = [[means.get(entry, {}).get(metric, np.nan) for entry in side] for side in sides]
            row_differences = _differences(metric, draws, observed, [sizes[entry] for entry in sides[0]])
            for row, columns in zip(part, row_differences, strict=True):
                row |= columns
    table = pd.DataFrame(rows, columns=pd.Index([*CONTRASTS.names, "_regime"]))
    table["p_holm"] = _holm_by(table, _FAMILY)
    table["separable"] = _separable(table, _FAMILY)
    return table.loc[:, CONTRASTS.names]


def version_contrasts(then: pd.DataFrame, now: pd.DataFrame, resamples: int = RESAMPLES) -> pd.DataFrame:
    """Return the change of scores between two studies (or versions) on their common pairs.

    The change is now minus then; both are VERDICTS rows. A pair that is incomplete in either study, in the same run and
    cell, is left out. Columns: model, regime, dataset (and `overall`), metric, n_pairs per run, n_scenarios, then, now,
    difference, ci_low, ci_high, p, p_holm, separable, VERSION_SIDES with the suffixes _then and _now, and refused: the
    reason for a missing difference, if an item was answered in different epochs. Raises TrapsError if the two studies
    share no complete pair.
    """
    sides = _common_pairs(then, now)
    if sides[0].empty:
        raise TrapsError("the two studies share no whole pair of the same model, regime and run")
    boards = [_standings(rows).add_suffix(suffix) for rows, suffix in zip(sides, ("_then", "_now"), strict=True)]
    board = boards[0].join(boards[1], how="inner").rename(columns={"n_pairs_now": "n_pairs"})
    items_of, resampled_metrics = (
        [answered_items(rows) for rows in sides],
        [resample(rows, resamples) for rows in sides],
    )
    draws = [dict(zip(side_metrics.entries, side_metrics.values, strict=True)) for side_metrics in resampled_metrics]
    sizes = _scenarios(sides[1])
    rows = []
    for entry, entry_columns in board.to_dict("index").items():
        refusal_reason = refusal(items_of[0][entry], items_of[1][entry])
        for metric in CONTRASTED_METRICS:
            values = {
                f"{name}_{side}": entry_columns[f"{name}_{side}"] for name in VERSION_SIDES for side in ("then", "now")
            }
            values |= {side: entry_columns[f"{metric}_{side}"] for side in ("then", "now")}
            row = dict(zip(ENTRY, entry, strict=True)) | {
                "metric": metric,
                "n_pairs": entry_columns["n_pairs"],
                **values,
            }
            row["n_scenarios"] = sizes[entry]
            if refusal_reason is None:
                ends = [side_metrics[entry][None, :, RESAMPLED_METRICS.index(metric)] for side_metrics in draws[::-1]]
                row |= _differences(metric, ends, [[row["now"]], [row["then"]]], [sizes[entry]])[0]
            rows.append(row | {"refused": refusal_reason})
    columns = [
        *ENTRY,
        "metric",
        "n_pairs",
        "n_scenarios",
        "then",
        "now",
        "difference",
        "ci_low",
        "ci_high",
        "p",
        "p_holm",
    ]
    columns += ["separable"] + [f"{name}_{side}" for name in VERSION_SIDES for side in ("then", "now")] + ["refused"]
    table = pd.DataFrame(rows, columns=pd.Index(columns))
    family = ["dataset", "metric"]
    table["p_holm"] = _holm_by(table, family)
    table["separable"] = _separable(table, family)
    return table


def _common_pairs(then: pd.DataFrame, now: pd.DataFrame) -> list[pd.DataFrame]:
    """Return each study's rows of pairs (by model, regime, run) complete in both."""
    key = [*CELL, "pair_id"]
    common = then[[*key, "item_id"]].merge(now[[*key, "item_id"]], on=[*key, "item_id"])
    pairs = common.groupby(key).size()
    complete_pairs = pairs.loc[pairs == 2].reset_index().loc[:, key]
    return [rows.merge(complete_pairs, on=key) for rows in (then, now)]


def _standings(verdicts: pd.DataFrame) -> pd.DataFrame:
    """Return `leaderboard.standings` of verdicts, indexed by ENTRY."""
    cells = [cell_metrics(part, {}) for _, part in verdicts.groupby("dataset")]
    board = standings(pd.concat(cells, ignore_index=True)).set_index(ENTRY)
    return board.loc[:, ["n_pairs", *CONTRASTED_METRICS, *VERSION_SIDES]]


def regime_tests(verdicts: pd.DataFrame) -> pd.DataFrame:
    """Return REGIME_TESTS rows: McNemar's exact test of every pair of regimes.

    Each model, dataset, run and decision is tested.
    """
    rows = []
    for decision, side, column in (
        ("void_abstention", "void", "abstained"),
        ("control_abstention", "control", "abstained"),
        ("correctness", "control", "correct"),
    ):
        cell_decisions = _decisions(verdicts.loc[verdicts["side"] == side], column)
        for (dataset, model, run), decisions in sorted(cell_decisions.items()):
            for left, right in combinations([r for r in REGIMES if r in decisions], 2):
                sides = decisions[left], decisions[right]
                common_items = sides[0].keys() & sides[1].keys()
                only_left = sum(sides[0][item][0] and not sides[1][item][0] for item in common_items)
                only_right = sum(sides[1][item][0] and not sides[0][item][0] for item in common_items)
                row = {"dataset": dataset, "model": model, "run": run, "decision": decision}
                row |= {"left_regime": left, "right_regime": right, "n": len(common_items)}
                row |= {"only_left": only_left, "only_right": only_right}
                row["refused"] = refusal(*({item: of[item][1] for item in common_items} for of in sides))
                if row["refused"] is None and common_items:
                    row["p"] = mcnemar_p(only_left, only_right)
                rows.append(row)
    table = pd.DataFrame(rows, columns=pd.Index(REGIME_TESTS.names))
    table["p_holm"] = _holm_by(table, ["dataset", "decision", "left_regime", "right_regime"])
    return table


def _decisions(
    verdicts: pd.DataFrame, column: str
) -> dict[tuple[str, str, int], dict[str, dict[str, tuple[bool, Origin]]]]:
    """Return decisions with origins by (dataset, model, run), regime and item. Undecided items are left out."""
    decisions: dict[tuple[str, str, int], dict[str, dict[str, tuple[bool, Origin]]]] = {}
    columns = ["dataset", "model", "run", "regime", "item_id", column, "epoch", "panel"]
    rows = verdicts[columns].assign(is_decided=verdicts[column].notna()).itertuples(index=False, name=None)
    for dataset, model, run, regime, item, decision, epoch, panel, is_decided in rows:
        regime_decisions = decisions.setdefault((dataset, model, run), {}).setdefault(regime, {})
        if is_decided:
            regime_decisions[item] = bool(decision), Origin(epoch, panel)
    return decisions


def mcnemar_p(only_left: int, only_right: int) -> float:
    """Return McNemar's exact two-sided p from the items that differ in each direction."""
    n_differing = only_left + only_right
    tail = sum(comb(n_differing, k) for k in range(min(only_left, only_right) + 1))
    return min(1.0, 2 * tail / 2**n_differing)


def holm(p: np.ndarray) -> np.ndarray:
    """Return Holm's step-down correction of p-values (n,); NaN stays, uncounted."""
    corrected = np.full(len(p), np.nan)
    valid = np.flatnonzero(~np.isnan(p))
    order = valid[np.argsort(p[valid], kind="stable")]
    steps = p[order] * np.arange(len(order), 0, -1)
    corrected[order] = np.minimum(np.maximum.accumulate(steps), 1.0)
    return corrected


def _pairs(entries: Sequence[tuple[str, str, str]]) -> Iterator[tuple[str, str, _Side, _Side]]:
    """Return kind, dataset, left, right of every comparison, each once."""
    for dataset in (*DATASETS, "overall"):
        sides = [(model, regime) for model, regime, name in entries if name == dataset]
        for left, right in combinations(sides, 2):
            if left[1] == right[1]:
                yield "models", dataset, left, right
        for left, right in combinations(sorted(sides, key=lambda side: (side[0], REGIMES.index(side[1]))), 2):
            if left[0] == right[0]:
                yield "regimes", dataset, left, right


def least_p(scenarios: int) -> float:
    """Return the smallest two-sided p of n scenarios' paired differences, 2^(1 - n).

    It is that of a sign-flip test whose differences all have one sign. Pairs of one scenario go together, so they count
    once.
    """
    return min(1.0, 2.0 ** (1 - scenarios))


def _scenarios(verdicts: pd.DataFrame) -> dict[tuple[str, str, str], int]:
    """Return scenario counts by (model, regime, dataset); `overall` spans datasets."""
    rows = verdicts[[*ENTRY, "scenario_id"]]
    counts = pd.concat([rows, rows.assign(dataset="overall")]).groupby(ENTRY)["scenario_id"].nunique()
    return cast(dict[tuple[str, str, str], int], counts.to_dict())


def _differences(
    metric: str, sides: Sequence[np.ndarray], observed: Sequence[Sequence[float]], scenarios: Sequence[int]
) -> list[dict[str, float]]:
    """Return the columns of n paired differences, each over its number of scenarios: interval and two-sided p.

    sides: the resampled ends of the left and the right, (n, 2, resamples) each. If every resample is NaN, there is no
    p.
    """
    ends, apart = difference(*sides), np.asarray(observed[0]) - np.asarray(observed[1])
    minimum, maximum = limits_of(metric)
    bounds = interval(ends, apart, (minimum - maximum, maximum - minimum))
    rows = []
    for size, value, bound, (lower, upper) in zip(scenarios, apart, bounds, ends, strict=True):
        row = {"n_scenarios": size, "difference": value, "ci_low": bound[0], "ci_high": bound[1]}
        low, high = lower[~np.isnan(lower)], upper[~np.isnan(upper)]
        if len(low) and len(high):
            row["p"] = min(1.0, max(2 * min(_tail_share(low), _tail_share(-high)), least_p(size)))
        rows.append(row)
    return rows


def _tail_share(ends: np.ndarray) -> float:
    """Return the share of ends at 0 or below, one added to their count.

    This is never below 1 / (resamples + 1), so no contrast of many models could be significant after Holm's correction.
    Therefore, if no end lies there, it is the tail of a normal distribution with the mean and standard error of the
    ends, if that is smaller.
    """
    n_beyond = int((ends <= 0).sum())
    share = (n_beyond + 1) / (len(ends) + 1)
    if n_beyond:
        return share
    error = float(ends.std())
    return min(share, erfc(float(ends.mean()) / error / sqrt(2) if error else inf) / 2)


def _separable(table: pd.DataFrame, family: Sequence[str]) -> pd.Series:
    """Return whether p_holm is below SEPARABLE_BELOW.

    Null if so few scenarios cannot make the smallest p of the family that small, and False if there is no p.
    """
    n_compared = table.groupby(list(family))["p"].transform("count").to_numpy(float)
    smallest_p = np.array([least_p(int(n)) if n == n else 0.0 for n in table["n_scenarios"].astype(float)])
    separable = pd.Series(table["p_holm"].astype(float) < SEPARABLE_BELOW, dtype="boolean")
    return separable.mask(table["p"].notna() & (smallest_p * n_compared >= SEPARABLE_BELOW))


def _holm_by(table: pd.DataFrame, family: Sequence[str]) -> np.ndarray:
    corrected = np.full(len(table), np.nan)
    for rows in table.groupby(list(family)).indices.values():
        corrected[rows] = holm(table["p"].to_numpy(float)[rows])
    return corrected
