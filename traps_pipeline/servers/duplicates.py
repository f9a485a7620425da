"""Find near duplicates: scenarios of a family whose control clips look alike."""

from __future__ import annotations

import threading
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from traps_pipeline.base.wording import count_noun
from traps_pipeline.video.encode import DamagedClip, decode

PLACES = (0.0, 0.5, 1.0)  # positions of the compared frames, as shares of the clip
SIDE = 16  # a frame gives SIDE x SIDE bits: whether a pixel of the reduced frame is brighter than the one on its left
ALIKE_BELOW = 0.1  # share of differing bits below which two scenarios are near duplicates


@dataclass(frozen=True)
class Neighbour:
    """The most similar scenario, and the share of fingerprint bits that differ."""

    scenario_id: str
    distance: float


def fingerprint(clip: Path) -> np.ndarray:
    """Return first, middle and last frames' difference hash. Raises DamagedClip.

    Shape (3 * SIDE * SIDE,), bool.
    """
    import cv2

    frames, _ = decode(clip)
    bits = []
    for place in PLACES:
        grey = cv2.cvtColor(frames[round(place * (len(frames) - 1))], cv2.COLOR_RGB2GRAY)
        thumbnail = cv2.resize(grey, (SIDE + 1, SIDE), interpolation=cv2.INTER_AREA)
        bits.append(thumbnail[:, 1:] > thumbnail[:, :-1])
    return np.concatenate([part.ravel() for part in bits])


def neighbours(prints: Mapping[str, np.ndarray], families: Mapping[str, str]) -> dict[str, Neighbour]:
    """Return the nearest scenario of the same family, for each scenario that has one."""
    nearest_of = {}
    for family in sorted(set(families.values())):
        names = sorted(name for name in prints if families[name] == family)
        if len(names) < 2:
            continue
        table = np.array([prints[name] for name in names])
        for k, name in enumerate(names):
            distances = (table != table[k]).mean(axis=1)
            distances[k] = np.inf
            nearest = int(np.argmin(distances))
            nearest_of[name] = Neighbour(names[nearest], float(distances[nearest]))
    return nearest_of


class Comparison:
    """The neighbours of all scenarios, computed in the background on first use.

    Decoding 700 clips takes a minute. clips: control clips by scenario; unreadable ones are left out.
    """

    def __init__(self, clips: Mapping[str, Path], families: Mapping[str, str]) -> None:
        self._clips, self._families = clips, families
        self._prints: dict[str, np.ndarray] = {}
        self._found: dict[str, Neighbour] | None = None
        self._lock, self._has_begun = threading.Lock(), False

    def start(self) -> None:
        """Start the comparison, unless it has started."""
        with self._lock:
            if not self._has_begun:
                self._has_begun = True
                threading.Thread(target=self._compare, daemon=True).start()

    def _compare(self) -> None:
        for name, clip in self._clips.items():
            try:
                self._prints[name] = fingerprint(clip)
            except DamagedClip:
                continue  # the next run reports it
        self._found = neighbours(self._prints, self._families)

    @property
    def progress(self) -> str:
        """The progress in words; empty once it is done."""
        return (
            "" if self._found is not None else f"{len(self._prints)} of {count_noun(len(self._clips), 'clip')} compared"
        )

    @property
    def found(self) -> Mapping[str, Neighbour]:
        """The near duplicates, once all scenarios are compared; empty until then."""
        return {name: neighbour for name, neighbour in (self._found or {}).items() if neighbour.distance < ALIKE_BELOW}
