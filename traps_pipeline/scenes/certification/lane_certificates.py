"""Certify a world of two lanes: what is seen in its four clips, and what never is.

Each check returns the numbers that it judged, or raises Rejected. All are measured on both worlds of each lane.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from traps_pipeline.scenes.physics.kit import flag_of
from traps_pipeline.scenes.picture.camera import HEIGHT
from traps_pipeline.scenes.picture.render import Renderer
from traps_pipeline.scenes.worlds.lane_records import CLIPS
from traps_pipeline.scenes.worlds.lanes import LANES, PLACES, TwoLanes, board_of, geom_corners
from traps_pipeline.scenes.worlds.outcome import Rejected

OUTCOME_PX = 75.0  # of what decides, in each frame of the window
DOUBLE_PX = 40.0  # of the doubles, in each frame of the window of a hidden lane
STRIP_PX = 100.0  # of a lane's strip, in every frame
FLAG_PX = 25.0  # of each flag, in a hidden lane's first frame without a moving board
SHARES = (0.0, 0.2, 0.4, 0.6, 0.8, 1.0)  # of the clip, at which the record keeps what is in view
EVERY = 2  # frames of which one is drawn


def certify_lanes(world: TwoLanes, twins: Sequence[TwoLanes]) -> dict[str, Any]:
    """Return a world's evidence; twins: the worlds with the twin in the left and in the right lane. Raises Rejected."""
    evidence = _outcomes(world, twins)
    _check_places(world)
    return evidence | _seen(world) | _twins(world, twins)


def decisive_pixels(world: TwoLanes, lane: int) -> float:
    """Return the pixels of what decides a lane's outcome at the end, where the lane is seen."""
    return _pixels(world, "neither", world.geoms(lane, hidden_element=False), lane)


def double_pixels(world: TwoLanes, lane: int) -> float:
    """Return the pixels of a lane's doubles at the end, where the lane is hidden."""
    return _pixels(world, "both", world.doubles(lane), lane)


def _pixels(world: TwoLanes, clip: str, names: Sequence[str], lane: int) -> float:
    settled = world.outcome(lane).commit_frame
    start, stop = world.lanes[lane].timetable.window(settled, len(world.qpos))
    with Renderer(world.model, world.camera, supersample=1) as renderer:
        return (
            float(renderer.visible_pixels(world.clip(CLIPS[clip])[stop - 1 : stop], names).sum())
            if stop > start
            else 0.0
        )


def _outcomes(world: TwoLanes, twins: Sequence[TwoLanes]) -> dict[str, Any]:
    settled = []
    for k, (lane, event, twin) in enumerate(zip(world.lanes, world.events, twins, strict=True)):
        outcomes = [world.outcome(k), twin.outcome(k)]
        for outcome, alone in zip(outcomes, (event.outcome, twin.events[k].outcome), strict=True):
            if outcome.label is None or outcome.label != alone.label:
                raise Rejected(
                    f"{LANES[k]}: the outcome is {outcome.label!r} beside the other lane, {alone.label!r} alone"
                )
            if outcome.margin_m < event.family.min_margin_m:
                raise Rejected(f"{LANES[k]}: the margin is {outcome.margin_m:.4f} m")
        if outcomes[0].label == outcomes[1].label:
            raise Rejected(f"{LANES[k]}: the twin has the same outcome")
        settled.append(max(outcome.commit_frame for outcome in outcomes))
        if not lane.timetable.shows(settled[-1], len(world.qpos), world.physics.fps):
            raise Rejected(f"{LANES[k]}: no window of a second shows the settled outcome")
    return {"settled_frames": settled}


def _check_places(world: TwoLanes) -> None:
    """Check that boards pass through nothing, and that each lane stays in its half of the picture."""
    model, camera = world.model, world.camera
    poses = [geom_corners(model, row) for row in world.qpos[::5]]
    names = [board_of(lane, place) for lane in LANES for place in PLACES]
    edge = camera.width / 2
    for pose in poses:
        for name, corners in pose.items():
            columns, rows = camera.project(corners).T
            is_left = name.removeprefix("board ").startswith(LANES[0])
            if (columns.max() > edge) if is_left else (columns.min() < edge):
                raise Rejected(f"{name} reaches into the other lane's half of the picture")
            if columns.min() < 0 or columns.max() > camera.width or rows.max() > HEIGHT or rows.min() < 0:
                raise Rejected(f"{name} is not in the picture")
        for board in names:
            low, high = pose[board].min(axis=0), pose[board].max(axis=0)
            for name, corners in pose.items():
                is_there = (corners.max(axis=0) > low)[:2].all() and (corners.min(axis=0) < high)[:2].all()
                if name not in names and is_there and corners[:, 2].max() > low[2] + 1e-6:
                    raise Rejected(f"{board} passes through {name}")


