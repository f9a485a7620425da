"""Measure that nothing in view tells events that a board hides from events that are seen."""

from collections import Counter
from collections.abc import Iterable, Iterator

import numpy as np
import pandas as pd

from traps_pipeline.scenes.certification.certify_lanes import SHARES
from traps_pipeline.scenes.physics.kit import Physics
from traps_pipeline.scenes.worlds.lane_records import TwoEventsSpec

SIDES = ("seen", "hidden")
# How well a number alone may tell hidden lanes from seen ones: over all records, and in a family of so many lanes.
LARGEST_AUC, LARGEST_FAMILY_AUC, FAMILY_LANES = 0.6, 0.85, 16


def lane_numbers(specs: Iterable[TwoEventsSpec]) -> pd.DataFrame:
    """Return a frame with a row per lane, seen and hidden: family, side, and numbers of what its clip shows.

    Boards: whether one comes, moves and stands, at fixed shares of the clip and in all; pixels of boards and of things
    like the asked one. Where boards are follows from the side, so the two sides have the same timetable.
    """
    return pd.DataFrame([row for spec in specs for row in _rows(spec)])


def _rows(spec: TwoEventsSpec) -> Iterator[dict[str, object]]:
    n_frames = Physics(**spec.physics).n_frames
    for record, in_view in zip(spec.lanes, spec.evidence["in_view"], strict=True):
        away = record.lane.timetable.away(n_frames)
        at = np.rint(np.array(SHARES) * (n_frames - 1)).astype(int)
        for side in SIDES:
            numbers = {
                **{
                    f"boards standing at {share:.0%}": 1 + float(away[i] == 0)
                    for share, i in zip(SHARES, at, strict=True)
                },
                "boards moving (s)": float(((away > 0) & (away < 1)).sum()) / spec.physics["fps"],
                "boards standing (s)": (n_frames + float((away == 0).sum())) / spec.physics["fps"],
            }
            for name, values in in_view[side].items():
                numbers |= {f"{name} at {share:.0%}": px for share, px in zip(SHARES, values, strict=True)}
            yield {"scenario_id": spec.scenario_id, "family": spec.family, "side": side, **numbers}


def balance(rows: pd.DataFrame) -> pd.DataFrame:
    """Return a frame with a row per number: its mean on both sides, and its AUC over all lanes and in one family.

    AUC: the probability that a hidden lane has more of it than a seen one; .5 tells nothing.
    """
    names = [name for name in rows.columns if name not in ("scenario_id", "family", "side")]
    table = []
    for name in names:
        seen, hidden = (rows.loc[rows["side"] == side, name].to_numpy(float) for side in SIDES)
        by_family = {
            str(family): auc(*(group.loc[group["side"] == side, name].to_numpy(float) for side in SIDES))
            for family, group in rows.groupby("family")
        }
        worst = max(by_family, key=lambda family: abs(by_family[family] - 0.5))
        means = {side: float(values.mean()) for side, values in zip(SIDES, (seen, hidden), strict=True)}
        table.append(
            {"number": name, **means, "auc": auc(seen, hidden), "family": worst, "family_auc": by_family[worst]}
        )
    return pd.DataFrame(table)


def telling_numbers(specs: Iterable[TwoEventsSpec]) -> list[str]:
    """Return a sentence for each number that tells hidden lanes from seen ones, over all or in a family."""
    lanes = Counter((rows := lane_numbers(specs))["family"])
    whole = rows.loc[[lanes[family] >= len(SIDES) * FAMILY_LANES for family in rows["family"]]]
    found = [(number, value, LARGEST_AUC, "") for number, value in balance(rows)[["number", "auc"]].to_numpy()]
    worst = balance(whole)[["number", "family_auc", "family"]].to_numpy() if len(whole) else ()
    found += [(number, value, LARGEST_FAMILY_AUC, f" of {family}") for number, value, family in worst]
    return [
        f"two events: {number} tells hidden lanes{family} from seen ones (AUC {value:.2f}, {1 - limit:g} to {limit:g} "
        "are allowed)"
        for number, value, limit, family in found
        if abs(value - 0.5) > limit - 0.5
    ]


def auc(seen: np.ndarray, hidden: np.ndarray) -> float:
    """Return the probability that a hidden value is above a seen one, ties by half."""
    return float((np.sign(hidden[:, None] - seen[None]) / 2 + 0.5).mean())
