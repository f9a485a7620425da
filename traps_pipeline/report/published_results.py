"""The paper's results, from `assets/published`, in the same frames as a study's results."""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np
import pandas as pd

from traps_pipeline.report.mechanism_page import published_cosines, published_effects, published_probes
from traps_pipeline.report.result_frames import CELL_COLUMNS, RATE_COLUMNS, SUB_COLUMNS, Makers, Results, joined
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
    """Return recomputed from the printed per-dataset cells."""
    cells = results.cells
    means = analyses.overall(cells).assign(j=lambda rows: rows["abs_rec"] - rows["false_abs"])
    counts = cells.groupby(["model", "regime"]).agg(
        n_pairs=("n_pairs", "sum"), n_runs=("n_runs", "min"), epoch=("epoch", joined_epochs)
    )
    return means.merge(counts.reset_index(), on=["model", "regime"]).assign(n_missing=np.nan, incomplete=False)


def _rates(results: Results) -> pd.DataFrame:
    """Return printed rates, their means over taxonomies, and the gaps of both."""
    rows = published("visual_vs_textual")
    parts = []
    for taxonomy in analyses.TAXONOMIES:
        names = {f"{taxonomy}_{kind}_pct": kind for kind in ("visual", "textual")}
        part = rows.loc[:, ["model", "epoch", *names]].rename(columns=names).assign(taxonomy=taxonomy)
        part[["visual", "textual"]] /= 100
        parts.append(part)
    means = {kind: (kind, "mean") for kind in ("visual", "textual")}
    pooled = joined(parts).groupby(["model", "epoch"], sort=False).agg(**means).reset_index()
    table = joined([*parts, pooled.assign(taxonomy="pooled")])
    table["gap"] = analyses.ratio(table["textual"], table["visual"])
    return table.reindex(columns=pd.Index(RATE_COLUMNS))


def _none(*columns: str) -> pd.DataFrame:
    """Return a frame without rows, where nothing follows from the paper's tables beyond what they print."""
    return pd.DataFrame(columns=pd.Index(columns))


def _sub_scenarios(results: Results) -> pd.DataFrame:
    occlusion, chaotic = published("occlusion_subscenarios"), published("chaotic_subscenarios")
    table = joined([occlusion.assign(dataset="occlusion"), chaotic.assign(dataset="chaotic")])
    table = table.rename(columns={"n": "n_pairs"})
    for name in [name for name in table if str(name).endswith("_pct")]:
        table[str(name).removesuffix("_pct")] = table[name] / 100
    table["abs_rec_uplift"] = table["guided_abs_rec"] - table["abs_rec"]
    table["guided_pecs"] = np.nan
    table["false_abs_uplift"] = table["guided_false_abs"] - table["false_abs"]
    table["textual_over_visual"] = analyses.ratio(table["abs_rec_ill_posed"], table["abs_rec"])
    return table.assign(epoch="original").reindex(columns=pd.Index(SUB_COLUMNS))


def _confabulation(results: Results) -> pd.DataFrame:
    rows = published("confabulation_taxonomy")
    shares: dict[str, Any] = {axis: rows[f"{axis}_pct"] / 100 for axis in _AXES}
    return rows[["model", "n"]].assign(**shares, epoch="original")


class PublishedResults(Results):
    """The paper's numbers, as shipped in `assets/published`, from which figures are drawn and further tables computed.

    `report.printed_tables` shows those that the paper prints. A frame from which neither is made has no rows.
    """

    source = "published"
    makers: ClassVar[Makers] = {
        "cells": _cells,
        "overall": _overall,
        "rates": _rates,
        "sub_cells": lambda results: _none("model", "dataset", "regime", "scope", "abs_rec", "n_pairs"),
        "sub_scenarios": _sub_scenarios,
        "labels": lambda results: _none("dataset", "sub_scenario", "label", "acc"),
        "confabulation": _confabulation,
        "composition": lambda results: _none("taxonomy", "category", "void", "n", "n_ill_posed"),
        "probes": lambda results: published_probes(),
        "cosines": lambda results: published_cosines(),
        "effects": lambda results: published_effects(),
    }
