"""Queue the scenarios of a review: which are shown, and in which order."""

from collections.abc import Mapping, Sequence
from typing import Literal, get_args

import pandas as pd

from traps_pipeline.judging.judging_rows import VERDICTS
from traps_pipeline.storage.benchmark_tables import current_rows
from traps_pipeline.storage.workspace import Workspace

QueueName = Literal["unreviewed", "judges", "models", "all"]
QUEUES: tuple[QueueName, ...] = get_args(QueueName)
MEANINGS: Mapping[QueueName, str] = {
    "unreviewed": "not reviewed yet",
    "judges": "judges disagree",
    "models": "models disagree on the control",
    "all": "all scenarios",
}


def flags(workspace: Workspace) -> pd.DataFrame:
    """Return judges' and models' disagreement by scenario; empty without verdicts.

    `judges`: the number of judged answers without a unanimous panel. `models`: p (1 - p), from 0 to 0.25, of the share
    p of models that answer the controls correctly.
    """
    rows = current_rows(workspace, VERDICTS, ["scenario_id", "item_id", "side", "n_valid", "correct", "unanimous"])
    judged = rows.loc[rows["n_valid"] > 0]
    split = (~judged["unanimous"].astype(bool)).groupby(judged["scenario_id"]).sum()
    controls = rows.loc[(rows["side"] == "control") & rows["correct"].notna()]
    share = controls["correct"].astype(float).groupby(controls["scenario_id"]).mean()
    return pd.DataFrame({"judges": split, "models": share * (1 - share)}).fillna(0.0)


def queue(name: QueueName, scenarios: Sequence[str], reviewed: frozenset[str], flagged: pd.DataFrame) -> list[str]:
    """Return the scenarios that a review queue offers, in order; reviewed ones stay only in `all`. flagged: `flags`."""
    if name == "all":
        return list(scenarios)
    waiting = [each for each in scenarios if each not in reviewed]
    if name == "unreviewed":
        return waiting
    scores = flagged[name].to_dict() if len(flagged) else {}
    return sorted((each for each in waiting if scores.get(each, 0) > 0), key=lambda each: (-scores[each], each))
