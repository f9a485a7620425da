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
NO_RAW = "none above .5"
BESIDE = ("raw", "raw_value", "margin", "noise", "noise_spread")
NOTES = (
    "best raw input: the one of question words, first frame, all frames, length and time stamps with the highest "
    "AUROC, by the same protocol; output margin: log-odds that the first answer token begins an abstention; noise: "
    "random vectors as wide as states, mean ± deviation over draws",
    "a probe says nothing about understanding where a raw input is as high, and nothing about a gap between states and "
    "output where the margin is",
)


def against(results: Results, analysis: str, prefix: str = "") -> pd.DataFrame:
    """One row per model, source and target: the best raw input (its name, its AUROC), the output margin and noise under
    an analysis of `probe_baselines`, as BESIDE with a prefix."""
    import pandas as pd

    rows = results.baselines
    rows = rows.loc[rows["analysis"] == analysis].astype(dict.fromkeys(KEYS, object))
    wide = rows.pivot_table(index=KEYS, columns="features", values="value", observed=True)
    wide = wide.reindex(columns=pd.Index([*SHORTCUTS, "output margin", "noise"]))
    raw = wide[[*SHORTCUTS]].astype(float)
    table = pd.DataFrame(
        {
            "raw": [best_name(row) for row in raw.to_dict("records")],
            "raw_value": raw.max(axis=1),
            "margin": wide["output margin"],
            "noise": wide["noise"],
        },
        index=wide.index,
    )
    spread = rows.loc[rows["features"] == "noise"].set_index(KEYS)["spread"]
    return table.join(spread.rename("noise_spread")).add_prefix(prefix).reset_index()


def best_name(values: Mapping[Any, float]) -> str:
    """The feature with the highest AUROC, the first of equals; NO_RAW where none is above chance, empty where there is
    none at all."""
    known = {str(name): value for name, value in values.items() if value == value}
    best = max(known, key=lambda name: known[name], default="")
    return NO_RAW if best and known[best] <= 0.5 else best


def columns(results: Results, prefix: str = "", head: str = "") -> list[Column]:
    """The columns of BESIDE; none for the paper, which has no baselines."""
    if not results.is_study:
        return []
    return [
        Column(f"{prefix}raw", f"{head}Best raw input"), Column(f"{prefix}raw_value", f"{head}its AUROC", "fraction"),
        Column(f"{prefix}margin", f"{head}Output margin", "fraction"),
        Column(f"{prefix}noise", f"{head}Noise", "fraction", spread=f"{prefix}noise_spread"),
    ]  # fmt: skip


def notes(results: Results) -> list[str]:
    """What the columns of BESIDE are; nothing of the paper, which has none."""
    return [*NOTES] if results.is_study else []
