"""Tell whether abstention follows the event that is asked about or the other one (docs/scoring.md, "Two events").

Each figure is a mean over scenarios, and so its interval is one over scenarios. Arms whose outcome must be inferred
stand beside it and enter none.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import pandas as pd

from traps_pipeline.protocol.datasets import INFERENCE_ARMS, TWO_EVENTS, datasets_of_category
from traps_pipeline.protocol.two_events import lane_item, lane_items
from traps_pipeline.scoring.bootstrap import RESAMPLES, SEED, Resampling, draw_scenarios, ends_of_mean, with_interval
from traps_pipeline.scoring.metrics import joined_epochs, joined_versions
from traps_pipeline.scoring.score_rows import TWO_WAY

LOWEST: Mapping[str, float] = {"conjunction": 0.0, "own_effect": -1.0, "other_effect": -1.0, "specificity": -1.0}
CELLS = ("abstains_neither", "abstains_other", "abstains_asked", "abstains_both")  # by the lanes that are hidden
SHARES = (*CELLS, "acc", "inference_acc", "inference_abstains")


def two_way(verdicts: pd.DataFrame, resamples: int = RESAMPLES, seed: int = SEED) -> pd.DataFrame:
    """Return TWO_WAY rows from VERDICTS rows of two events and of INFERENCE_ARMS.

    There is one row per model and regime. Figures are computed per run, then averaged; a figure that is null in one run
    is null.
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


def by_scenario(items: pd.DataFrame) -> pd.DataFrame:
    """Return LOWEST's figures and CELLS of each scenario of which one run asked all eight items, NaN where undecided.

    items: item_id, scenario_id, abstained and correct (1, 0 or NaN). A cell is the mean of what is decided in it, of a
    question about either lane. A scenario counts for the conjunction if all is decided, or something is wrong.
    """
    lanes = [lane_item(item_id) for item_id in items["item_id"]]
    hidden = np.array([lane.asked_hidden for lane in lanes], bool)
    cell = 2 * hidden + np.array([lane.other_hidden for lane in lanes], bool)
    answered_rightly = np.minimum(items["correct"], 1 - items["abstained"])  # NaN if either is
    right = items["abstained"].where(hidden, answered_rightly)
    decided = items.assign(cell=cell, right=right)[["scenario_id", "cell", "abstained", "right"]]
    sizes = decided.groupby("scenario_id")["right"].transform("size")
    decided = decided.loc[sizes == len(lane_items(""))]
    scenarios = decided.groupby("scenario_id")
    lowest, n_right = scenarios["right"].min(), scenarios["right"].count()
    shares = decided.groupby(["scenario_id", "cell"])["abstained"].mean().unstack().reindex(columns=range(len(CELLS)))
    table = shares.set_axis([*CELLS], axis=1)
    neither, other, asked = (table[name] for name in CELLS[:3])
    return table.assign(
        conjunction=lowest.where((lowest == 0) | (n_right == scenarios.size())),
        own_effect=asked - neither,
        other_effect=other - neither,
        specificity=asked - other,
    )


def _entry(items: pd.DataFrame, resampling: Resampling, named: str) -> dict[str, Any]:
    """Return the columns of an entry's TWO_WAY row except model and regime."""
    events, inferred = (items.loc[items["dataset"].eq(TWO_EVENTS) == of_events] for of_events in (True, False))
    main = events if len(events) else inferred
    runs = [rows for _, rows in events.groupby("run", sort=True)]
    tables = [by_scenario(rows) for rows in runs]
    undecided = events["abstained"].isna() | (events["side"].eq("control") & events["correct"].isna())
    refused = _refusal(main)
    row: dict[str, Any] = {
        "n_runs": main["run"].nunique(),
        "n_scenarios": max((len(table) for table in tables), default=0),
        "n_items": max((len(rows) for rows in runs), default=0),
        "n_missing": int(undecided.sum()),
        "epoch": joined_epochs(main["epoch"]),
        "panel": joined_epochs(main["panel"]),
        "benchmark_version": joined_versions(main["benchmark_version"]),
        "refused": refused,
    }
    for name, lowest in LOWEST.items():
        ends = [_ends(table[name], lowest, resampling, f"{named}|{name}") for table in tables]
        undefined = not ends or refused
        columns = with_interval(name, np.mean(ends, axis=0) if ends else np.full((2, 2), np.nan), (lowest, 1.0))
        row |= dict.fromkeys(columns) if undefined else columns
    controls = events.loc[events["side"] == "control"]
    row |= {name: None if refused else _mean([table[name].mean() for table in tables]) for name in CELLS}
    row["acc"] = None if refused else _mean(controls.groupby("run")["correct"].mean())
    for name, decision in (("inference_acc", "correct"), ("inference_abstains", "abstained")):
        row[name] = None if _refusal(items) else _mean(inferred.groupby("run")[decision].mean())
    return row


def _ends(values: pd.Series, lowest: float, resampling: Resampling, named: str) -> np.ndarray:
    """Return the ends (2, 1 + resamples) of the mean of values in [lowest, 1], one per scenario."""
    scaled = (values.dropna() - lowest) / (1 - lowest)
    return lowest + (1 - lowest) * ends_of_mean(scaled, resampling, named)


def _mean(values: Any) -> float | None:
    """Return the mean of runs; None without one, NaN where a run has none."""
    return float(np.mean(values)) if len(values) else None


def _refusal(items: pd.DataFrame) -> str | None:
    """Return why no figure may join these items (their epochs or panels differ), or None."""
    for kind in ("panel", "epoch"):
        names = joined_epochs(items[kind])
        if "+" in names:
            return f"of {kind}s {names.replace('+', ' and ')}; figures of different {kind}s are never put in one figure"
    return None


def wrong_rows(table: pd.DataFrame) -> int:
    """Return how many TWO_WAY rows have a figure outside its limits or its interval."""
    shares = table[[*SHARES]].to_numpy(float)
    is_wrong = ((shares < 0) | (shares > 1)).any(axis=1)
    for name, lowest in LOWEST.items():
        low, value, high = (table[f"{name}{end}"].to_numpy(float) for end in ("_ci_low", "", "_ci_high"))
        is_wrong |= (low > value) | (value > high) | (low < lowest) | (high > 1)
    return int(is_wrong.sum())
