"""Score decisions on two events: everything right, and what makes a model abstain: the asked lane or the other one.

The effects are differences of shares. own: how much abstention rises when the asked lane alone is hidden, over the clip
in which neither is. other: how much it rises when the other lane alone is hidden. specific: own minus other. A reader
who looks where it is asked has 1, 0 and 1; one that knows the clip alone has specific 0, whatever it does.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pandas as pd

RESAMPLES, SEED, LEVEL = 10_000, 20260101, 0.95
CELLS = ("neither", "other", "asked", "both")  # which lane of a clip is hidden, as the question sees it


@dataclass(frozen=True)
class TwoWay:
    """Figures with the ends of their intervals over scenarios.

    all_right: share of scenarios of which all eight items are right. abstained: share abstained on, by `CELLS`.
    """

    scenarios: int
    abstained: dict[str, float]
    all_right: tuple[float, float, float]
    own: tuple[float, float, float]
    other: tuple[float, float, float]
    specific: tuple[float, float, float]


def two_way(items: pd.DataFrame) -> TwoWay:
    """Return the figures of decisions on all eight items of each scenario.

    items: scenario_id, asked_hidden, other_hidden, abstained (bool), correct (bool; counts where the asked lane is
    seen). Scenarios with fewer than eight items are left out.
    """
    whole = items[items.groupby("scenario_id")["abstained"].transform("size") == 8]
    cell = 2 * whole["asked_hidden"].astype(int) + whole["other_hidden"].astype(int)
    hidden, abstained, correct = (np.array(whole[name], bool) for name in ("asked_hidden", "abstained", "correct"))
    right = np.where(hidden, abstained, ~abstained & correct)
    cells = whole.assign(cell=cell, abstained=abstained.astype(float), right=right.astype(float))
    all_right = cells.pivot_table(values="right", index="scenario_id", aggfunc="min").to_numpy(float)[:, 0]
    shares = cells.pivot_table(values="abstained", index="scenario_id", columns="cell", aggfunc="mean")
    neither, other, asked, both = shares.to_numpy(float).T
    return TwoWay(
        scenarios=len(all_right),
        abstained=dict(zip(CELLS, (float(v.mean()) for v in (neither, other, asked, both)), strict=True)),
        all_right=_interval(all_right, 0.0),
        own=_interval(asked - neither, -1.0),
        other=_interval(other - neither, -1.0),
        specific=_interval(asked - other, -1.0),
    )


def _interval(values: np.ndarray, least: float) -> tuple[float, float, float]:
    """Return a mean, and the ends of its Bayesian bootstrap with one unseen scenario, the worst and the best."""
    weights = np.random.default_rng(SEED).standard_exponential((RESAMPLES, len(values) + 1))
    weights /= weights.sum(axis=1, keepdims=True)
    low, high = (weights @ np.append(values, unseen) for unseen in (least, 1.0))
    tail = (1 - LEVEL) / 2
    return float(values.mean()), float(np.quantile(low, tail)), float(np.quantile(high, 1 - tail))
