"""Compute PECS of abstention that follows from clip and question together.

See docs/scoring.md, "Beyond PECS". The conjunction requires every decision about a scenario to be right. The robust
figure is PECS over kinds: sets of items that are all answerable, or all void, for one reason that can be seen. Arms
whose outcome must be inferred enter neither, nor do the ill-posed datasets, whose questions words alone give away.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, cast

import numpy as np
import pandas as pd

from traps_pipeline.protocol.datasets import (
    ARMS,
    CROSSED,
    DATASETS,
    INFERENCE_ARMS,
    ROBUST_ARMS,
    TWIN,
    datasets_of_category,
    is_ill_posed,
)
from traps_pipeline.protocol.metric_words import METRIC_WORDS
from traps_pipeline.scoring.bootstrap import (
    RESAMPLED_FIGURES,
    RESAMPLES,
    SEED,
    Resampling,
    draw_scenarios,
    ends_of_mean,
    figures_of,
    run_sums,
    with_interval,
)
from traps_pipeline.scoring.metrics import COUNTS, decision_counts, joined_epochs, joined_versions
from traps_pipeline.scoring.score_rows import ROBUST

VISUAL = tuple(dataset for dataset in DATASETS if not is_ill_posed(dataset))
CONJUNCTION = ("control", "void", f"{TWIN} control", f"{CROSSED} control", f"{CROSSED} void")  # items of one scenario
FULL_KIND = 30  # items; a kind with fewer weighs proportionally less
WITH_INTERVAL = ("robust", "conjunction")
_ITEM = ["model", "regime", "dataset", "run", "item_id", "scenario_id", "side", "epoch", "panel", "benchmark_version"]


def robust(verdicts: pd.DataFrame, resamples: int = RESAMPLES, seed: int = SEED) -> pd.DataFrame:
    """Return ROBUST rows from the VERDICTS rows of pairs and arms.

    There is one row per model and regime that has a run with all four datasets and an arm. Figures are computed per
    run, then averaged; a figure that is null in one run is null. If runs have different arms, the entry uses the runs
    with the most arms, all with the same ones (`arms`).
    """
    items = pd.concat([verdicts[_ITEM], decision_counts(verdicts)], axis=1)
    items["taxonomy"] = [datasets_of_category(category)[0] for category in verdicts["category"]]
    entries = {}
    for key, group in items.groupby(["model", "regime"], sort=True):
        runs, arms = _runs_and_arms(group)
        if runs:
            is_in_entry = group["run"].isin(runs) & group["dataset"].isin([*VISUAL, *arms])
            entries[key] = arms, group.loc[is_in_entry]
    if not entries:
        return pd.DataFrame(columns=pd.Index(ROBUST.names))
    # A scenario is drawn with its items in all datasets and arms.
    resampling = draw_scenarios(items, resamples, seed)
    rows = [
        {"model": model, "regime": regime, "arms": list(arms), **_row(group, f"{model}|{regime}", arms, resampling)}
        for (model, regime), (arms, group) in cast(Mapping[tuple[str, str], Any], entries).items()
    ]
    return pd.DataFrame(rows, columns=pd.Index(ROBUST.names))


def _runs_and_arms(group: pd.DataFrame) -> tuple[list[int], tuple[str, ...]]:
    """Return the largest set of arms of a model and regime, and the runs that have it.

    Among sets of the same size it is the one that most runs have, then the first in the order of ARMS.
    """
    sets: dict[tuple[str, ...], list[int]] = {}
    for run, rows in group.groupby("run", sort=True):
        datasets = {*rows["dataset"]}
        arms = tuple(arm for arm in ARMS if arm in datasets)
        if arms and datasets.issuperset(DATASETS):
            sets.setdefault(arms, []).append(cast(int, run))
    if not sets:
        return [], ()
    best = min(sets, key=lambda arms: (-len(arms), -len(sets[arms]), [ARMS.index(arm) for arm in arms]))
    return sets[best], best


def _row(items: pd.DataFrame, named: str, arms: Sequence[str], resampling: Resampling) -> dict[str, Any]:
    """Return the columns of an entry's ROBUST row except model, regime and arms."""
    runs = dict(list(items.groupby("run", sort=True)))
    sums = run_sums(items, resampling, named)
    kinds = (*VISUAL, *(arm for arm in arms if arm in ROBUST_ARMS))
    conjunctions = [_conjunction(rows, resampling, f"{named}|conjunction") for rows in runs.values()]
    figures = {
        "robust": [
            robust_ends(
                {kind: figures_of(sums[kind, cast(int, run)], in_mean=True) for kind in kinds},
                {kind: rows.loc[rows["dataset"] == kind, "scenario_id"].nunique() for kind in kinds},
            )
            for run, rows in runs.items()
        ],
        "conjunction": [ends for ends, _ in conjunctions],
    }
    row: dict[str, Any] = {
        "n_runs": len(runs),
        "n_items": max(rows["item_id"].nunique() for rows in runs.values()),
        "n_missing": _count_missing(items),
        "n_conjunction": max(n for _, n in conjunctions),
        "epoch": joined_epochs(items["epoch"]),
        "panel": joined_epochs(items["panel"]),
        "benchmark_version": joined_versions(items["benchmark_version"]),
        "refused": _refusal(items),
    }
    for name, run_values in figures.items():
        ends = np.mean(run_values, axis=0)
        # Without an unseen scenario both ends are the figure, the upper one with J clipped.
        columns = with_interval(name, ends, (0.0, 1.0))
        row |= dict.fromkeys(columns) if row["refused"] else columns
    inferred = items.loc[items["dataset"].isin(INFERENCE_ARMS)].groupby("run")[COUNTS].sum().reindex(list(runs))
    for name, count in (("inference_acc", "correct"), ("inference_abstains", "false_abs")):
        row[name] = (inferred[count] / inferred[f"{count}_of"].replace(0, np.nan)).mean(skipna=False)
    return row


