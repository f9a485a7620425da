"""The paper's results, from `assets/published`, in the same frames as a study's results."""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np
import pandas as pd

from traps_pipeline.judging.tables import AGREEMENT
from traps_pipeline.mechanism import effects
from traps_pipeline.report.mechanism import (
    published_cosines,
    published_domains,
    published_effects,
    published_layers,
    published_probes,
    published_regimes,
)
from traps_pipeline.report.results import CELL_COLUMNS, RATE_COLUMNS, SUB_COLUMNS, Makers, Results, joined
from traps_pipeline.scoring import analyses
from traps_pipeline.scoring.metrics import joined_epochs
from traps_pipeline.scoring.published import published, published_cells

_AXES = ("hp", "ii", "hp_and_ii", "es", "doubt")


def _cells(results: Results) -> pd.DataFrame:
    cells = joined([published_cells()])
    # A spread is printed where there were three runs, even if the model has fewer runs in other cells.
    cells["n_runs"] = np.where(cells["acc_std"].isna(), 1, 3)
    return cells.assign(n_missing=np.nan, incomplete=False).reindex(columns=pd.Index(CELL_COLUMNS))


def _overall(results: Results) -> pd.DataFrame:
    """Recomputed from the printed per-dataset cells."""
    cells = results.cells
    means = analyses.overall(cells).assign(j=lambda rows: rows["abs_rec"] - rows["false_abs"])
    counts = cells.groupby(["model", "regime"]).agg(
        n_pairs=("n_pairs", "sum"), n_runs=("n_runs", "min"), epoch=("epoch", joined_epochs)
    )
    return means.merge(counts.reset_index(), on=["model", "regime"]).assign(n_missing=np.nan, incomplete=False)


def _rates(results: Results) -> pd.DataFrame:
    """Gaps as printed (computed from unrounded rates); the pooled gaps are computed from the printed rates."""
    rows = published("visual_vs_textual")
    parts = []
    for taxonomy in analyses.TAXONOMIES:
        names = {f"{taxonomy}_{kind}_pct": kind for kind in ("visual", "textual")} | {f"{taxonomy}_gap": "gap"}
        part = rows.loc[:, ["model", *names]].rename(columns=names).assign(taxonomy=taxonomy)
        part[["visual", "textual"]] /= 100
        parts.append(part)
    means = {kind: (kind, "mean") for kind in ("visual", "textual")}
    pooled = joined(parts).groupby("model", sort=False).agg(**means).reset_index()
    pooled["gap"] = analyses.ratio(pooled["textual"], pooled["visual"])
    table = joined([*parts, pooled.assign(taxonomy="pooled")])
    table["gap"] = table["gap"].astype(float)
    replication = table["model"].isin(analyses.models_of(group="replication"))
    table["epoch"] = np.where(replication, "verification", "original")
    return table.reindex(columns=pd.Index(RATE_COLUMNS))


def _sub_cells(results: Results) -> pd.DataFrame:
    """A frame without rows, since the paper prints none."""
    return pd.DataFrame(columns=pd.Index(["model", "dataset", "regime", "scope", "abs_rec", "n_pairs"]))


def _sub_scenarios(results: Results) -> pd.DataFrame:
    occlusion, chaotic = published("occlusion_subscenarios"), published("chaotic_subscenarios")
    table = joined([occlusion.assign(dataset="occlusion"), chaotic.assign(dataset="chaotic")])
    table = table.rename(columns={"n": "n_pairs"})
    for name in [name for name in table if str(name).endswith("_pct")]:
        table[str(name).removesuffix("_pct")] = table[name] / 100
    table["abs_rec_uplift"] = table["guided_abs_rec"] - table["abs_rec"]
    table["textual_over_visual"] = analyses.ratio(table["abs_rec_ill_posed"], table["abs_rec"])
    return table.assign(epoch="original").reindex(columns=pd.Index(SUB_COLUMNS))


def _labels(results: Results) -> pd.DataFrame:
    """Values from the text of the paper, some of them approximate."""
    rows = published("other")
    rows = rows.loc[rows["id"].str.match("acc-(seesaw|dice)-")]
    labels = rows["id"].str.rsplit("-", n=1).str[1]
    return pd.DataFrame({"dataset": "chaotic", "label": labels, "acc": rows["value"].astype(float) / 100})


def _agreement(results: Results) -> pd.DataFrame:
    rows = published("judge_agreement")
    table = rows[["dataset", "task", "fleiss_kappa"]].assign(judges="panel", agreement=rows["unanimous_pct"] / 100)
    return table.reindex(columns=pd.Index(AGREEMENT.names)).assign(epoch="not stated")


def _confabulation(results: Results) -> pd.DataFrame:
    rows = published("confabulation_taxonomy")
    shares: dict[str, Any] = {axis: rows[f"{axis}_pct"] / 100 for axis in _AXES}
    return rows[["model", "n"]].assign(**shares, epoch="original")


def _validation(results: Results) -> pd.DataFrame:
    """100 failures, two annotators (docs/spec.md 6.3)."""
    rows = published("judge_validation").rename(columns={"category": "axis", "acc": "accuracy"})
    rows["human_agreement"] = rows["human_agree_pct"] / 100
    return rows.assign(n_failures=100, n_labels=200, epoch="original")


def _composition(results: Results) -> pd.DataFrame:
    """The ill-posed datasets reuse the same scenarios (`other.csv`)."""
    rows = published("composition").rename(columns={"void_source": "void"})
    return rows[["taxonomy", "category", "void", "n"]].assign(n_ill_posed=rows["n"])


def _steering_regimes(results: Results) -> pd.DataFrame:
    """The printed table."""
    rows = published_regimes()
    return rows.loc[rows["family"] == "all"].reset_index(drop=True)


def _steering_families(results: Results) -> pd.DataFrame:
    """The printed table."""
    rows = published_regimes()
    return rows.loc[rows["family"] != "all"].reset_index(drop=True)


def _steering_domains(results: Results) -> pd.DataFrame:
    """The printed figures, two of which are only in the paper's text."""
    return published_domains(effects.domains(results.effects))


class PublishedResults(Results):
    """The paper's numbers, as shipped in `assets/published`; a frame that the paper does not print has no rows."""

    source = "published"
    makers: ClassVar[Makers] = {
        "cells": _cells,
        "overall": _overall,
        "rates": _rates,
        "sub_cells": _sub_cells,
        "sub_scenarios": _sub_scenarios,
        "labels": _labels,
        "agreement": _agreement,
        "confabulation": _confabulation,
        "validation": _validation,
        "composition": _composition,
        "probes": lambda results: published_probes(),
        "cosines": lambda results: published_cosines(),
        "effects": lambda results: published_effects(),
        "steering_regimes": _steering_regimes,
        "steering_families": _steering_families,
        "steering_domains": _steering_domains,
        "steering_layers": lambda results: published_layers(),
    }
