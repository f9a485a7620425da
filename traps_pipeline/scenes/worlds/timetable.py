"""Decide when the boards of a lane stand, come and go, and when they show what they hide."""

from dataclasses import dataclass

import numpy as np

from traps_pipeline.video.policies import fewest_within

MOVES_FRAMES = 4  # that a board takes to come or to go (0.4 s)
WINDOW_FRAMES = 10  # least time without the board, once the outcome has settled (1 s)
WINDOW_SHOWN = 2  # frames of the window that each model is shown, at least


@dataclass(frozen=True)
class Timetable:
    """The times at which a board stands: spans of frames [start, stop), with a move before and after each.

    A span that begins at frame 0, or ends with the clip, has no move there.
    """

    spans: tuple[tuple[int, int], ...]

    def away(self, n_frames: int) -> np.ndarray:
        """Return how far away the board is in each frame, 0 (it stands) to 1 (it is gone), (F,)."""
        frames = np.arange(n_frames)
        steps = np.full(n_frames, MOVES_FRAMES, float)
        for start, stop in self.spans:
            steps = np.minimum(steps, np.maximum(np.maximum(start - frames, frames - stop + 1), 0))
        return (steps / MOVES_FRAMES) ** 2  # it falls, and rises as it fell

    def window(self, first: int, n_frames: int) -> tuple[int, int]:
        """Return the longest span of frames from a frame on in which the board is gone."""
        open_frames = np.flatnonzero(self.away(n_frames)[first:] == 1) + first
        runs = np.split(open_frames, np.flatnonzero(np.diff(open_frames) > 1) + 1)
        run = max(runs, key=len)
        return (int(run[0]), int(run[-1]) + 1) if len(run) else (first, first)

    def shows(self, first: int, n_frames: int, fps: int) -> bool:
        """Return whether a window from a frame on is long enough, for each model too."""
        start, stop = self.window(first, n_frames)
        return stop - start >= WINDOW_FRAMES and fewest_within(n_frames, fps, (start, stop)) >= WINDOW_SHOWN
