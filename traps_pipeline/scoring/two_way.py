"""Tell whether abstention follows the event that is asked about or the other one (docs/scoring.md, "Two events").

Effects are differences of shares, with intervals over scenarios. Arms whose outcome must be inferred stand beside them
and enter none.
"""

from collections.abc import Mapping
from typing import Any, cast

import numpy as np
import pandas as pd

from traps_pipeline.protocol.datasets import INFERENCE_ARMS, TWO_EVENTS, datasets_of_category
from traps_pipeline.protocol.two_events import lane_item, lane_items
from traps_pipeline.scoring.bootstrap import (
    RESAMPLES,
    SEED,
    Resampling,
    difference,
    draw_scenarios,
    ends_of_shares,
    with_interval,
)
from traps_pipeline.scoring.metrics import joined_epochs, joined_versions
from traps_pipeline.scoring.score_rows import TWO_WAY

LOWEST: Mapping[str, float] = {"conjunction": 0.0, "own_effect": -1.0, "other_effect": -1.0, "specificity": -1.0}
CELLS = ("abstains_neither", "abstains_other", "abstains_asked", "abstains_both")  # by the lanes that are hidden
ENDS = ("", "_ci_low", "_ci_high")
SHARES = (*CELLS, "acc", "inference_acc", "inference_abstains")


def two_way(verdicts: pd.DataFrame, resamples: int = RESAMPLES, seed: int = SEED) -> pd.DataFrame:
    """Return TWO_WAY rows from VERDICTS rows of two events and of INFERENCE_ARMS.

    There is one row per model and regime. Metrics are computed per run, then averaged; a metric that is null in one run
    is null. A held-out study, which asks one item of a scenario, has effects and no conjunction.
    """
    items = verdicts.loc[verdicts["dataset"].isin([TWO_EVENTS, *INFERENCE_ARMS])]
    items = items.assign(
        taxonomy=[datasets_of_category(category)[0] for category in items["category"]],
        abstained=items["abstained"].astype("boolean").astype("Float64").to_numpy(float, na_value=np.nan),
        correct=items["correct"].astype("boolean").astype("Float64").to_numpy(float, na_value=np.nan),
    )
    resampling = draw_scenarios(items, resamples, seed)
    rows = [
        {"model": model, "regime": regime, **_entry(group, resampling, f"{model}|{regime}")}
        for (model, regime), group in items.groupby(["model", "regime"], sort=True)
    ]
    return pd.DataFrame(rows, columns=pd.Index(TWO_WAY.names))


def decisions(items: pd.DataFrame) -> pd.DataFrame:
    """Return by scenario how often each of CELLS and the conjunction was yes, and how often it was decided (`_of`).

    items: item_id, scenario_id, abstained, correct (1, 0 or NaN) of one run. The conjunction is decided where all eight
    were asked and decided, or one of them is wrong.
    """
    lanes = [lane_item(item_id) for item_id in items["item_id"]]
    hidden, other = (np.array([getattr(lane, f"{name}_hidden") for lane in lanes], bool) for name in ("asked", "other"))
    right = items["abstained"].where(hidden, np.minimum(items["correct"], 1 - items["abstained"]))  # NaN if either is
    columns = {}
    for cell, name in enumerate(CELLS):
        abstained = items["abstained"].where(2 * hidden + other == cell)
        columns |= {name: abstained.fillna(0), f"{name}_of": abstained.notna()}
    counts = cast(pd.DataFrame, pd.DataFrame(columns).astype(float).groupby(items["scenario_id"]).sum())
    scenarios: Any = right.groupby(items["scenario_id"])
    is_right = scenarios.min() > 0
    is_decided = (scenarios.size() == len(lane_items(""))) & (~is_right | (scenarios.count() == scenarios.size()))
    return counts.assign(conjunction=(is_right & is_decided).astype(float), conjunction_of=is_decided.astype(float))


def _ends(items: pd.DataFrame, resampling: Resampling, named: str) -> dict[str, np.ndarray]:
    """Return a run's ends, (2, 1 + resamples), of CELLS and LOWEST's metrics."""
    shares = np.moveaxis(ends_of_shares(decisions(items), resampling, named), 1, 0)
    neither, other, asked, *_ = shares
    effects = {name: difference(*pair) for name, pair in (
        ("own_effect", (asked, neither)), ("other_effect", (other, neither)), ("specificity", (asked, other))
    )}  # fmt: skip
    return dict(zip((*CELLS, "conjunction"), shares, strict=True)) | effects


def _entry(items: pd.DataFrame, resampling: Resampling, named: str) -> dict[str, Any]:
    """Return the columns of an entry's TWO_WAY row except model and regime."""
    events, inferred = (items.loc[items["dataset"].eq(TWO_EVENTS) == of_events] for of_events in (True, False))
    main = events if len(events) else inferred
    undecided = events["abstained"].isna() | (events["side"].eq("control") & events["correct"].isna())
    runs = [rows for _, rows in events.groupby("run", sort=True)]
    row: dict[str, Any] = {
        "n_runs": main["run"].nunique(),
        "n_scenarios": events["scenario_id"].nunique(),
        "n_items": events["item_id"].nunique(),
        "n_missing": int(undecided.sum()),
        "epoch": joined_epochs(main["epoch"]),
        "panel": joined_epochs(main["panel"]),
        "benchmark_version": joined_versions(main["benchmark_version"]),
        "refused": _refusal(main),
    }
    metrics: dict[str, Any] = dict.fromkeys((*SHARES, *(f"{name}{end}" for name in LOWEST for end in ENDS)))
    if runs and not row["refused"]:
        of_runs = [_ends(rows, resampling, named) for rows in runs]
        means = {name: np.mean([ends[name] for ends in of_runs], axis=0) for name in of_runs[0]}
        metrics |= {name: float(means[name][1, 0]) for name in CELLS}
        for name, lowest in LOWEST.items():
            metrics |= with_interval(name, means[name], (lowest, 1.0))
        metrics["acc"] = _mean_over_runs(events.loc[events["side"] == "control"], "correct")
    if len(inferred) and not _refusal(items):
        metrics["inference_acc"] = _mean_over_runs(inferred, "correct")
        metrics["inference_abstains"] = _mean_over_runs(inferred, "abstained")
    return row | metrics


def _mean_over_runs(items: pd.DataFrame, decision: str) -> float:
    return float(cast(Any, items.groupby("run")[decision].mean()).mean(skipna=False))


def _refusal(items: pd.DataFrame) -> str | None:
    """Return why no metric may join these items (their epochs or panels differ), or None."""
    for kind in ("panel", "epoch"):
        names = joined_epochs(items[kind])
        if "+" in names:
            return f"of {kind}s {names.replace('+', ' and ')}; metrics of different {kind}s are never joined"
    return None


def wrong_rows(table: pd.DataFrame) -> int:
    """Return the number of TWO_WAY rows with a metric outside its limits or its interval."""
    shares = table[[*SHARES]].to_numpy(float)
    is_wrong = ((shares < 0) | (shares > 1)).any(axis=1)
    for name, lowest in LOWEST.items():
        value, low, high = (table[f"{name}{end}"].to_numpy(float) for end in ENDS)
        is_wrong |= (low > value) | (value > high) | (low < lowest) | (high > 1)
    return int(is_wrong.sum())
