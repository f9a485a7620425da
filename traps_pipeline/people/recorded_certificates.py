"""Certify recorded pairs by people: no simulator proves that their voids cannot be known (docs/recorded.md)."""

from __future__ import annotations

from typing import TYPE_CHECKING

from traps_pipeline.base.wording import count_noun
from traps_pipeline.people.human_label_rows import HUMAN_LABELS
from traps_pipeline.people.label_units import annotation_protocol
from traps_pipeline.protocol.datasets import RECORDED_CATEGORIES, is_ill_posed
from traps_pipeline.storage.benchmark_tables import ITEMS

if TYPE_CHECKING:
    import pandas as pd

    from traps_pipeline.storage.parquet import TableStore

NOT_CERTIFIED = "not certified"
UNCERTIFIED = f"recorded pairs, {NOT_CERTIFIED}"


def certification(labels: pd.DataFrame, items: pd.DataFrame) -> dict[str, tuple[int, int]]:
    """Return by scenario how many people answered the control rightly, and how many could not know the void.

    labels: HUMAN_LABELS; items: ITEMS rows, of which ill-posed questions certify nothing. An item on which no majority
    did so counts as nobody's. Of several items of a side, as two events have, the one with the fewest people counts.
    """
    clips = dict(tuple(labels.loc[labels["task"] == "answerability"].groupby("item_id")))
    counts = dict[str, dict[str, int]]()
    for item_id, dataset, scenario_id, side in items[["item_id", "dataset", "scenario_id", "side"]].to_numpy():
        people = counts.setdefault(scenario_id, {})
        if is_ill_posed(dataset):
            continue
        rows = clips.get(item_id, labels[:0])
        agreed = rows.loc[rows["correct" if side == "control" else "abstained"].fillna(value=False).astype(bool)]
        n_people = agreed["annotator"].nunique() if 2 * len(agreed) > len(rows) else 0
        people[side] = min(n_people, people.get(side, n_people))
    return {id_: (people.get("control", 0), people.get("void", 0)) for id_, people in counts.items()}


def recorded_verdicts(tables: TableStore) -> dict[str, str | None]:
    """Return by recorded scenario of a study why it is not certified; None where people certify it."""
    items = tables.read_all(ITEMS, ["item_id", "dataset", "scenario_id", "side", "category"])
    items = items.loc[items["category"].isin(RECORDED_CATEGORIES)]
    people, reasons = annotation_protocol().certified_by, dict[str, str | None]()
    for id_, (right, unknown) in certification(tables.read_all(HUMAN_LABELS), items).items():
        reason = f"{NOT_CERTIFIED}: {right} people of {people} answered the control, {unknown} could not know the void"
        reasons[id_] = None if min(right, unknown) >= people else reason
    return reasons


def certification_note(tables: TableStore) -> str:
    """Return how many recorded pairs of a study people certify, for every table and page; empty without such pairs."""
    verdicts, people = recorded_verdicts(tables), annotation_protocol().certified_by
    n_certified = sum(reason is None for reason in verdicts.values())
    if n_certified == len(verdicts):
        return f"recorded pairs: all {n_certified} certified by {people} people or more" if verdicts else ""
    return (
        f"{UNCERTIFIED}: {n_certified} of {count_noun(len(verdicts), 'scenario')} certified by "
        f"{people} people (run traps people annotate); answers of models certify nothing"
    )
