"""The paper's mechanistic numbers in the columns of a study's own tables (`assets/published`)."""

from __future__ import annotations

import pandas as pd

from traps_pipeline.mechanism.mechanism_rows import COSINES, PROBES, STEERING_EFFECTS
from traps_pipeline.protocol.datasets import LONG
from traps_pipeline.scoring.published import published
from traps_pipeline.storage.tables import Table

PAIRS = 50  # a cell (docs/spec.md 8.2)
STEERED_LAYERS = {"qwen3-vl-8b": 20, "gemma-4-e4b": 35, "llava-next-video-7b": 28}
_FLAGS = ("own_best", "all_sample_best", "chosen")


def published_probes() -> pd.DataFrame:
    """Return PROBES rows: transfer, and confabulated at the layer of transfer, as the paper names no other."""
    rows = _long(published("probe_transfer")).rename(columns={"best_layer": "layer"}).assign(scope="all")
    transfer = rows.assign(analysis="transfer", value=rows["auroc"], own_best=True, all_sample_best=True)
    confabulated = rows.assign(analysis="confabulated", value=rows["auroc_confabulated"], all_sample_best=True)
    table = _as(PROBES, [transfer, confabulated])
    return table.assign(**{flag: table[flag].eq(True) for flag in _FLAGS})


def published_cosines() -> pd.DataFrame:
    """Return COSINES rows: the matrix of qwen3-vl-8b, and the few values of other models in the paper's text."""
    matrix = published("cosine_qwen").assign(model="qwen3-vl-8b")
    other_figures = published("other")
    other_figures = other_figures.loc[other_figures["id"].str.fullmatch(r"cos-(gemma|llava)-\w+-\w+")].reset_index(
        drop=True
    )
    pairs = other_figures["id"].str.split("-", n=2).str[2].str.split("-", expand=True)
    few = other_figures.assign(source=pairs[0], other=pairs[1], cosine=other_figures["value"].astype(float))
    mirrored = few.rename(columns={"source": "other", "other": "source"})
    both = pd.concat([matrix, few, mirrored], ignore_index=True)
    both = _long(both).rename(columns={"source": "dataset", "other": "other_dataset"})
    return _as(COSINES, [both.assign(layer=_steered(both), prompt="standard", other_prompt="standard")])


def published_effects() -> pd.DataFrame:
    """Return STEERING_EFFECTS rows of the dose-response tables, with the regimes that their captions state."""
    qwen = published("steering_dose_qwen").assign(model="qwen3-vl-8b", epoch="original")
    gemma = published("steering_dose_gemma").assign(model="gemma-4-e4b", epoch="verification")
    rows = _long(pd.concat([qwen, gemma], ignore_index=True))
    rows = rows.rename(columns={"direction_regime": "directions", "inference_regime": "regime"})
    rows = rows.assign(kind="void", unit="alpha", dose=rows["alpha"], signs="label", n=PAIRS, layer=_steered(rows))
    sides = [rows.assign(side=s, abstention=rows[f"{s}_abstention_pct"] / 100) for s in ("control", "void")]
    return _as(STEERING_EFFECTS, sides)


def _long(rows: pd.DataFrame) -> pd.DataFrame:
    return rows.replace({name: LONG for name in ("source", "target", "other") if name in rows})


def _steered(rows: pd.DataFrame) -> list[int]:
    return [STEERED_LAYERS[model] for model in rows["model"]]


def _as(table: Table, parts: list[pd.DataFrame]) -> pd.DataFrame:
    return pd.concat(parts, ignore_index=True).reindex(columns=pd.Index(table.names))
