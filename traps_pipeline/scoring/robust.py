"""PECS-R: PECS once shortcuts are taken away, and the gap between the two (docs/scoring.md, "PECS-R and the gap").

A kind is a set of items that are all answerable, or all void, for one reason. The controls of the four datasets are one
kind, and their voids another; an arm adds one kind for each side that it has. Kinds have equal weight, so that a cue
that works only in the pairs, which have most items, does not give a high score.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, cast

import numpy as np
import pandas as pd

from traps_pipeline.protocol.datasets import (
    ANSWERABLE_ARMS,
    ARMS,
    DATASETS,
    PAIRED_ARMS,
    VOID_ARMS,
    datasets_of_category,
    is_ill_posed,
)
from traps_pipeline.scoring.bootstrap import (
    RESAMPLED,
    RESAMPLES,
    SEED,
    Drawn,
    difference,
    draw_scenarios,
    ends_of_pecs,
    figures_of,
    interval,
    run_sums,
)
from traps_pipeline.scoring.metrics import decision_counts, joined_epochs
from traps_pipeline.scoring.score_rows import ROBUST

TWIN = "twin_control"
VISUAL = tuple(dataset for dataset in DATASETS if not is_ill_posed(dataset))
WITH_CONTROLS, WITH_VOIDS = (*ANSWERABLE_ARMS, *PAIRED_ARMS), (*VOID_ARMS, *PAIRED_ARMS)
FIGURES = ("acc_r", "abs_rec_r", "false_abs_r", "pecs", "pecs_r", "gap")
INTERVALS = {"pecs_r": (0.0, 1.0), "gap": (-1.0, 1.0)}  # with the limits of each figure
_ITEM = ["model", "regime", "dataset", "run", "item_id", "scenario_id", "side", "epoch", "panel", "benchmark_version"]


def robust(verdicts: pd.DataFrame, resamples: int = RESAMPLES, seed: int = SEED) -> pd.DataFrame:
    """ROBUST rows from the VERDICTS rows of pairs and arms: one row per model and regime that has a run with all four
    datasets and an arm.

    Figures are computed per run, then averaged; a figure that is null in one run is null. If runs have different arms,
    the entry uses the runs with the most arms, all with the same ones (`arms`).
    """
    items = pd.concat([verdicts[_ITEM], decision_counts(verdicts)], axis=1)
    items["taxonomy"] = [datasets_of_category(category)[0] for category in verdicts["category"]]
    entries = {}
    for key, group in items.groupby(["model", "regime"], sort=True):
        runs, arms = _runs_and_arms(group)
        if runs:
            chosen = group["run"].isin(runs) & group["dataset"].isin([*DATASETS, *arms])
            entries[key] = arms, group.loc[chosen]
    if not entries:
        return pd.DataFrame(columns=pd.Index(ROBUST.names))
    # A scenario is drawn with its items in all datasets and arms.
    drawn = draw_scenarios(items, resamples, seed)
    rows = [
        {"model": model, "regime": regime, "arms": list(arms), **_row(group, f"{model}|{regime}", arms, drawn)}
        for (model, regime), (arms, group) in cast(Mapping[tuple[str, str], Any], entries).items()
    ]
    return pd.DataFrame(rows, columns=pd.Index(ROBUST.names))


def _runs_and_arms(group: pd.DataFrame) -> tuple[list[int], tuple[str, ...]]:
    """The runs of a model and regime that its entry uses, and the arms that each of them has: the largest set of arms.
    Among sets of the same size it is the one that most runs have, then the first in the order of ARMS."""
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


def _row(items: pd.DataFrame, named: str, arms: Sequence[str], drawn: Drawn) -> dict[str, Any]:
    """The columns of an entry's ROBUST row except model, regime and arms."""
    figures = {cell: figures_of(sums, in_mean=True) for cell, sums in run_sums(items, drawn, named).items()}
    runs = sorted({run for _, run in figures})
    by_run = np.stack([run_figures({d: figures[d, run] for d in (*DATASETS, *arms)}, arms) for run in runs])
    twins = [_twins(items.loc[items["run"] == run]) for run in runs] if TWIN in arms else []
    observed = by_run[:, 1, :, 0]  # (runs, FIGURES)
    gap, pecs, pecs_r = (FIGURES.index(name) for name in ("gap", "pecs", "pecs_r"))
    observed[:, gap] = observed[:, pecs] - observed[:, pecs_r]
    row: dict[str, Any] = {
        "n_runs": len(runs),
        "n_items": max(rows["item_id"].nunique() for _, rows in items.groupby("run")),
        "n_missing": _missing(items),
        "epoch": joined_epochs(items["epoch"]),
        "panel": joined_epochs(items["panel"]),
        "benchmark_version": " + ".join(sorted(set(items["benchmark_version"]))),
        "refused": _refusal(items),
        "n_twins": max((n for _, n in twins), default=0),
    }
    row |= dict(zip(FIGURES, observed.mean(axis=0), strict=True))
    row |= {f"{name}_std": value for name, value in zip(FIGURES, observed.std(axis=0), strict=True)}
    shares = [share for share, _ in twins]
    row |= {"twin_accuracy": None, "twin_accuracy_std": None}
    if shares:
        row |= {"twin_accuracy": np.mean(shares), "twin_accuracy_std": np.std(shares)}
    ends = by_run.mean(axis=0)[..., 1:]
    for name, limits in INTERVALS.items():
        bounds = interval(ends[:, FIGURES.index(name)], row[name], limits)
        row |= dict(zip((f"{name}_ci_low", f"{name}_ci_high"), bounds, strict=True))
    if row["refused"]:
        row |= {name: None for name in row if name.startswith("gap")}
    return row