def robust_ends(cells: Mapping[str, np.ndarray], scenarios: Mapping[str, int]) -> np.ndarray:
    """Return a run's ends of the robust score, (2, draws); NaN without robust arms.

    cells: the ends of RESAMPLED_FIGURES, (2, RESAMPLED_FIGURES, draws), of VISUAL and the robust arms.
    scenarios: the number of scenarios in each of them.
    """
    arms = {arm: min(1.0, scenarios[arm] / FULL_KIND) for arm in cells if arm in ROBUST_ARMS}
    pairs = np.mean([cells[dataset] for dataset in VISUAL], axis=0)

    def mean_over_kinds(figure: str, weights: Mapping[str, float]) -> np.ndarray:
        position = RESAMPLED_FIGURES.index(figure)
        kinds = [pairs[:, position], *(cells[arm][:, position] for arm in weights)]
        return np.average(kinds, axis=0, weights=[1.0, *weights.values()])

    acc, false_abs = (mean_over_kinds(figure, arms) for figure in ("acc", "false_abs"))
    abs_rec = mean_over_kinds("abs_rec", {arm: weight for arm, weight in arms.items() if arm == CROSSED})
    ends = np.stack(METRIC_WORDS["pecs"].ends(acc, false_abs, abs_rec))
    return ends if arms else np.full_like(ends, np.nan)


def conjunction_of(items: pd.DataFrame) -> pd.Series:
    """Return whether all decisions about a scenario are right, 1 or 0, by scenario.

    Scenarios were asked all of CONJUNCTION. items: VERDICTS rows of one run with COUNTS. NaN if a decision is missing
    and none is wrong.
    """
    control, dataset = items["side"].eq("control"), items["dataset"]
    right = items["correct"].where(control, items["abs_rec"]).astype(float)
    right = right.where(items["correct_of"].where(control, items["abs_rec_of"]) > 0)
    decision = items["side"].where(dataset.isin(VISUAL), dataset + " " + items["side"])
    decision_table = pd.DataFrame({"scenario": items["scenario_id"], "decision": decision, "right": right})
    decision_table = decision_table.loc[decision.isin(CONJUNCTION)]
    decisions = decision_table.groupby("scenario")["decision"].nunique()
    decision_table = decision_table.loc[decision_table["scenario"].isin(decisions.index[decisions == len(CONJUNCTION)])]
    lowest_decision, has_undecided = (
        decision_table.groupby("scenario")["right"].min(),
        decision_table["right"].isna().groupby(decision_table["scenario"]).any(),
    )
    return lowest_decision.where((lowest_decision == 0) | ~has_undecided)


def _conjunction(items: pd.DataFrame, resampling: Resampling, named: str) -> tuple[np.ndarray, int]:
    """Return the share of scenarios that `conjunction_of` finds right, with its ends.

    The number of decided scenarios follows.

    The ends are (2, draws).
    """
    decided_scenarios = conjunction_of(items).dropna()
    return ends_of_mean(decided_scenarios, resampling, named), len(decided_scenarios)


def _count_missing(items: pd.DataFrame) -> int:
    """Return the number of items, over runs, that lack a decision of their side."""
    control = items["side"] == "control"
    is_decided = np.where(control, items["correct_of"] & items["false_abs_of"], items["abs_rec_of"])
    return int(len(items) - is_decided.sum())


def _refusal(items: pd.DataFrame) -> str | None:
    """Return why no score may join pairs and arms (epochs or panels differ), or None."""
    is_arm = items["dataset"].isin(ARMS)
    if "+" in (panels := joined_epochs(items["panel"])):
        return f"judged by {panels.replace('+', ' and ')}; figures of different panels are never put in one figure"
    pairs, arms = (joined_epochs(items.loc[rows, "epoch"]) for rows in (~is_arm, is_arm))
    if pairs == arms and "+" not in pairs:
        return None
    return f"pairs of epoch {pairs}, arms of epoch {arms}; figures of different epochs are never put in one figure"


def wrong_rows(table: pd.DataFrame) -> int:
    """Return how many ROBUST rows have a score outside [0, 1] or its interval."""
    shares = table[[*WITH_INTERVAL, "inference_acc", "inference_abstains"]].to_numpy(float)
    is_wrong = ((shares < 0) | (shares > 1)).any(axis=1)
    for name in WITH_INTERVAL:
        low, value, high = (table[f"{name}{end}"].to_numpy(float) for end in ("_ci_low", "", "_ci_high"))
        is_wrong |= (low > value) | (value > high) | (low < 0) | (high > 1)
    return int(is_wrong.sum())
