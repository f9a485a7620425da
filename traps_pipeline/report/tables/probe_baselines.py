"""What stands beside the figures of a probe: the best of the raw inputs, the output margin and the floor of noise."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from traps_pipeline.report.result_frames import Results
from traps_pipeline.report.writing import Column

if TYPE_CHECKING:
    from collections.abc import Mapping

    import pandas as pd

SHORTCUTS = ("question words", "first frame", "all frames", "length", "time stamps")
KEYS = ["model", "source", "target"]
AT = ["model", "prompt", "analysis", "source", "target"]
NO_RAW = "none above .5"
BESIDE = ("raw", "raw_value", "margin", "noise", "noise_spread")
NOTES = (
    "best raw input: the one of question words, first frame, all frames, length and time stamps with the highest "
    "AUROC, by the same protocol; output margin: log-odds that the first answer token begins an abstention; noise: "
    "random vectors as wide as states, mean ± deviation over draws",
    "a probe says nothing about understanding where a raw input is as high, and nothing about a gap between states and "
    "output where the margin is",
)


def by_features(results: Results) -> pd.DataFrame:
    """Return a row per AT of `probe_baselines`: the value of each of its features, and noise_spread."""
    import pandas as pd

    rows = results.baselines
    wide = rows.pivot_table(index=AT, columns="features", values="value", observed=True)
    wide = wide.reindex(columns=pd.Index([*SHORTCUTS, "output margin", "noise", *other_probes(results)]))
    spread = rows.loc[rows["features"] == "noise"].set_index(AT)["spread"]
    return wide.join(spread.rename("noise_spread")).reset_index().astype(dict.fromkeys(AT, object))


def other_probes(results: Results) -> list[str]:
    """Return the further probes of the states that experiments name, as features of `probe_baselines`."""
    return [*dict.fromkeys(name for name in results.baselines["features"] if str(name).startswith("states, "))]


def against(results: Results, analysis: str) -> pd.DataFrame:
    """Return BESIDE of each model, source and target under an analysis: best raw input, output margin and noise."""
    import pandas as pd

    rows = by_features(results)
    rows = rows.loc[rows["analysis"] == analysis].set_index(KEYS)
    raw = rows[[*SHORTCUTS]].astype(float)
    best = [best_name(row) for row in raw.to_dict("records")]
    own = rows[["output margin", "noise", "noise_spread"]].rename(columns={"output margin": "margin"})
    return pd.DataFrame({"raw": best, "raw_value": raw.max(axis=1)}, index=rows.index).join(own)


def best_name(values: Mapping[Any, float]) -> str:
    """Return the feature with the highest AUROC; NO_RAW where none is above chance, empty where there is none."""
    known = {str(name): value for name, value in values.items() if value == value}
    best = max(known, key=lambda name: known[name], default="")
    return NO_RAW if best and known[best] <= 0.5 else best


def columns(results: Results, prefix: str = "", head: str = "") -> list[Column]:
    """Return the columns of BESIDE; none for the paper, which has no baselines."""
    if not results.is_study:
        return []
    return [
        Column(f"{prefix}raw", f"{head}Best raw input"), Column(f"{prefix}raw_value", f"{head}its AUROC", "fraction"),
        Column(f"{prefix}margin", f"{head}Output margin", "fraction"),
        Column(f"{prefix}noise", f"{head}Noise", "fraction", spread=f"{prefix}noise_spread"),
    ]  # fmt: skip


def notes(results: Results) -> list[str]:
    """Return what the columns of BESIDE are; nothing of the paper, which has none."""
    return [*NOTES] if results.is_study else []
