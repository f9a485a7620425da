"""Certify a world of two lanes: what its four clips show, and what none of them does."""

import time
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from traps_pipeline.protocol.two_events import CLIPS, LANES
from traps_pipeline.scenes.certification.certify_record import Verdict
from traps_pipeline.scenes.physics.kit import flag_of
from traps_pipeline.scenes.picture.camera import HEIGHT
from traps_pipeline.scenes.picture.render import Renderer
from traps_pipeline.scenes.worlds.lane_event import geom_corners
from traps_pipeline.scenes.worlds.lane_records import TwoEventsSpec
from traps_pipeline.scenes.worlds.lanes import PLACES, TwoLanes, board_of
from traps_pipeline.scenes.worlds.outcome import Rejected
from traps_pipeline.video.encode import frames_digest

LEAST_PX = {"outcome": 75.0, "doubles": 40.0, "flag": 25.0, "strip": 100.0}  # of what must be seen
SHARES = (0.0, 0.2, 0.4, 0.6, 0.8, 1.0)  # of the clip, at which a record keeps what is in view
EVERY = 2  # frames of which one is counted
PX_APART, SHARE_APART = 4.0, 0.02  # that another renderer may count


def certify_lane_record(spec: TwoEventsSpec, worlds: Mapping[str, np.ndarray]) -> Verdict:
    """Return the verdict on a record of two events, from its trajectories alone (worlds: by name)."""
    start_s, failures, evidence = time.process_time(), dict[str, str](), dict[str, Any]()
    world, *twins = (spec.world(worlds[name], k) for name, k in (("qpos", None), *((LANES[k], k) for k in range(2))))
    try:
        evidence = certify_lanes(world, twins, every=1)
    except Rejected as failure:
        failures["lanes"] = str(failure)
    else:
        failures |= _contradictions(spec, world, twins, evidence)
    with Renderer(world.model, world.camera) as renderer:
        seen, hidden = (frames_digest([*renderer.frames(world.clip(CLIPS[name])[-1:])]) for name in ("neither", "both"))
    is_same, cpu_s = all(np.array_equal(each.simulated, each.qpos) for each in (world, *twins)), time.process_time()
    return Verdict(spec.scenario_id, spec.family, failures, evidence, is_same, seen, hidden, cpu_s=cpu_s - start_s)


def _contradictions(
    spec: TwoEventsSpec, world: TwoLanes, twins: Sequence[TwoLanes], evidence: Mapping[str, Any]
) -> dict[str, str]:
    """Return how a record contradicts what its trajectories show."""
    failures = {}
    for k, record in enumerate(spec.lanes):
        answers = {"ground_truth": (record.ground_truth, world), "twin": (record.twin.ground_truth, twins[k])}
        for name, (answer, each) in answers.items():
            if each.outcome(k).label != answer:
                failures[name] = f"{LANES[k]}: the outcome is {each.outcome(k).label!r}, the record says {answer!r}"
    for name, value in evidence.items():
        stored = spec.evidence.get(name)
        if not _is_alike(value, stored):
            failures[name] = f"is {value}, the record says {stored}"
    return failures


def _is_alike(value: Any, stored: Any) -> bool:
    """Return whether a record holds the same evidence, counts of pixels but for the renderer's part in them."""
    if isinstance(value, dict):
        return isinstance(stored, dict) and {*value} == {*stored} and all(_is_alike(value[k], stored[k]) for k in value)
    if isinstance(value, list):
        return isinstance(stored, list) and len(value) == len(stored) and all(map(_is_alike, value, stored))
    if isinstance(value, float) and isinstance(stored, float):
        return abs(value - stored) <= PX_APART + SHARE_APART * abs(stored)
    return type(value) is type(stored) and value == stored


def certify_lanes(world: TwoLanes, twins: Sequence[TwoLanes], every: int = EVERY) -> dict[str, Any]:
    """Return the evidence of a world of two lanes; twins: the worlds where one lane differs. Raises Rejected.

    every: one of so many frames is compared with the twin's. Each lane ends as by itself, and its twin otherwise; a
    window shows the settled outcome; boards pass through nothing; what decides is hidden before that, and the doubles
    of a seen lane; strips are always seen; the clips in which a lane is hidden are those of its twin, and show of the
    other lane what the others show.
    """
    evidence = _outcomes(world, twins)
    _check_places(world)
    _check_twins(world, twins, every)
    return evidence | _seen(world)


def _outcomes(world: TwoLanes, twins: Sequence[TwoLanes]) -> dict[str, Any]:
    settled = []
    for k, lane in enumerate(world.lanes):
        outcomes = [(each.outcome(k), each.events[k]) for each in (world, twins[k])]
        for outcome, event in outcomes:
            if outcome.label != event.outcome.label or outcome.label is None:
                raise Rejected(f"{LANES[k]}: the outcome is {outcome.label!r}, by itself {event.outcome.label!r}")
            if outcome.margin_m < event.family.min_margin_m:
                raise Rejected(f"{LANES[k]}: the margin is {outcome.margin_m:.4f} m")
        if len({outcome.label for outcome, _ in outcomes}) < 2:
            raise Rejected(f"{LANES[k]}: the twin has the same outcome")
        settled.append(max(outcome.commit_frame for outcome, _ in outcomes))
        if not lane.timetable.shows(settled[-1], len(world.qpos), world.physics.fps, lane.window_s):
            raise Rejected(f"{LANES[k]}: no window of {lane.window_s:g} s shows the settled outcome")
    return {"settled_frames": settled}


