"""J over all decided items of a model, with its error: what tests hold random reference strategies against."""

from __future__ import annotations

from typing import cast

import numpy as np
import pandas as pd

from traps_pipeline.scoring.metrics import decision_counts


def pooled_j(verdicts: pd.DataFrame) -> pd.DataFrame:
    """J of each model over all its decided items pooled, with its binomial standard error: columns model, j,
    standard_error, n (decided items of both sides).

    The error combines sqrt(p (1 - p) / n) of the two sides; it holds for answers drawn independently, as the random
    reference strategies draw them, and shows that these are indistinguishable from J = 0 (docs/spec.md 5.3).
    """
    counts = cast(pd.DataFrame, decision_counts(verdicts).groupby(verdicts["model"]).sum())
    on_void, on_control = counts["abs_rec_of"].replace(0, np.nan), counts["false_abs_of"].replace(0, np.nan)
    abs_rec, false_abs = counts["abs_rec"] / on_void, counts["false_abs"] / on_control
    variance = abs_rec * (1 - abs_rec) / on_void + false_abs * (1 - false_abs) / on_control
    pooled = {
        "j": abs_rec - false_abs,
        "standard_error": np.sqrt(variance),
        "n": counts["abs_rec_of"] + counts["false_abs_of"],
    }
    return pd.DataFrame(pooled).reset_index()
