"""Compute PECS without one judge (docs/spec.md 4.1, 5.1), to show its influence."""

from collections.abc import Iterator, Sequence

import numpy as np
import pandas as pd

from traps_pipeline.protocol.ratings import ABSTENTION, CORRECTNESS, majority, ratings, vote_decisions
from traps_pipeline.scoring.bootstrap import ENTRY
from traps_pipeline.scoring.metrics import CELL, cell_metrics
from traps_pipeline.scoring.score_rows import LEAVE_ONE_OUT
from traps_pipeline.scoring.standings import standings

_COLUMNS = pd.Index(LEAVE_ONE_OUT.names)


def leave_one_out(
    verdicts: pd.DataFrame, votes: pd.DataFrame, board: pd.DataFrame, judges: Sequence[str] | None = None
) -> pd.DataFrame:
    """Return LEAVE_ONE_OUT rows from VERDICTS and VOTES rows of the same cells.

    board: their LEADERBOARD rows. PECS by the two other judges is computed as PECS by the panel: per run, then
    averaged; overall over the four datasets. The rows cover entries of the board, over the cells on which these judges
    (default: all) voted. A panel of one judge has no rows.
    """
    panel = board.rename(columns={"pecs": "pecs_panel", "n_missing": "n_missing_panel"})
    panel = panel.loc[:, [*ENTRY, "pecs_panel", "n_missing_panel"]]
    judged = [*two_judge_verdicts(verdicts, votes, judges)]
    if not judged:
        return pd.DataFrame(columns=_COLUMNS)
    # All judges in one pass: a model without one of them is scored like a model of its own.
    seats = [
        verdict_rows.assign(model=f"{seat}|" + verdict_rows["model"]) for seat, (_, verdict_rows) in enumerate(judged)
    ]
    rows = _standings_of(pd.concat(seats, ignore_index=True))
    names = [name.split("|", 1) for name in rows["model"]]
    rows = rows.assign(model=[model for _, model in names], without=[judged[int(seat)][0] for seat, _ in names])
    rows = rows.merge(panel, on=ENTRY, how="inner", validate="many_to_one")
    rows["difference"] = rows["pecs"] - rows["pecs_panel"]
    return rows.loc[:, _COLUMNS]


def two_judge_verdicts(
    verdicts: pd.DataFrame, votes: pd.DataFrame, judges: Sequence[str] | None = None
) -> Iterator[tuple[str, pd.DataFrame]]:
    """Yield each judge, and the VERDICTS rows that the other two judges give.

    They decide an item if both votes are valid and agree; 1-1 is undecided. An item without an answer has no decision.
    """
    cast = ratings(votes, judges)
    if len(cast.judges) < 2:
        return
    verdicts = verdicts.merge(cast.answers[CELL].drop_duplicates(), on=CELL)
    (abstention, _), (correctness, _) = cast.on(verdicts, ABSTENTION), cast.on(verdicts, CORRECTNESS)
    for seat, judge in enumerate(cast.judges):
        abstained, correct = (majority(np.delete(votes_on, seat, axis=1)) for votes_on in (abstention, correctness))
        yield judge, verdicts.assign(abstained=vote_decisions(abstained), correct=vote_decisions(correct))


def _standings_of(verdicts: pd.DataFrame) -> pd.DataFrame:
    cells = [cell_metrics(rows, {}) for _, rows in verdicts.groupby("dataset", sort=True)]
    return standings(pd.concat(cells, ignore_index=True))
