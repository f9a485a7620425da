"""Certify recorded pairs by people: no simulator proves that their voids cannot be known (docs/recorded.md)."""

from __future__ import annotations

from typing import TYPE_CHECKING

from traps_pipeline.base.wording import count_noun
from traps_pipeline.people.human_label_rows import HUMAN_LABELS
from traps_pipeline.people.label_units import annotation_protocol
from traps_pipeline.protocol.datasets import RECORDED, is_ill_posed
from traps_pipeline.storage.benchmark_tables import SCENE_SPECS

if TYPE_CHECKING:
    import pandas as pd

    from traps_pipeline.storage.parquet import TableStore

NOT_CERTIFIED = "not certified"
UNCERTIFIED = f"recorded pairs, {NOT_CERTIFIED}"


def certification(labels: pd.DataFrame, scenario_ids: list[str]) -> dict[str, tuple[int, int]]:
    """Return by scenario how many people answered the control rightly, and how many could not know the void.

    labels: HUMAN_LABELS. A side on which no majority did so counts as nobody's.
    """
    clips = labels.loc[(labels["task"] == "answerability") & ~labels["dataset"].map(is_ill_posed).astype(bool)]
    counts = dict[tuple[str, str], int]()
    for (scenario_id, side), rows in clips.groupby(["scenario_id", "side"]):
        agreed = rows.loc[rows["correct" if side == "control" else "abstained"].fillna(value=False).astype(bool)]
        is_most = 2 * len(agreed) > len(rows)
        counts[str(scenario_id), str(side)] = agreed["annotator"].nunique() if is_most else 0
    return {id_: (counts.get((id_, "control"), 0), counts.get((id_, "void"), 0)) for id_ in scenario_ids}


def recorded_verdicts(tables: TableStore) -> dict[str, str | None]:
    """Return by recorded scenario of a study why it is not certified; None where people certify it."""
    specs = tables.read_all(SCENE_SPECS, ["scenario_id", "family"])
    ids = sorted(map(str, specs.loc[specs["family"] == RECORDED, "scenario_id"]))
    counts = certification(tables.read_all(HUMAN_LABELS), ids) if ids else {}
    people, reasons = annotation_protocol().certified_by, dict[str, str | None]()
    for id_, (right, unknown) in counts.items():
        reason = f"{NOT_CERTIFIED}: {right} people of {people} answered the control, {unknown} could not know the void"
        reasons[id_] = None if min(right, unknown) >= people else reason
    return reasons


def certification_note(tables: TableStore) -> str:
    """Return how many recorded pairs of a study people certify, for every table and page; empty without such pairs."""
    verdicts = recorded_verdicts(tables)
    n_certified, people = sum(reason is None for reason in verdicts.values()), annotation_protocol().certified_by
    if not verdicts:
        return ""
    if n_certified == len(verdicts):
        return f"recorded pairs: all {n_certified} certified by {people} people or more"
    return (
        f"{UNCERTIFIED}: {n_certified} of {count_noun(len(verdicts), 'scenario')} certified by "
        f"{people} people (run traps people annotate); answers of models certify nothing"
    )
