"""How long a clip is: its outcome settles neither at its beginning, so that watching on were idle, nor at its very end.

A scene is simulated for as long as its family says. Where the outcome settles early the clip ends earlier, void and
control alike, so that its length tells nothing of the side. A clip is never longer than its family's: 25 frames of five
a second are what models are shown. So where the outcome settles too late the scene is drawn anew.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from traps_pipeline.scenes.physics.kit import Physics
from traps_pipeline.scenes.worlds.world import World

EARLIEST_SHARE = 0.3  # of the clip's frames, before the outcome settles
LATEST_SHARE = 0.8
DRAWN_SHARE = 0.5  # in a clip that ends earlier the outcome settles after a share between the earliest and this
FRAMES_AFTER = 16  # to see the outcome for a second, and a panel before it until the end


def settles_share(commit_frame: int, n_frames: int) -> float:
    """After which share of a clip's frames its outcome settles."""
    return commit_frame / n_frames


def out_of_pace(share: float) -> str | None:
    """What is wrong with an outcome that settles after a share of a clip."""
    if share < EARLIEST_SHARE:
        return f"the outcome settles after {share:.0%} of the clip, {EARLIEST_SHARE:.0%} is wanted"
    if share > LATEST_SHARE:
        return f"the outcome settles after {share:.0%} of the clip, {LATEST_SHARE:.0%} at most is wanted"
    return None


def lengths(control: World, seed: int) -> list[int]:
    """Numbers of frames to try for a clip of a simulated control, best first: all that there are, or for an early
    outcome an even number that follows from the seed, and then the most."""
    commit, n_frames = control.outcome.commit_frame, len(control.qpos)
    if control.outcome.label is None or settles_share(commit, n_frames) >= EARLIEST_SHARE:
        return [n_frames]
    fps = control.physics.fps
    most = _even(commit / EARLIEST_SHARE)
    least = min(most, _even(max(commit / DRAWN_SHARE, commit + FRAMES_AFTER * fps / 10)))
    rng = np.random.default_rng([seed, *control.family.name.encode(), *b"pace"])
    drawn = least + 2 * int(rng.integers((most - least) // 2 + 1))
    return list(dict.fromkeys((drawn, most)))


def _even(frames: float) -> int:
    """The largest even number of frames that is not more than so many."""
    return 2 * int(frames / 2 + 1e-9)


def cut_to(world: World, n_frames: int) -> World:
    """The world's first frames, as a clip of its own."""
    if n_frames == len(world.qpos):
        return world
    simulated = None if world.simulated is None else world.simulated[:n_frames]
    physics = with_length(world.physics, n_frames)
    return replace(world, physics=physics, qpos=world.qpos[:n_frames], simulated=simulated)


def with_length(physics: Physics, n_frames: int) -> Physics:
    """The settings of a clip of so many frames."""
    return replace(physics, duration_s=round(n_frames / physics.fps, 6))
