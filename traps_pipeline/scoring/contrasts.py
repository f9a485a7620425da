"""Paired comparisons: model against model, regime against regime (benchmark.md section 5), with Holm's correction.

Two entries of the leaderboard share their resamples (`bootstrap`), so the difference of their draws is that of a paired
design, with whatever the scenarios have in common taken out. McNemar's test compares two regimes item by item. Across
epochs nothing is compared (`epochs`): the row says why and holds no figure.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import combinations

import numpy as np
import pandas as pd

from traps_pipeline.errors import TrapsError
from traps_pipeline.partitions import DATASETS, REGIMES
from traps_pipeline.scoring import Frame
from traps_pipeline.scoring.bootstrap import RESAMPLES, Resampled, percentiles, resample
from traps_pipeline.scoring.epochs import require_one_epoch
from traps_pipeline.scoring.leaderboard import means_over_runs
from traps_pipeline.scoring.metrics import cell_metrics, joined_epochs
from traps_pipeline.tables import CONTRASTS, REGIME_TESTS

FIGURES = ("pecs", "j")
SEPARABLE_BELOW = 0.05
_FAMILY = ["kind", "dataset", "figure", "_regime"]
_SIDES = ["left_model", "left_regime", "right_model", "right_regime"]
_Side = tuple[str, str]  # model, regime


def contrasts(resampled: Resampled, metrics: Frame) -> Frame:
    """CONTRASTS rows from the bootstrap and the METRICS rows that it resamples (for their figures and epochs).

    Every pair of models under each regime, every pair of regimes of each model; PECS and J; each dataset and overall.
    """
    places = {entry: row for row, entry in enumerate(resampled.entries)}
    epochs = _epochs(metrics)
    means = means_over_runs(metrics)[list(FIGURES)].to_dict("index")
    rows = []
    for kind, dataset, left, right in _pairs(resampled.entries):
        refused = refusal(epochs, left, right, dataset)
        for figure in FIGURES:
            row = {"kind": kind, "dataset": dataset, "figure": figure, "_regime": left[1] if kind == "models" else ""}
            row |= dict(zip(_SIDES, (*left, *right), strict=True)) | {"refused": refused}
            if refused is None:
                draws = [resampled.figure(figure)[places[(*side, dataset)]] for side in (left, right)]
                observed = [means.get((*side, dataset), {}).get(figure, np.nan) for side in (left, right)]
                row |= _difference(draws[0] - draws[1], observed[0] - observed[1])
            rows.append(row)
    table = pd.DataFrame(rows, columns=pd.Index([*(c.name for c in CONTRASTS.columns), "_regime"]))
    table["p_holm"] = _holm_by(table, _FAMILY)
    table["separable"] = table["p_holm"].astype(float) < SEPARABLE_BELOW
    return table[[c.name for c in CONTRASTS.columns]]


def version_contrasts(then: Frame, now: Frame, resamples: int = RESAMPLES) -> Frame:
    """What changed between two studies, such as two versions of the benchmark: now minus then, on what both hold.

    then and now are VERDICTS rows; pairs and cells that only one of them has are left out. Columns model, regime,
    dataset, figure, n_pairs, then, now, difference, ci_low, ci_high, p, p_holm. Raises EpochMismatch where a model and
    regime was evaluated in different epochs on a dataset, TrapsError where the two share nothing.
    """
    key = ["dataset", "model", "regime", "run", "item_id"]
    common = then[[*key, "epoch"]].merge(now[[*key, "epoch"]], on=key, suffixes=(" then", " now"))
    if common.empty:
        raise TrapsError("the two studies share no verdict on the same item, model, regime and run")
    by_cell = common.groupby(["model", "dataset", "regime"])[["epoch then", "epoch now"]].agg(joined_epochs)
    require_one_epoch(by_cell, "versions")
    sides = [rows.merge(common[key], on=key) for rows in (then, now)]
    drawn = [resample(rows, resamples) for rows in sides]
    means = [
        means_over_runs(pd.concat([cell_metrics(part, {}) for _, part in rows.groupby("dataset")])) for rows in sides
    ]
    places = {entry: row for row, entry in enumerate(drawn[0].entries)}
    pairs = common.groupby(["model", "regime", "dataset"])["item_id"].nunique() // 2
    rows = []
    for row, entry in enumerate(drawn[1].entries):
        for figure in FIGURES:
            if entry not in places or entry not in means[1].index:
                continue
            before, after = (float(mean.loc[entry, figure]) for mean in means)
            found = dict(zip(["model", "regime", "dataset"], entry, strict=True), figure=figure, then=before, now=after)
            found["n_pairs"] = int(pairs.loc[entry[:2]].sum() if entry[2] == "overall" else pairs[entry])
            draws = drawn[1].figure(figure)[row] - drawn[0].figure(figure)[places[entry]]
            rows.append(found | _difference(draws, after - before))
    table = pd.DataFrame(rows)
    table["p_holm"] = _holm_by(table, ["dataset", "figure"])
    return table


def regime_tests(verdicts: Frame) -> Frame:
    """REGIME_TESTS rows: McNemar's exact test for every model, dataset, run, decision and pair of regimes."""
    from scipy.stats import binomtest

    rows = []
    for decision, side, column in (
        ("void_abstention", "void", "abstained"),
        ("control_abstention", "control", "abstained"),
        ("correctness", "control", "correct"),
    ):
        mine = verdicts[verdicts["side"] == side]
        for (dataset, model, run), group in mine.groupby(["dataset", "model", "run"], sort=True):
            said = group.pivot(index="item_id", columns="regime", values=column).astype("boolean")
            asked = group.groupby("regime")["epoch"].agg(joined_epochs)
            for left, right in combinations([r for r in REGIMES if r in said], 2):
                both = said[[left, right]].dropna().astype(bool)
                only_left, only_right = int((both[left] & ~both[right]).sum()), int((~both[left] & both[right]).sum())
                row = {"dataset": dataset, "model": model, "run": run, "decision": decision}
                row |= {"left_regime": left, "right_regime": right, "n": len(both)}
                row |= {"only_left": only_left, "only_right": only_right}
                row["refused"] = _mixed(asked[left], asked[right])
                if row["refused"] is None and len(both):
                    discordant = only_left + only_right
                    row["p"] = binomtest(only_left, discordant, 0.5).pvalue if discordant else 1.0
                rows.append(row)
    table = pd.DataFrame(rows, columns=pd.Index([c.name for c in REGIME_TESTS.columns]))
    table["p_holm"] = _holm_by(table, ["dataset", "decision", "left_regime", "right_regime"])
    return table


