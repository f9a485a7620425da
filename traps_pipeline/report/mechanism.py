"""The paper's mechanistic numbers in the columns of a study's own tables (`assets/published`)."""

from __future__ import annotations

import pandas as pd

from traps_pipeline.mechanism.effects import REGIME_COLUMNS
from traps_pipeline.mechanism.tables import COSINES, PROBES, STEERING_EFFECTS
from traps_pipeline.partitions import LONG
from traps_pipeline.scoring.published import published
from traps_pipeline.storage.tables import Table

PAIRS, CENTROID_LAYER = 50, 32  # docs/spec.md 8.2 and 7.5
STEERED_LAYERS = {"qwen3-vl-8b": 20, "gemma-4-e4b": 35, "llava-next-video-7b": 28}
NOT_STATED = "not stated"
_FLAGS = ("own_best", "all_sample_best", "source_best")


def published_probes() -> pd.DataFrame:
    """PROBES rows: transfer, confabulated (at the layer of the transfer value, since the paper names no other),
    shuffled (without a dataset) and centroid_void (without a source)."""
    rows = _long(published("probe_transfer")).rename(columns={"best_layer": "layer"})
    transfer = rows.assign(analysis="transfer", value=rows["auroc"], own_best=True, all_sample_best=True)
    confabulated = rows.assign(analysis="confabulated", value=rows["auroc_confabulated"], all_sample_best=True)
    other_figures = published("other")
    other_figures["value"] = pd.to_numeric(other_figures["value"], errors="coerce")
    shuffled = other_figures.loc[other_figures["id"].str.startswith("shuffle-")].assign(analysis="shuffled")
    catch = other_figures.loc[other_figures["id"].str.startswith("catch-")].assign(
        analysis="centroid_void", layer=CENTROID_LAYER
    )
    catch = catch.assign(scope="sub_scenario:" + catch["id"].str.removeprefix("catch-"), value=catch["value"] / 100)
    table = _as(PROBES, [transfer, confabulated, shuffled, catch])
    return table.assign(**{flag: table[flag].eq(True) for flag in _FLAGS})


def published_cosines() -> pd.DataFrame:
    """COSINES rows: the matrix of qwen3-vl-8b, and the few values of the other two models in the paper's text."""
    matrix = published("cosine_qwen").assign(model="qwen3-vl-8b")
    other_figures = published("other")
    other_figures = other_figures.loc[other_figures["id"].str.match("cos-(gemma|llava)-")].reset_index(drop=True)
    pairs = other_figures["id"].str.split("-", n=2).str[2].str.split("-", expand=True)
    few = other_figures.assign(source=pairs[0], other=pairs[1], cosine=other_figures["value"].astype(float))
    mirrored = few.rename(columns={"source": "other", "other": "source"})
    both = pd.concat([matrix, few, mirrored], ignore_index=True)
    both = _long(both).rename(columns={"source": "dataset", "other": "other_dataset"})
    return _as(COSINES, [both.assign(layer=_steered(both), prompt="standard", other_prompt="standard")])


def published_effects() -> pd.DataFrame:
    """STEERING_EFFECTS rows of the dose-response tables. The paper states no regimes for gemma-4-e4b."""
    qwen = published("steering_dose_qwen").assign(
        model="qwen3-vl-8b", directions="standard", regime="guided", epoch="original"
    )
    gemma = published("steering_dose_gemma").assign(
        model="gemma-4-e4b", directions=NOT_STATED, regime=NOT_STATED, epoch="verification"
    )
    rows = _long(pd.concat([qwen, gemma], ignore_index=True))
    rows = rows.assign(kind="void", unit="alpha", dose=rows["alpha"], signs="label", n=PAIRS, layer=_steered(rows))
    sides = [rows.assign(side=s, abstention=rows[f"{s}_abstention_pct"] / 100) for s in ("control", "void")]
    return _as(STEERING_EFFECTS, sides)


def published_regimes() -> pd.DataFrame:
    """Rows of `regime_matrix` (family all) and of `family_asymmetry`, as printed."""
    rows = published("steering_regime")
    names = {"direction_regime": "directions", "inference_regime": "regime", "direction_family": "family"}
    shares = {
        f"{side}_{end}": rows[f"{side}_{alpha}"] / 100
        for side in ("control", "void")
        for end, alpha in (("0", "alpha0"), ("top", "alpha10"))
    }
    table = rows.rename(columns=names).replace({"family": LONG}).assign(**shares, kind="void", alpha=10.0)
    return table.reindex(columns=pd.Index(REGIME_COLUMNS)).assign(epoch="original")


def published_domains(recomputed: pd.DataFrame) -> pd.DataFrame:
    """Rows of `effects.domains`, with the two same-domain figures of qwen3-vl-8b from the paper's text, marked."""
    other_figures = published("other").set_index("id")["value"]
    same = {LONG[short]: float(str(other_figures[f"same-{short}"]).split(" / ")[0]) / 100 for short in ("ch", "oc")}
    chosen = (recomputed["model"] == "qwen3-vl-8b") & recomputed["source"].isin([*same])
    values = [same.get(source, float("nan")) for source in recomputed["source"]]
    return recomputed.assign(same=recomputed["same"].mask(chosen, values), mark=chosen.map(lambda m: "*" if m else ""))


def published_layers() -> pd.DataFrame:
    """Rows of `effects.sweep`: gemma-4-e4b at three layers, alpha 0 and 10, regimes not stated."""
    other_figures = published("other")
    other_figures = other_figures.loc[other_figures["id"].str.fullmatch(r"depth-gemma-\d+")]
    rows = [
        {"model": model, "layer": int(name.rsplit("-", 1)[1]), "alpha": alpha, "control": float(share) / 100}
        for name, model, value in zip(other_figures["id"], other_figures["model"], other_figures["value"], strict=True)
        for alpha, share in zip((0.0, 10.0), str(value).split(" to "), strict=True)
    ]
    return pd.DataFrame(rows).assign(directions=NOT_STATED, regime=NOT_STATED, n_splits=4)


def _long(rows: pd.DataFrame) -> pd.DataFrame:
    return rows.replace({name: LONG for name in ("source", "target", "other") if name in rows})


def _steered(rows: pd.DataFrame) -> list[int]:
    return [STEERED_LAYERS[model] for model in rows["model"]]


def _as(table: Table, parts: list[pd.DataFrame]) -> pd.DataFrame:
    return pd.concat(parts, ignore_index=True).reindex(columns=pd.Index(table.names))
