"""Compute a leaderboard's scores from verdicts, as the scoring stages do in turn."""

from __future__ import annotations

from dataclasses import dataclass

import pandas as pd

from traps_pipeline.scoring.bootstrap import intervals, resample
from traps_pipeline.scoring.contrasts import contrasts
from traps_pipeline.scoring.metrics import cell_metrics
from traps_pipeline.scoring.standings import leaderboard


@dataclass(frozen=True)
class Scores:
    """METRICS and LEADERBOARD rows of the same verdicts."""

    metrics: pd.DataFrame
    board: pd.DataFrame


def score(verdicts: pd.DataFrame) -> Scores:
    """Return METRICS and LEADERBOARD rows from the pairs' VERDICTS rows."""
    cells = pd.concat([cell_metrics(rows) for _, rows in verdicts.groupby("dataset", sort=True)], ignore_index=True)
    resampled_figures = resample(verdicts)
    paired_contrasts = contrasts(resampled_figures, cells, verdicts)
    return Scores(cells, leaderboard(cells, intervals(resampled_figures), paired_contrasts))
