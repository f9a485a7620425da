"""Decide which scores may be compared, by epochs (docs/spec.md 9.2) and panel."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from typing import TYPE_CHECKING, NamedTuple

from traps_pipeline.base.errors import TrapsError
from traps_pipeline.base.wording import count_noun
from traps_pipeline.protocol.datasets import DATASETS
from traps_pipeline.scoring.metrics import joined_epochs

if TYPE_CHECKING:
    import pandas as pd


class Origin(NamedTuple):
    """The campaigns of an answer and the panels of its votes, each joined by +."""

    epoch: str
    panel: str


Answered = Mapping[str, Origin]  # by item


class EpochMismatch(TrapsError):
    """Raised where the two sides of a ratio, contrast or gap were evaluated in different campaigns."""


def require_one_epoch(epochs: pd.DataFrame, metric: str) -> None:
    """Raise EpochMismatch if any row of `epochs` holds two different epochs.

    epochs has one row per comparison (its index names it, e.g. model and dataset) and one column per side; a null side
    is ignored. metric: its name in the message.
    """
    mixed_rows = epochs.loc[epochs.nunique(axis=1) > 1]
    if mixed_rows.empty:
        return
    first = mixed_rows.index[0]
    names = "/".join(first) if isinstance(first, tuple) else str(first)
    sides = ", ".join(f"{side} from epoch {epoch!r}" for side, epoch in mixed_rows.iloc[0].dropna().items())
    suffix = f" (and {len(mixed_rows) - 1} more)" if len(mixed_rows) > 1 else ""
    raise EpochMismatch(
        f"{metric}: {names} has {sides}{suffix}; metrics of different epochs are never put in one ratio, contrast or "
        "gap: evaluate both sides in one epoch, or leave this one out"
    )


def answered_items(verdicts: pd.DataFrame) -> dict[tuple[str, str, str], Answered]:
    """Return by (model, regime, dataset) the answered items, with campaign and panel of each.

    Runs are pooled. `overall` covers the runs with all four datasets, and is left out if there is none.
    """
    is_complete = verdicts.groupby(["model", "regime", "run"])["dataset"].transform("nunique") == len(DATASETS)
    columns = ["model", "regime", "dataset", "item_id", "epoch", "panel"]
    origins: dict[tuple[str, str, str], dict[str, Origin]] = {}
    joined = cache(_joined)  # thousands of items have one origin
    for *cell, item, epoch, panel, is_in_overall in (
        verdicts[columns].assign(whole=is_complete).drop_duplicates().itertuples(index=False, name=None)
    ):
        model, regime, dataset = cell
        for scope in (dataset, "overall") if is_in_overall else (dataset,):
            items = origins.setdefault((model, regime, scope), {})
            items[item] = joined(items.get(item), Origin(epoch, panel))
    return dict(origins)


def _joined(old: Origin | None, new: Origin) -> Origin:
    sides = [origin for origin in (old, new) if origin is not None]
    return Origin(joined_epochs([o.epoch for o in sides]), joined_epochs([o.panel for o in sides]))


def refusal(left: Answered, right: Answered) -> str | None:
    """Return why two sides may not be compared item by item; None if they may.

    Reasons: their items differ, an item's campaigns or panels differ, or panels are mixed.
    """
    panels = [sorted({origin.panel for origin in side.values()}) for side in (left, right)]
    if left == right and all(len(names) < 2 and "+" not in "".join(names) for names in panels):
        return None
    unpaired_items = sorted(left.keys() ^ right.keys())
    if unpaired_items:
        return (
            f"{_name_first(unpaired_items)} answered on one side alone; both sides of a contrast are of the same items"
        )
    mixed_items = sorted(item for item, origin in left.items() if right[item].epoch != origin.epoch)
    if not mixed_items:
        left_names, right_names = (" and ".join(names) for names in panels)
        judged = f"judged by {left_names} on one side and by {right_names} on the other"
        return f"{judged}; metrics of different panels are not compared"
    epochs = f"epoch {left[mixed_items[0]].epoch} against epoch {right[mixed_items[0]].epoch}"
    return f"{_name_first(mixed_items)} of {epochs}; metrics of different epochs are never put in one contrast"


def _name_first(items: list[str]) -> str:
    """Return the first item with its dataset, and the number of others, in words."""
    dataset, n_more = items[0].partition(":")[0], len(items) - 1
    return f"{dataset}: {items[0]}" + (f" and {count_noun(n_more, 'more item')} are" if n_more else " is")
