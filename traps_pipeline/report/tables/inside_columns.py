"""Share columns, marks, notes and probe baselines of mechanistic tables.

The baselines are the best of the raw inputs, the output margin and the floor of noise.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any

from traps_pipeline.mechanism.transfer_paths import path_name
from traps_pipeline.protocol.datasets import SHORT
from traps_pipeline.report.result_frames import Results
from traps_pipeline.report.writing import Column

if TYPE_CHECKING:
    import pandas as pd

PATH, TYPE = Column("path", "Path"), Column("transfer_type", "Transfer")
DIRECTIONS, INFERENCE = Column("directions", "Directions"), Column("regime", "Inference")
LAYER, ALPHA = Column("layer", "Layer", "count"), Column("alpha", "α", "count")
SIDES = (Column("n_voids", "Voids", "count"), Column("n_controls", "Controls", "count"))
DRAWS = "± standard deviation over draws of noise"
NO_MECHANISM = "the experiment has no `mechanism` section, so no local model's states were read"
FEW = 10  # values from fewer items of a side, or answers of a cell, are marked
FEW_MARK = "†"
SHORTCUTS = ("question words", "first frame", "all frames", "length", "time stamps")
KEYS = ["model", "source", "target"]
PROBE_KEY = ["model", "prompt", "analysis", "source", "target"]
NO_RAW = "none above .5"
BASELINE_NOTES = (
    "best raw input: the one of question words, first frame, all frames, length and time stamps with the highest "
    "AUROC, by the same protocol; output margin: log-odds that the first answer token begins an abstention; noise: "
    "random vectors as wide as states, mean ± deviation over draws",
    "a probe says nothing about understanding where a raw input is as high, and nothing about a gap between states and "
    "output where the margin is",
)


def why_not(results: Results, of_paper: str = "") -> str:
    """Return in words why a mechanistic frame has no rows; of_paper: why the paper's has none."""
    if of_paper and not results.is_study:
        return of_paper
    return NO_MECHANISM if results.is_study and results.mechanism is None else results.why("probes")


def few_marks(rows: pd.DataFrame, *counts: str) -> list[str]:
    """Return a mark for each row: a dagger if a known count is below FEW, else an empty text."""
    import pandas as pd

    numbers = [pd.to_numeric(rows[name], errors="coerce") for name in counts]
    return [FEW_MARK if any(value < FEW for value in values) else "" for values in zip(*numbers, strict=True)]


def few_note(rows: pd.DataFrame, *marks: str, of: str = "controls or voids") -> list[str]:
    """Return the note that explains the dagger if a row has it; `of` names the counted things."""
    has_mark = any((rows[name] == FEW_MARK).any() for name in marks or ("mark",) if name in rows)
    return [f"{FEW_MARK} fewer than {FEW} {of}: the value says little"] if has_mark else []


def joined_notes(rows: pd.DataFrame) -> list[str]:
    """Return which models' rows join the states of one model with the answers of another."""
    joined = rows.loc[rows["joins"].notna(), ["model", "joins"]].drop_duplicates()
    return [f"{model} joins two models ({joins}): no claim reads its rows" for model, joins in joined.to_numpy()]


def interval(prefix: str = "", unit: str = "fraction", digits: int | None = None) -> list[Column]:
    """Return two columns, the ends of an interval; their fields are `low` and `high` with a prefix."""
    return [
        Column(f"{prefix}{end}", word, unit, digits)  # pyright: ignore[reportArgumentType] - a Unit
        for end, word in (("low", "from"), ("high", "to"))
    ]


def short_names(names: Iterable[str]) -> list[str]:
    """Return the datasets' short names; any other name unchanged."""
    return [SHORT.get(name, name) if isinstance(name, str) and name else "not stated" for name in names]


def path_names(rows: pd.DataFrame) -> list[str]:
    """Return the steering path of each row as text, from its source to its target."""
    return [path_name(source, target) for source, target in zip(rows["source"], rows["target"], strict=True)]


def by_features(results: Results) -> pd.DataFrame:
    """Return the metric of each kind of features and its noise_spread as columns, one row per PROBE_KEY."""
    import pandas as pd

    rows = results.baselines
    by_feature = rows.pivot_table(index=PROBE_KEY, columns="features", values="value", observed=True)
    by_feature = by_feature.reindex(columns=pd.Index([*SHORTCUTS, "output margin", "noise"]))
    spread = rows.loc[rows["features"] == "noise"].set_index(PROBE_KEY)["spread"]
    return by_feature.join(spread.rename("noise_spread")).reset_index().astype(dict.fromkeys(PROBE_KEY, object))


def best_baselines(results: Results, analysis: str) -> pd.DataFrame:
    """Return a frame of BESIDE by model, source and target: best raw input, margin and noise."""
    import pandas as pd

    rows = by_features(results)
    rows = rows.loc[rows["analysis"] == analysis].set_index(KEYS)
    raw = rows[[*SHORTCUTS]].astype(float)
    best = [best_name(row) for row in raw.to_dict("records")]
    baseline_columns = rows[["output margin", "noise", "noise_spread"]].rename(columns={"output margin": "margin"})
    return pd.DataFrame({"raw": best, "raw_value": raw.max(axis=1)}, index=rows.index).join(baseline_columns)


def best_name(values: Mapping[Any, float]) -> str:
    """Return the feature of highest AUROC, NO_RAW if ≤ 0.5, empty if none is known."""
    known_values = {str(name): value for name, value in values.items() if value == value}
    best = max(known_values, key=lambda name: known_values[name], default="")
    return NO_RAW if best and known_values[best] <= 0.5 else best


def baseline_columns(results: Results, prefix: str = "", head: str = "") -> list[Column]:
    """Return the columns of BESIDE; none for the paper, which has no baselines."""
    if not results.is_study:
        return []
    return [
        Column(f"{prefix}raw", f"{head}Best raw input"), Column(f"{prefix}raw_value", f"{head}its AUROC", "fraction"),
        Column(f"{prefix}margin", f"{head}Output margin", "fraction"),
        Column(f"{prefix}noise", f"{head}Noise", "fraction", spread=f"{prefix}noise_spread"),
    ]  # fmt: skip


def baseline_notes(results: Results) -> list[str]:
    """Return notes on the columns of BESIDE, none for the paper."""
    return [*BASELINE_NOTES] if results.is_study else []
