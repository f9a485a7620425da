"""Decide how long a clip is, and when it closes.

Where the outcome settles early, void and control end earlier; where too late, the scene is drawn anew. Both worlds of
an occlusion pair count alike (docs/design/twins.md).
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from traps_pipeline.protocol.datasets import EXTENSION_CATEGORIES
from traps_pipeline.scenes.parts.readings import still_from
from traps_pipeline.scenes.physics.kit import Family, Physics
from traps_pipeline.scenes.worlds.world import World
from traps_pipeline.video.policies import last_of_all

EARLIEST_SHARE = 0.3  # of the clip's frames, before the outcome settles
LATEST_SHARE = 0.8
DRAWN_SHARE = 0.5  # in a clip that ends earlier the outcome settles after a share between the earliest and this
FRAMES_AFTER = 16  # to see the outcome for a second, and an occluder before it until the end
IN_VIEW_S = 0.8  # least time that a settled outcome is visible before the control closes
DRAWN_OUTCOME_VIEW_S = 1.0  # so long it is in view where there is time for it
DRAWN_REST_S = 0.6  # so long it has been at rest by then: three frames of five a second
STILL_M = 0.005  # a pixel or two
BESIDE_M = 0.03  # from the middle of a body to the points by which it is seen to turn
TRIES = 4  # moments at which it is tried to close a control


def settles_share(commit_frame: int, n_frames: int) -> float:
    """Return the share of a clip's frames after which its outcome settles."""
    return commit_frame / n_frames


def out_of_pace(share: float) -> str | None:
    """Return in words why an outcome settles too early or late in a clip; None if it does not."""
    if share < EARLIEST_SHARE:
        return f"the outcome settles after {share:.0%} of the clip, {EARLIEST_SHARE:.0%} is wanted"
    if share > LATEST_SHARE:
        return f"the outcome settles after {share:.0%} of the clip, {LATEST_SHARE:.0%} at most is wanted"
    return None


def is_exchangeable(family: Family) -> bool:
    """Return whether both worlds of a family's pairs count.

    Of soft bodies the control alone does: one world settles in twice the other's time.
    """
    return family.category not in EXTENSION_CATEGORIES


def _counting_worlds(worlds: Sequence[World]) -> Sequence[World]:
    return worlds if is_exchangeable(worlds[0].family) else worlds[:1]


def lengths(worlds: Sequence[World], seed: int) -> list[int]:
    """Return the numbers of frames to try for a clip of simulated worlds, best first.

    Those are all that there are, or, where the outcome of one world is early, an even number drawn by seed, and then
    the most.
    """
    worlds = _counting_worlds(worlds)
    n_frames, fps = len(worlds[0].qpos), worlds[0].physics.fps
    first, last = (of(world.outcome.commit_frame for world in worlds) for of in (min, max))
    if None in [world.outcome.label for world in worlds] or settles_share(first, n_frames) >= EARLIEST_SHARE:
        return [n_frames]
    max_frames = _even(first / EARLIEST_SHARE)
    min_frames = min(max_frames, _even(max(last / DRAWN_SHARE, last + FRAMES_AFTER * fps / 10)))
    rng = np.random.default_rng([seed, *worlds[0].family.name.encode(), *b"pace"])
    length = min_frames + 2 * int(rng.integers((max_frames - min_frames) // 2 + 1))
    return list(dict.fromkeys((length, max_frames)))


def moments(worlds: Sequence[World], seed: int) -> Iterator[int]:
    """Yield the frames at which an occluder may close a control; none if it cannot.

    All outcomes have been in view and at rest for long enough; after those, or where there is no time for that, comes
    the last possible frame.
    """
    worlds = _counting_worlds(worlds)
    fps, commit = worlds[0].physics.fps, max(world.outcome.commit_frame for world in worlds)
    last = last_of_all(len(worlds[0].qpos), fps)
    if last - commit < round(IN_VIEW_S * fps):
        return
    rest_frame = max(map(_at_rest_from, worlds)) + round(DRAWN_REST_S * fps)
    first = min(max(commit + round(DRAWN_OUTCOME_VIEW_S * fps), rest_frame), last)
    rng = np.random.default_rng([seed, *worlds[0].family.name.encode(), *b"closing"])
    frames = [int(frame) for frame in rng.permutation(np.arange(first, last + 1))]
    yield from dict.fromkeys([*frames[: TRIES - 1], last])


def _at_rest_from(world: World) -> int:
    """Return the frame from which all decisive bodies stay in place, and unturned."""
    paths = [world.motion.places(body, BESIDE_M) for body in world.scene.decisive]
    return still_from(*paths, within_m=STILL_M)


def _even(frames: float) -> int:
    """Return the largest even number of frames up to a number."""
    return 2 * int(frames / 2 + 1e-9)


def shortened(world: World, n_frames: int) -> World:
    """Return the world's first frames, as a clip of its own."""
    if n_frames == len(world.qpos):
        return world
    simulated_qpos = None if world.simulated is None else world.simulated[:n_frames]
    physics = with_length(world.physics, n_frames)
    return replace(world, physics=physics, qpos=world.qpos[:n_frames], simulated=simulated_qpos)


def with_length(physics: Physics, n_frames: int) -> Physics:
    """Return the settings of a clip with this number of frames."""
    return replace(physics, duration_s=round(n_frames / physics.fps, 6))
