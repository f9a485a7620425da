"""What may be compared with what: the rule of epochs (benchmark.md section 9)."""

from __future__ import annotations

from traps_pipeline.errors import TrapsError
from traps_pipeline.scoring import Frame


class EpochMismatch(TrapsError):
    """A ratio, contrast or gap was asked for whose two sides were evaluated in different campaigns."""


def require_one_epoch(epochs: Frame, what: str) -> None:
    """Raises EpochMismatch unless every row of `epochs` holds one and the same epoch throughout.

    epochs has a row a comparison (its index names it, e.g. model and dataset) and a column a side; a null side is not
    compared. what names the figure for the message.
    """
    mixed = epochs[epochs.nunique(axis=1) > 1]
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


def epoch_note(cells: Frame) -> str:
    """What a table's header must say of its epochs: empty where all of its cells are of one.

    cells has the columns dataset and epoch. A dataset that differs from the commonest epoch is named.
    """
    by_dataset = cells.groupby("dataset", sort=False)["epoch"].unique()
    if cells["epoch"].nunique() <= 1:
        return ""
    parts = [f"{dataset} {' and '.join(sorted(epochs))}" for dataset, epochs in by_dataset.items()]
    return "epochs: " + ", ".join(parts)
