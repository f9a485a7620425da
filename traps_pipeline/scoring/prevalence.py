"""Count each axis of confabulation in a model's void failures (docs/spec.md 6.2)."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import pandas as pd

from traps_pipeline.protocol.ratings import AXES
from traps_pipeline.scoring.metrics import joined_epochs, wilson
from traps_pipeline.scoring.score_rows import CONFABULATION_PREVALENCE

# Column of CONFABULATION_PREVALENCE to the axes that must all apply.
SHARES: Mapping[str, tuple[str, ...]] = {
    "hp": AXES[:1],
    "ii": AXES[1:2],
    "hp_and_ii": AXES[:2],
    "es": AXES[2:3],
    "doubt": AXES[3:],
}


def prevalence(labels: pd.DataFrame) -> pd.DataFrame:
    """Return CONFABULATION_PREVALENCE rows from CONFABULATION rows.

    They are shares of validly labelled failures, with Wilson intervals; null if a model has none. A model without a
    sampled failure has no row, since it was not run.
    """
    rows = [_row(str(model), group) for model, group in labels.groupby("model", sort=True)]
    return pd.DataFrame(rows, columns=pd.Index(CONFABULATION_PREVALENCE.names))


def _row(model: str, group: pd.DataFrame) -> dict[str, Any]:
    valid = group.loc[group["valid"].to_numpy(bool), [*AXES]].astype(bool)
    row: dict[str, Any] = {
        "model": model,
        "n_failures": int(group["n_failures"].to_numpy().max()),
        "n_sampled": len(group),
        "n": len(valid),
        "epoch": joined_epochs(group["epoch"]),
    }
    for name, axes in SHARES.items():
        yes = np.array([valid[[*axes]].to_numpy().all(axis=1).sum()], float)
        (low,), (high,) = wilson(yes, np.array([len(valid)], float))
        row |= {name: yes[0] / len(valid) if len(valid) else np.nan, f"{name}_low": low, f"{name}_high": high}
    separators = {"evidence": "+", "judge": "+", "benchmark_version": " + "}
    return row | {name: separator.join(sorted(set(group[name]))) for name, separator in separators.items()}
