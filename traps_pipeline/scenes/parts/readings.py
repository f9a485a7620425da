"""Read simulations: the outcome's label in each frame, and the margin of the end state.

A family's `outcome(motion, p)` gives a `kit.Reading`, mostly from one of the functions here. Arrays over the frames are
(F,), lengths in metres.
"""

from collections.abc import Sequence

import numpy as np

from traps_pipeline.scenes.physics.kit import Motion, Reading

Labels = list[str | None]


def lasting_from(holds: np.ndarray) -> int:
    """Return the first frame from which `holds` (F,) stays true; F if none."""
    false_frames = np.flatnonzero(~holds)
    return int(false_frames[-1]) + 1 if false_frames.size else 0


def still_from(*paths: np.ndarray, within_m: float) -> int:
    """Return the first frame from which all paths stay near their ends.

    A path is (F,), a place along a line, or (F, ..., 3), places in space.
    """
    distances = [
        np.abs(path - path[-1]) if path.ndim == 1 else np.linalg.norm(path - path[-1], axis=-1) for path in paths
    ]
    is_moving = [(move > within_m).reshape(len(move), -1).any(axis=1) for move in distances]
    return lasting_from(~np.any(is_moving, axis=0))


def clear_m(past: np.ndarray, before_m: float = 0.0) -> float:
    """Return the distance (m) by which a thing ends past a line, or its front ends before it."""
    return float(past[-1] if past[-1] > 0 else -past[-1] - before_m)


def undecided(motion: Motion) -> Labels:
    """Return labels that are None in every frame: of a run without a valid outcome."""
    return [None] * len(motion.times)


def label_from(first: int, label: str, motion: Motion) -> Labels:
    """Return labels (one per frame): None before a frame, and this label from it on."""
    return [label if i >= first else None for i in range(len(motion.times))]


def yes_while(holds: np.ndarray, no_from: int, no_where: np.ndarray | bool = True) -> Labels:
    """Return labels: 'yes' where `holds` (F,), 'no' elsewhere from a frame on if `no_where`."""
    no_where = np.broadcast_to(no_where, holds.shape)
    return [
        "yes" if yes else "no" if i >= no_from and no else None
        for i, (yes, no) in enumerate(zip(holds, no_where, strict=True))
    ]


def side_while(valid: np.ndarray, past: np.ndarray, over: str = "yes", under: str = "no") -> Labels:
    """Return labels: `over` where `past` > 0, else `under`, in the frames that are `valid`."""
    return [(over if x > 0 else under) if counts else None for x, counts in zip(past, valid, strict=True)]


def read_crossing(past: np.ndarray, valid: np.ndarray | bool = True) -> Reading:
    """Return the reading 'yes' if `past` (F,) m ends above 0, else 'no', with its end as the margin."""
    first = lasting_from(valid & (np.sign(past) == np.sign(past[-1])))
    answer = "yes" if past[-1] > 0 else "no"
    return Reading([answer if i >= first else None for i in range(len(past))], float(abs(past[-1])))


def read_passage(rear_past: np.ndarray, radius_m: float) -> Reading:
    """Return the reading 'yes' once a ball's rear is out, `rear_past` (F,) > 0, 'no' if it stays in.

    The margin is how far the ball ends out, or how far its front is from coming out.
    """
    end = rear_past[-1]
    if end > 0:
        return Reading(["yes" if x > 0 else None for x in rear_past], float(end))
    first = lasting_from(np.abs(rear_past - end) <= radius_m)
    return Reading(["no" if i >= first else None for i in range(len(rear_past))], float(-end - 2 * radius_m))


def first_past(motion: Motion, ahead: np.ndarray, names: Sequence[str], min_lead_s: float) -> Reading:
    """Return the reading of which name is first past the line: `ahead` (F, N) m above 0.

    There is no reading if a competitor never gets past or the lead is below `min_lead_s`. The margin is how far the
    second still is from the line when the first is past it.
    """
    is_past = ahead > 0
    margin = float(-np.sort(ahead[int(is_past.any(axis=1).argmax())])[-2])
    arrival_times = motion.times[is_past.argmax(axis=0)]
    first, second = np.sort(arrival_times)[:2]
    if not is_past[-1].all() or second - first < min_lead_s:
        return Reading(undecided(motion), margin)
    winner, frames = names[int(arrival_times.argmin())], np.sort(is_past.argmax(axis=0))
    labels = [winner if t >= first else None for t in motion.times]
    return Reading(labels, margin, (int(frames[0]), int(frames[1])))


def top_m(motion: Motion, body: str, height_m: float, floor_m: float = 0.0) -> np.ndarray:
    """Return the height over a floor of the middle of a body's top (m), shape (F,)."""
    return motion.pos(body)[:, 2] - floor_m + motion.rot(body)[:, 2, 2] * height_m / 2


def turns_deg(rotations: np.ndarray) -> float:
    """Return the largest turn (degrees) from the first frame; rotations (F, 3, 3)."""
    traces = np.einsum("fij,ij->f", rotations, rotations[0])
    return float(np.degrees(np.arccos(np.clip((traces - 1) / 2, -1, 1)).max()))
