"""Find near duplicates: scenarios of a family whose control clips look alike."""

import threading
from collections.abc import Mapping
from dataclasses import dataclass
from functools import reduce
from pathlib import Path

from traps_pipeline.base.wording import count_noun
from traps_pipeline.scenes.draw.likeness import HASH_BITS, NEAR_BITS, perceptual_hash
from traps_pipeline.video.encode import DamagedClip, decode

PLACES = (0.0, 0.5, 1.0)  # positions of the compared frames, as shares of the clip
ALIKE_BELOW = NEAR_BITS / HASH_BITS  # share of differing bits below which two scenarios are near duplicates


@dataclass(frozen=True)
class Neighbour:
    """The most similar scenario, and the share of fingerprint bits that differ."""

    scenario_id: str
    distance: float


def fingerprint(clip: Path) -> int:
    """Return the hashes of the first, middle and last frame, one behind the other. Raises DamagedClip."""
    frames, _ = decode(clip)
    hashes = (perceptual_hash(frames[round(place * (len(frames) - 1))]) for place in PLACES)
    return reduce(lambda bits, one: bits << HASH_BITS | one, hashes)


def neighbours(prints: Mapping[str, int], families: Mapping[str, str]) -> dict[str, Neighbour]:
    """Return the nearest scenario of the same family, for each scenario that has one."""
    nearest_of = {}
    for name in sorted(prints):
        others = [other for other in sorted(prints) if families[other] == families[name] and other != name]
        distances = [(prints[name] ^ prints[other]).bit_count() / (len(PLACES) * HASH_BITS) for other in others]
        if others:
            nearest = min(distances)
            nearest_of[name] = Neighbour(others[distances.index(nearest)], nearest)
    return nearest_of


class Comparison:
    """The neighbours of all scenarios, computed in the background on first use.

    Decoding 700 clips takes a minute. clips: control clips by scenario; unreadable ones are left out.
    """

    def __init__(self, clips: Mapping[str, Path], families: Mapping[str, str]) -> None:
        self._clips, self._families = clips, families
        self._prints: dict[str, int] = {}
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
