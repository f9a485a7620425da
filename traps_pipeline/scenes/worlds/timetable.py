"""Decide when the boards of a lane stand, come and go, and when they show what they hide."""

from dataclasses import dataclass

import numpy as np

from traps_pipeline.video.policies import fewest_within

MOVES_FRAMES = 4  # that a board takes to come or to go (0.4 s)
WINDOW_S = 1.0  # least time without the board, once the outcome has settled, but where a draw says less
WINDOW_SHOWN = 2  # frames of such a window that each model is shown, at least


@dataclass(frozen=True)
class Timetable:
    """The times at which a board stands: spans of frames [start, stop), with a move before and after each.

    A span that begins at frame 0, or ends with the clip, has no move there.
    """

    spans: tuple[tuple[int, int], ...]

    @classmethod
    def of_window(cls, first: int, frames: int, n_frames: int) -> "Timetable":
        """Return the timetable by which the board is away for some frames alone."""
        return cls(((0, first - MOVES_FRAMES + 1), (first + frames + MOVES_FRAMES - 1, n_frames)))

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

    def shows(self, first: int, n_frames: int, fps: int, window_s: float = WINDOW_S) -> bool:
        """Return whether a window from a frame on is long enough, for each model too where it is not a short one."""
        start, stop = self.window(first, n_frames)
        least = WINDOW_SHOWN if window_s >= WINDOW_S else 0
        return stop - start >= round(window_s * fps) and fewest_within(n_frames, fps, (start, stop)) >= least