def _seen(world: TwoLanes) -> dict[str, Any]:
    n_frames = len(world.qpos)
    frames = np.arange(0, n_frames, EVERY)
    geoms = [world.geoms(k) for k in range(len(LANES))]
    decisive = [world.geoms(k, hidden_element=False) for k in range(len(LANES))]
    flags = [
        [f"{name} {flag_of(mark)}" for mark in event.scene.marks]
        for name, event in zip(LANES, world.events, strict=True)
    ]
    strips = [f"{name} lane mark" for name in LANES]
    boards = [[board_of(name, place) for place in PLACES] for name in LANES]
    names = list(
        dict.fromkeys(
            [n for k in range(len(LANES)) for n in (*geoms[k], *world.doubles(k), *flags[k], *boards[k])] + strips
        )
    )
    with Renderer(world.model, world.camera, supersample=1) as renderer:
        seen = {clip: renderer.visible_pixels(world.clip(CLIPS[clip])[frames], names) for clip in ("neither", "both")}

    def px(clip: str, wanted: Sequence[str]) -> np.ndarray:
        return seen[clip][:, [names.index(name) for name in wanted]].sum(axis=1)

    at = np.rint(np.array(SHARES) * (len(frames) - 1)).astype(int)
    evidence: dict[str, Any] = {
        "outcome_px": [],
        "double_px": [],
        "hidden_from": [],
        "doubles_hidden_from": [],
        "flag_px": [],
        "in_view": [],
    }
    for k, lane in enumerate(world.lanes):
        commit = world.outcome(k).commit_frame
        start, stop = lane.timetable.window(commit, n_frames)
        window = (frames >= start) & (frames < stop)
        evidence["outcome_px"].append(float(px("neither", decisive[k])[window].min()))
        evidence["double_px"].append(float(px("both", world.doubles(k))[window].min()))
        visible = np.flatnonzero(px("both", decisive[k]))
        evidence["hidden_from"].append(int(frames[visible[-1]]) + EVERY if visible.size else 0)
        element = [name for name in geoms[k] if name not in decisive[k]]
        evidence["flag_px"].append([float(px("both", [flag]).max()) for flag in flags[k]])
        evidence["in_view"].append(
            {
                side: {
                    "alike_px": px(clip, [*decisive[k], *world.doubles(k)])[at].tolist(),
                    "board_px": px(clip, boards[k])[at].tolist(),
                }
                for side, clip in (("seen", "neither"), ("hidden", "both"))
            }
        )
        if evidence["outcome_px"][-1] < OUTCOME_PX:
            raise Rejected(f"{LANES[k]}: the outcome has {evidence['outcome_px'][-1]:.0f} pixels in its window")
        if evidence["double_px"][-1] < DOUBLE_PX:
            raise Rejected(f"{LANES[k]}: the doubles have {evidence['double_px'][-1]:.0f} pixels")
        if evidence["hidden_from"][-1] > commit or px("both", element).any():
            raise Rejected(f"{LANES[k]}: the board does not hide what decides")
        seen_last = np.flatnonzero(px("neither", world.doubles(k)))
        evidence["doubles_hidden_from"].append(int(frames[seen_last[-1]]) + EVERY if seen_last.size else 0)
        if evidence["doubles_hidden_from"][-1] > start:
            raise Rejected(f"{LANES[k]}: the board does not hide the doubles")
        if min(evidence["flag_px"][-1], default=FLAG_PX) < FLAG_PX:
            raise Rejected(f"{LANES[k]}: a flag has {min(evidence['flag_px'][-1]):.0f} pixels")
    evidence["strip_px"] = float(min(px(clip, [strip]).min() for clip in seen for strip in strips))
    if evidence["strip_px"] < STRIP_PX:
        raise Rejected(f"a strip has {evidence['strip_px']:.0f} pixels in some frame")
    return evidence


def _twins(world: TwoLanes, twins: Sequence[TwoLanes]) -> dict[str, Any]:
    """Check that the clips in which a lane is hidden are those of its twin, and leave the other lane as it is."""
    frames = np.arange(0, len(world.qpos), EVERY)
    clips = _drawn(world, frames)
    half = world.camera.width // 2
    parts = (slice(0, half), slice(half, None))
    for name, hidden in CLIPS.items():
        for k, part in enumerate(parts):
            alike = clips["both" if hidden[k] else "neither"]
            if not np.array_equal(clips[name][:, :, part], alike[:, :, part]):
                raise Rejected(f"{name}: what is hidden in one lane changes pixels of the other")
    for k, twin in enumerate(twins):
        if not np.array_equal(_drawn(twin, frames, ("both",))["both"], clips["both"]):
            raise Rejected(f"{LANES[k]}: the twin's clip is another where the lane is hidden")
    return {"twin_px": 0}


def _drawn(world: TwoLanes, frames: np.ndarray, names: Sequence[str] = tuple(CLIPS)) -> dict[str, np.ndarray]:
    with Renderer(world.model, world.camera) as renderer:
        return {name: np.stack([*renderer.frames(world.clip(CLIPS[name])[frames])]) for name in names}
