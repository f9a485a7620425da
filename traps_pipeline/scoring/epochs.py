"""Which figures may be compared: the rule of epochs (docs/spec.md 9.2)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

from traps_pipeline.errors import TrapsError
from traps_pipeline.partitions import DATASETS
from traps_pipeline.scoring.metrics import joined_epochs

if TYPE_CHECKING:
    import pandas as pd

Answered = Mapping[str, str]  # item to the campaigns of its answers, joined by +


class EpochMismatch(TrapsError):
    """The two sides of a ratio, contrast or gap were evaluated in different campaigns."""


def require_one_epoch(epochs: pd.DataFrame, what: str) -> None:
    """Raises EpochMismatch if any row of `epochs` holds two different epochs.

    epochs has one row per comparison (its index names it, e.g. model and dataset) and one column per side; a null side
    is not compared. `what` names the figure in the message.
    """
    mixed = epochs.loc[epochs.nunique(axis=1) > 1]
    if mixed.empty:
        return
    first = mixed.index[0]
    names = "/".join(first) if isinstance(first, tuple) else str(first)
    sides = ", ".join(f"{side} from epoch {epoch!r}" for side, epoch in mixed.iloc[0].dropna().items())
    more = f" (and {len(mixed) - 1} more)" if len(mixed) > 1 else ""
    raise EpochMismatch(
        f"{what}: {names} has {sides}{more}; figures of different epochs are never put in one ratio, contrast or gap: "
        "evaluate both sides in one epoch, or leave this one out"
    )


def answered(verdicts: pd.DataFrame) -> dict[tuple[str, str, str], Answered]:
    """The items that every (model, regime, dataset) answered over its runs, with their campaigns; `overall` has the
    runs with all four datasets, and is left out if there is none."""
    whole = verdicts.groupby(["model", "regime", "run"])["dataset"].transform("nunique") == len(DATASETS)
    columns = ["model", "regime", "dataset", "item_id", "epoch"]
    found: dict[tuple[str, str, str], dict[str, str]] = {}
    for *cell, item, epoch, in_overall in (
        verdicts[columns].assign(whole=whole).drop_duplicates().itertuples(index=False, name=None)
    ):
        model, regime, dataset = cell
        for scope in (dataset, "overall") if in_overall else (dataset,):
            items = found.setdefault((model, regime, scope), {})
            items[item] = joined_epochs([items.get(item, ""), epoch])
    return dict(found)


def refusal(left: Answered, right: Answered) -> str | None:
    """Why two sides may not be compared item by item: their items differ, or an item's campaigns do; else None."""
    if left == right:
        return None
    alone = sorted(left.keys() ^ right.keys())
    if alone:
        return f"{_named(alone)} answered on one side alone; both sides of a contrast are of the same items"
    mixed = sorted(item for item, epoch in left.items() if right[item] != epoch)
    epochs = f"epoch {left[mixed[0]]} against epoch {right[mixed[0]]}"
    return f"{_named(mixed)} of {epochs}; figures of different epochs are never put in one contrast"


def _named(items: list[str]) -> str:
    """Names the first of these items with its dataset, and counts the others."""
    dataset, more = items[0].partition(":")[0], len(items) - 1
    return f"{dataset}: {items[0]}" + (f" and {more} more items are" if more else " is")
