"""Read the paper's results (`assets/published`) in the same frames as a study's."""

from functools import cached_property
from typing import Any

import numpy as np
import pandas as pd

from traps_pipeline.mechanism.mechanism_rows import COSINES, PROBES, STEERING_EFFECTS
from traps_pipeline.protocol.datasets import LONG
from traps_pipeline.report.result_frames import CELL_COLUMNS, RATE_COLUMNS, SUB_COLUMNS, Results, concat_frames
from traps_pipeline.scoring import analyses
from traps_pipeline.scoring.metrics import joined_epochs
from traps_pipeline.scoring.published import published, published_cells
from traps_pipeline.storage.tables import Table

PAIRS = 50  # a cell (docs/spec.md 8.2)
STEERED_LAYERS = {"qwen3-vl-8b": 20, "gemma-4-e4b": 35, "llava-next-video-7b": 28}
_FLAGS = ("own_best", "all_sample_best", "chosen")
_AXES = ("hp", "ii", "hp_and_ii", "es", "doubt")


def _cells(results: Results) -> pd.DataFrame:
    cells = concat_frames([published_cells()])
    # A spread is printed where there were three runs, even if the model has fewer runs in other cells.
    cells["n_runs"] = np.where(cells["acc_std"].isna(), 1, 3)
    return cells.assign(n_missing=np.nan, incomplete=False).reindex(columns=pd.Index(CELL_COLUMNS))


def _overall(results: Results) -> pd.DataFrame:
    """Return the overall rows, recomputed from the printed per-dataset cells."""
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
    pooled_rates = concat_frames(parts).groupby(["model", "epoch"], sort=False).agg(**means).reset_index()
    table = concat_frames([*parts, pooled_rates.assign(taxonomy="pooled")])
    table["gap"] = analyses.divide_elementwise(table["textual"], table["visual"])
    return table.reindex(columns=pd.Index(RATE_COLUMNS))


def _sub_scenarios(results: Results) -> pd.DataFrame:
    occlusion, chaotic = published("occlusion_subscenarios"), published("chaotic_subscenarios")
    table = concat_frames([occlusion.assign(dataset="occlusion"), chaotic.assign(dataset="chaotic")])
    table = table.rename(columns={"n": "n_pairs"})
    for name in [name for name in table if str(name).endswith("_pct")]:
        table[str(name).removesuffix("_pct")] = table[name] / 100
    table["abs_rec_uplift"] = table["guided_abs_rec"] - table["abs_rec"]
    table["guided_pecs"] = np.nan
    table["false_abs_uplift"] = table["guided_false_abs"] - table["false_abs"]
    table["textual_over_visual"] = analyses.divide_elementwise(table["abs_rec_ill_posed"], table["abs_rec"])
    return table.assign(epoch="original").reindex(columns=pd.Index(SUB_COLUMNS))


def _confabulation(results: Results) -> pd.DataFrame:
    rows = published("confabulation_taxonomy")
    shares: dict[str, Any] = {axis: rows[f"{axis}_pct"] / 100 for axis in _AXES}
    return rows[["model", "n"]].assign(**shares, epoch="original")


def _probes(results: Results) -> pd.DataFrame:
    """Return PROBES rows: transfer, and confabulated at the layer of transfer. The paper names no other layer."""
    rows = _long(published("probe_transfer")).rename(columns={"best_layer": "layer"}).assign(scope="all")
    transfer = rows.assign(analysis="transfer", value=rows["auroc"], own_best=True, all_sample_best=True)
    confabulated = rows.assign(analysis="confabulated", value=rows["auroc_confabulated"], all_sample_best=True)
    table = _as(PROBES, [transfer, confabulated])
    return table.assign(**{flag: table[flag].eq(True) for flag in _FLAGS})


def _cosines(results: Results) -> pd.DataFrame:
    """Return COSINES rows: qwen3-vl-8b's matrix, and other models' values in the text."""
    matrix = published("cosine_qwen").assign(model="qwen3-vl-8b")
    other_numbers = published("other")
    other_numbers = other_numbers.loc[other_numbers["id"].str.fullmatch(r"cos-(gemma|llava)-\w+-\w+")]
    pairs = other_numbers["id"].str.split("-", n=2).str[2].str.split("-", expand=True)
    other_numbers = other_numbers.assign(source=pairs[0], other=pairs[1], cosine=other_numbers["value"].astype(float))
    mirrored_rows = other_numbers.rename(columns={"source": "other", "other": "source"})
    all_cosines = pd.concat([matrix, other_numbers, mirrored_rows], ignore_index=True)
    all_cosines = _long(all_cosines).rename(columns={"source": "dataset", "other": "other_dataset"})
    return _as(
        COSINES, [all_cosines.assign(layer=_steered_layers(all_cosines), prompt="standard", other_prompt="standard")]
    )


def _effects(results: Results) -> pd.DataFrame:
    """Return STEERING_EFFECTS of dose-response tables, with their captions' regimes."""
    qwen = published("steering_dose_qwen").assign(model="qwen3-vl-8b", epoch="original")
    gemma = published("steering_dose_gemma").assign(model="gemma-4-e4b", epoch="verification")
    rows = _long(pd.concat([qwen, gemma], ignore_index=True))
    rows = rows.rename(columns={"direction_regime": "directions", "inference_regime": "regime"})
    rows = rows.assign(
        kind="void", unit="alpha", dose=rows["alpha"], signs="label", n=PAIRS, layer=_steered_layers(rows)
    )
    sides = [rows.assign(side=s, abstention=rows[f"{s}_abstention_pct"] / 100) for s in ("control", "void")]
    return _as(STEERING_EFFECTS, sides)


def _long(rows: pd.DataFrame) -> pd.DataFrame:
    return rows.replace({name: LONG for name in ("source", "target", "other") if name in rows})


def _steered_layers(rows: pd.DataFrame) -> list[int]:
    return [STEERED_LAYERS[model] for model in rows["model"]]


def _as(table: Table, parts: list[pd.DataFrame]) -> pd.DataFrame:
    return pd.concat(parts, ignore_index=True).reindex(columns=pd.Index(table.names))


class PublishedResults(Results):
    """The paper's numbers, as shipped in `assets/published`, for figures and tables.

    `report.printed_tables` shows the tables that the paper prints. A frame without such use has no rows.
    """

    source = "published"
    cells = cached_property(_cells)
    overall = cached_property(_overall)
    rates = cached_property(_rates)
    sub_scenarios = cached_property(_sub_scenarios)
    confabulation = cached_property(_confabulation)
    probes = cached_property(_probes)
    cosines = cached_property(_cosines)
    effects = cached_property(_effects)
