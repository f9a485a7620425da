"""Compute a leaderboard's scores from verdicts, as the scoring stages do in turn."""

from dataclasses import dataclass

import pandas as pd

from traps_pipeline.protocol.datasets import DATASETS
from traps_pipeline.scoring.bootstrap import intervals, resample
from traps_pipeline.scoring.contrasts import contrasts
from traps_pipeline.scoring.metrics import cell_metrics
from traps_pipeline.scoring.standings import leaderboard
from traps_pipeline.scoring.two_way import two_way


@dataclass(frozen=True)
class Scores:
    """The METRICS, LEADERBOARD and TWO_WAY rows that the same verdicts give."""

    metrics: pd.DataFrame
    board: pd.DataFrame
    two_way: pd.DataFrame


def score(verdicts: pd.DataFrame) -> Scores:
    """Return scores from the VERDICTS rows of pairs and, where they were asked, of two events."""
    cells = pd.concat([cell_metrics(rows) for _, rows in verdicts.groupby("dataset", sort=True)], ignore_index=True)
    pairs, cells_of_pairs = (rows.loc[rows["dataset"].isin(DATASETS)] for rows in (verdicts, cells))
    resampled_metrics = resample(pairs)
    paired_contrasts = contrasts(resampled_metrics, cells_of_pairs, pairs)
    board = leaderboard(cells_of_pairs, intervals(resampled_metrics), paired_contrasts)
    return Scores(cells, board, two_way(verdicts))
