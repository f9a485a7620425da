"""Choose which frames of a clip a model is shown: a time grid, or evenly spaced."""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class FramePolicy:
    """A grid of frames per second up to a number, or evenly spaced frames.

    Of a grid of `fps` frames a second, the first `most` are shown; `uniform` is the number of evenly spaced ones.
    later: shows instead of each frame the one this many frames later (at most the clip's last).
    """

    fps: float | None = None
    uniform: int | None = None
    most: int = 25
    later: int = 0

    def __str__(self) -> str:
        return f"{self.uniform} evenly spaced" if self.fps is None else f"{self.fps:g} a second"

    def pick(self, times: np.ndarray) -> np.ndarray:
        """Return indices of the frames nearest to the target times, none twice.

        times: (F,) seconds, ascending. A grid starts at 0; uniform includes the first frame and the last one. Of two
        equally near frames the earlier one is taken.
        """
        if self.uniform is not None and len(times) <= self.uniform:
            return np.arange(len(times))
        gaps = np.abs(times[:, None] - self._targets(times)).round(9)  # s; rounded, or noise would break ties
        indices = np.unique(gaps.argmin(axis=0))[: self.uniform or self.most]
        return np.unique(np.minimum(indices + self.later, len(times) - 1))

    def _targets(self, times: np.ndarray) -> np.ndarray:
        if self.fps is None:
            return np.linspace(times[0], times[-1], self.uniform or 1)
        return np.arange(int(times[-1] * self.fps + 1e-6) + 1) / self.fps


SAMPLED = FramePolicy(fps=5)  # what most models, and the observer, are shown

# Those of the registered models (docs/spec.md 3.1): what is certified to be seen must be seen under each of them.
POLICIES = (SAMPLED, FramePolicy(uniform=16), FramePolicy(fps=2, most=32))


def shown_at_end(n_frames: int, fps: int, last_s: float, until: int | None = None) -> list[int]:
    """Return the late frames of a clip that some policy shows.

    They lie within the last so many seconds of the clip, or of what it shows before frame `until`. Each policy's last
    frame is always among them.
    """
    times = np.arange(n_frames) / fps
    end = n_frames if until is None else until
    last_frames: set[int] = set()
    for policy in POLICIES:
        indices = policy.pick(times)
        indices = indices[indices < end]
        late = indices[times[indices] >= times[end - 1] - last_s - 1e-6]
        last_frames |= {int(i) for i in (late if late.size else indices[-1:])}
    return sorted(last_frames)


def last_of_all(n_frames: int, fps: int) -> int:
    """Return the last frame that every policy reaches: each ends on it or later."""
    times = np.arange(n_frames) / fps
    return min(int(policy.pick(times)[-1]) for policy in POLICIES)


def fewest_within(n_frames: int, fps: int, span: tuple[int, int]) -> int:
    """Return the fewest frames that any policy shows within a span (start, end)."""
    times = np.arange(n_frames) / fps
    return min(sum(span[0] <= int(i) < span[1] for i in policy.pick(times)) for policy in POLICIES)