def holm(p: np.ndarray) -> np.ndarray:
    """Holm's step-down correction of (n,) p-values, NaN left out and left NaN."""
    corrected = np.full(len(p), np.nan)
    valid = np.flatnonzero(~np.isnan(p))
    order = valid[np.argsort(p[valid], kind="stable")]
    steps = p[order] * np.arange(len(order), 0, -1)
    corrected[order] = np.minimum(np.maximum.accumulate(steps), 1.0)
    return corrected


def refusal(epochs: dict[tuple[str, str, str], str], left: _Side, right: _Side, dataset: str) -> str | None:
    """Why two entries may not be compared on a dataset (or on all four, for `overall`); None if they may."""
    for name in DATASETS if dataset == "overall" else (dataset,):
        reason = _mixed(epochs.get((*left, name)), epochs.get((*right, name)))
        if reason:
            return f"{name}: {reason}"
    return None


def _mixed(left: str | None, right: str | None) -> str | None:
    if left == right:
        return None
    return f"epoch {left} against epoch {right}; figures of different epochs are never put in one contrast"


def _pairs(entries: Sequence[tuple[str, str, str]]) -> Iterator[tuple[str, str, _Side, _Side]]:
    """kind, dataset, left, right of every comparison, each once."""
    for dataset in (*DATASETS, "overall"):
        there = [(model, regime) for model, regime, name in entries if name == dataset]
        for left, right in combinations(there, 2):
            if left[1] == right[1]:
                yield "models", dataset, left, right
        for left, right in combinations(sorted(there, key=lambda side: (side[0], REGIMES.index(side[1]))), 2):
            if left[0] == right[0]:
                yield "regimes", dataset, left, right


def _difference(draws: np.ndarray, observed: float) -> dict[str, float]:
    """A paired difference with its interval and two-sided p from its resamples; nothing where these are null.

    p is twice the smaller share of resamples on one side of 0, each side counting 0 and one more: never 0 itself.
    """
    valid = draws[~np.isnan(draws)]
    if not len(valid):
        return {}
    low, high = percentiles(valid)
    tail = min(int((valid <= 0).sum()), int((valid >= 0).sum())) + 1
    return {"difference": observed, "ci_low": low, "ci_high": high, "p": min(1.0, 2 * tail / (len(valid) + 1))}


def _holm_by(table: Frame, family: Sequence[str]) -> np.ndarray:
    corrected = np.full(len(table), np.nan)
    for rows in table.groupby(list(family)).indices.values():
        corrected[rows] = holm(table["p"].to_numpy(float)[rows])
    return corrected


def _epochs(metrics: Frame) -> dict[tuple[str, str, str], str]:
    whole = metrics[metrics["scope"] == "all"].groupby(["model", "regime", "dataset"])["epoch"]
    return whole.agg(joined_epochs).to_dict()