def run_figures(cells: Mapping[str, np.ndarray], arms: Sequence[str]) -> np.ndarray:
    """The ends of FIGURES of one run, (2, FIGURES, draws), from those of RESAMPLED, (2, RESAMPLED, draws), of its
    datasets and arms."""

    def mean_over_kinds(figure: str, of: Sequence[str]) -> np.ndarray:
        at = RESAMPLED.index(figure)
        return np.mean([pairs[:, at], *(cells[arm][:, at] for arm in arms if arm in of)], axis=0)

    pairs = np.mean([cells[dataset] for dataset in DATASETS], axis=0)
    acc, false_abs = (mean_over_kinds(figure, WITH_CONTROLS) for figure in ("acc", "false_abs"))
    abs_rec, pecs = mean_over_kinds("abs_rec", WITH_VOIDS), pairs[:, RESAMPLED.index("pecs")]
    pecs_r = ends_of_pecs(acc, difference(abs_rec, false_abs))
    return np.stack([acc, abs_rec, false_abs, pecs, pecs_r, difference(pecs, pecs_r)], axis=1)


def _twins(items: pd.DataFrame) -> tuple[float, int]:
    """In one run, among the scenarios in which control and twin control are both decided: the share in which both are
    correct (NaN if there is none), and their number."""
    controls = items.loc[(items["side"] == "control") & items["correct_of"].eq(1)].set_index("scenario_id")
    own = controls.loc[controls["dataset"].isin(VISUAL), "correct"]
    twin = controls.loc[controls["dataset"] == TWIN, "correct"]
    worlds = pd.concat([own, twin], axis=1, join="inner").to_numpy(float)
    return (float(worlds.min(axis=1).mean()) if len(worlds) else float("nan")), len(worlds)


def _missing(items: pd.DataFrame) -> int:
    """The number of items, over runs, that lack a decision of their side."""
    control = items["side"] == "control"
    decided = np.where(control, items["correct_of"] & items["false_abs_of"], items["abs_rec_of"])
    return int(len(items) - decided.sum())


def _refusal(items: pd.DataFrame) -> str | None:
    """Why there is no gap between pairs and arms: they were answered in different campaigns (docs/spec.md 9.2), or
    judged by different panels."""
    of_arms = items["dataset"].isin(ARMS)
    if "+" in (panels := joined_epochs(items["panel"])):
        return f"judged by {panels.replace('+', ' and ')}; figures of different panels are never put in one gap"
    pairs, arms = (joined_epochs(items.loc[chosen, "epoch"]) for chosen in (~of_arms, of_arms))
    if pairs == arms and "+" not in pairs:
        return None
    return f"pairs of epoch {pairs}, arms of epoch {arms}; figures of different epochs are never put in one gap"


def wrong_rows(table: pd.DataFrame) -> int:
    """How many ROBUST rows break their definition: a PECS-R or share outside [0, 1], an interval out of order, a gap
    that is not PECS - PECS-R. Null is not wrong."""
    shares = table[["acc_r", "abs_rec_r", "false_abs_r", "pecs_r", "twin_accuracy"]].to_numpy(float)
    wrong = ((shares < 0) | (shares > 1)).any(axis=1)
    for name in INTERVALS:
        low, high = (table[f"{name}_ci_{end}"].to_numpy(float) for end in ("low", "high"))
        wrong |= (low > high) | (low < (0 if name == "pecs_r" else -1)) | (high > 1)
    pecs, pecs_r, gap = (table[name].to_numpy(float) for name in ("pecs", "pecs_r", "gap"))
    return int((wrong | (np.abs(gap - (pecs - pecs_r)) > 1e-12)).sum())