def _check_places(world: TwoLanes) -> None:
    """Check that boards pass through nothing, and that each lane stays in its half of the picture."""
    camera, boards = world.camera, [board_of(lane, place) for lane in LANES for place in PLACES]
    for pose in (geom_corners(world.model, row) for row in world.qpos[::5]):
        for name, corners in pose.items():
            columns, rows = camera.project(corners).T
            left = name.removeprefix("board ").startswith(LANES[0])
            low, high = (0, camera.width / 2) if left else (camera.width / 2, camera.width)
            if columns.min() < low or columns.max() > high or rows.min() < 0 or rows.max() > HEIGHT:
                raise Rejected(f"{name} is not in its half of the picture")
        for board in boards:
            least, most = pose[board].min(axis=0), pose[board].max(axis=0)
            for name, corners in pose.items():
                is_on_its_way = (corners.max(axis=0) > least).all() and (corners.min(axis=0) < most)[:2].all()
                if name not in boards and is_on_its_way:
                    raise Rejected(f"{board} passes through {name}")


def _check_twins(world: TwoLanes, twins: Sequence[TwoLanes], every: int) -> None:
    clips, half = _drawn(world, tuple(CLIPS), every), world.camera.width // 2
    for name, hidden in CLIPS.items():
        for is_hidden, part in zip(hidden, (slice(0, half), slice(half, None)), strict=True):
            if not np.array_equal(clips[name][:, :, part], clips["both" if is_hidden else "neither"][:, :, part]):
                raise Rejected(f"{name}: what is hidden in one lane changes pixels of the other")
    for k, twin in enumerate(twins):
        voids = [name for name, hidden in CLIPS.items() if hidden[k]]
        for name, frames in _drawn(twin, voids, every).items():
            if not np.array_equal(frames, clips[name]):
                raise Rejected(f"{LANES[k]}: the twin's clip `{name}` is another, though the lane is hidden")


def _drawn(world: TwoLanes, names: Sequence[str], every: int) -> dict[str, np.ndarray]:
    with Renderer(world.model, world.camera) as renderer:
        return {name: np.stack([*renderer.frames(world.clip(CLIPS[name])[::every])]) for name in names}


def pixels_of(world: TwoLanes, clip: str, geoms: Sequence[str], frames: Sequence[int] | slice) -> np.ndarray:
    """Return the number of pixels that each geom shows in some frames of a clip, (F, G)."""
    with Renderer(world.model, world.camera, supersample=1) as renderer:
        return renderer.visible_pixels(world.clip(CLIPS[clip])[frames], geoms)


def _seen(world: TwoLanes) -> dict[str, Any]:
    frames = np.arange(0, len(world.qpos), EVERY)
    at = np.rint(np.array(SHARES) * (len(frames) - 1)).astype(int)
    names = [world.model.geom(i).name for i in range(world.model.ngeom)]
    seen = {clip: pixels_of(world, clip, names, slice(None, None, EVERY)) for clip in ("neither", "both")}

    def px(clip: str, wanted: Sequence[str]) -> np.ndarray:
        return seen[clip][:, [names.index(name) for name in wanted]].sum(axis=1)

    evidence: dict[str, list[Any]] = {"least_px": [], "hidden_from": [], "in_view": []}
    for k, (lane, event) in enumerate(zip(world.lanes, world.events, strict=True)):
        commit, decisive, doubles = world.outcome(k).commit_frame, world.decisive(k), world.doubles(k)
        start, stop = lane.timetable.window(commit, len(world.qpos))
        window = (frames >= start) & (frames < stop)
        flags = [f"{LANES[k]} {flag_of(mark)}" for mark in event.scene.marks]
        least = {
            "outcome": float(px("neither", decisive)[window].min()),
            "doubles": float(px("both", doubles)[window].min()),
            "flag": min([float(px("both", [flag]).max()) for flag in flags], default=LEAST_PX["flag"]),
            "strip": float(min(px(clip, [f"{LANES[k]} lane strip"]).min() for clip in seen)),
        }
        for name, value in least.items():
            if value < LEAST_PX[name]:
                raise Rejected(f"{LANES[k]}: {name} has {value:.0f} pixels, {LEAST_PX[name]:.0f} are wanted")
        hidden_from = []
        for clip, geoms in (("both", decisive), ("neither", doubles)):
            visible = np.flatnonzero(px(clip, geoms))
            hidden_from.append(int(frames[visible[-1]]) + EVERY if visible.size else 0)
        if hidden_from[0] > commit or hidden_from[1] > start or px("both", world.hidden_element(k)).any():
            raise Rejected(f"{LANES[k]}: a board does not hide what it should")
        evidence["least_px"].append(least)
        evidence["hidden_from"].append(hidden_from)
        parts = {"alike_px": [*decisive, *doubles], "board_px": [board_of(LANES[k], place) for place in PLACES]}
        sides = {"seen": "neither", "hidden": "both"}
        evidence["in_view"].append(
            {
                side: {part: px(clip, geoms)[at].tolist() for part, geoms in parts.items()}
                for side, clip in sides.items()
            }
        )
    return evidence
