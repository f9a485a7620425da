"""One scene of the pocket model's data: drawn, simulated, and rendered in the few frames that the model sees."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from traps_pipeline.pocket.recipe import Jitter
from traps_pipeline.scenes import checks
from traps_pipeline.scenes.camera import HEIGHT, WIDTH, Camera, Panel, View, fit_camera, fit_shot, in_frame
from traps_pipeline.scenes.certificates import EARLIEST_CUT_S, settled_outcome, shown_points
from traps_pipeline.scenes.kit import Family, Wording
from traps_pipeline.scenes.outcome import Outcome, Rejected, compile_scene, decisive_geoms, simulated
from traps_pipeline.scenes.render import Renderer
from traps_pipeline.scenes.simulate import replay
from traps_pipeline.scenes.wording import draw_ill_posed
from traps_pipeline.storage.media import MediaSpec, pick

LATEST_CUT_S = 2.0  # released cuts lie between 1.1 and 2.0 s
CUT_BEFORE_COMMIT_S = 0.5
DECOY_BEHIND_M, DECOY_PX = 0.1, 2000.0  # a decoy stands so far behind all that is shown, and has so many pixels


@dataclass(frozen=True)
class Shot:
    """A simulated scene that was accepted as a pair."""

    family: Family
    params: Any
    wording: Wording
    qpos: np.ndarray
    outcome: Outcome
    camera: Camera
    panel: Panel | None
    cut_frame: int | None
    ill_posed_question: str
    places: dict[str, tuple[float, float]]
    control_from: int = 0
    void_length: int | None = None


def draw_shot(family: Family, rng: np.random.Generator, jitter: Jitter | None = None) -> Shot:
    """A random scene. Raises Rejected, as `scenes.resolve` does, when it gives no valid pair."""
    params = family.draw(rng)
    wording = family.word(params, rng)
    physics = family.physics
    model, scene = compile_scene(family, params, physics)
    qpos = simulated(model, scene, physics)
    motion = replay(model, qpos, physics)
    outcome = settled_outcome(family, motion, params)
    points = shown_points(model, scene, qpos)
    camera, panel = fit_shot(scene.view, points, scene.cover)
    if not in_frame(camera, points):
        raise Rejected("something decisive leaves the frame")
    cut = None if panel is not None else _draw_cut(outcome, physics.fps, rng)
    ill_posed = draw_ill_posed(family.taxonomy, scene.inventory, rng)
    start, held = (0, None) if cut is None or jitter is None else _jittered(jitter, len(qpos), cut, physics.fps, rng)
    frames = {"first": start, "last": len(qpos) - 1} | ({} if cut is None else {"cut": cut - 1})
    pixels = camera.project(motion.pos(scene.decisive[0])[list(frames.values())]) / (WIDTH, HEIGHT)
    places = {name: (round(float(x), 4), round(float(y), 4)) for name, (x, y) in zip(frames, pixels, strict=True)}
    return Shot(family, params, wording, qpos, outcome, camera, panel, cut, ill_posed, places, start, held)


def _draw_cut(outcome: Outcome, fps: int, rng: np.random.Generator) -> int:
    first, last = round(EARLIEST_CUT_S * fps) + 1, round(LATEST_CUT_S * fps)
    last = min(last, outcome.commit_frame - round(CUT_BEFORE_COMMIT_S * fps))
    if last < first:
        raise Rejected("the outcome is committed too early for a cut")
    return int(rng.integers(first, last + 1))


def _jittered(jitter: Jitter, n: int, cut: int, fps: int, rng: np.random.Generator) -> tuple[int, int | None]:
    """The first frame of a chaotic control, and the length of its void; (0, None) for clips as they are."""
    late, held = rng.random(2) < (jitter.control, jitter.void)
    short = int(rng.integers(round(EARLIEST_CUT_S * fps) + 1, round(LATEST_CUT_S * fps) + 1))
    # Held to the very end: of lengths in between there are no controls, so that they alone would tell a void.
    return (max(0, n - short) if late else 0), (n if held else None)


def render_shot(shot: Shot, spec: MediaSpec) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """The frames of control and void that the model is shown, each (N, 360, 480, 3) as two lists. Raises Rejected."""
    fps = shot.family.physics.fps
    shown = shot.control_from + pick(np.arange(len(shot.qpos) - shot.control_from) / fps, spec)
    model, scene = compile_scene(shot.family, shot.params, shot.family.physics, shot.panel)
    with Renderer(model, shot.camera) as renderer:
        control = list(renderer.frames(shot.qpos[shown]))
        if shot.cut_frame is not None:
            before = pick(np.arange(shot.void_length or shot.cut_frame) / fps, spec)
            return control, list(renderer.frames(shot.qpos[np.minimum(before, shot.cut_frame - 1)]))
        last = shot.qpos[-1:]
        decisive = decisive_geoms(model, scene.decisive)
        if checks.past_panel(renderer, last, decisive, scene.hidden).leaked(0):
            raise Rejected("the panel does not hide the outcome")
        return control, list(renderer.frames(shot.qpos[shown], panel=True))


def render_decoy(shot: Shot, spec: MediaSpec) -> list[np.ndarray] | None:
    """The frames of the control with the void's panel behind everything, seen by a camera that holds both; None if it
    hides anything decisive all the same, or is not seen itself."""
    if shot.panel is None:
        return None
    model, scene = compile_scene(shot.family, shot.params, shot.family.physics)
    points = shown_points(model, scene, shot.qpos)
    azimuth = np.radians(shot.camera.azimuth_deg)
    ahead = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
    behind = float((points @ ahead).max()) - float(np.array(shot.panel.centre) @ ahead) + DECOY_BEHIND_M
    x, y, z = (float(value) for value in np.array(shot.panel.centre) + ahead * behind)
    panel = replace(shot.panel, centre=(x, y, z))
    view = View(shot.camera.azimuth_deg, shot.camera.elevation_deg, shot.camera.fovy_deg)
    camera = fit_camera(view, np.concatenate([points, panel.corners()]))
    model, scene = compile_scene(shot.family, shot.params, shot.family.physics, panel)
    geoms = [*decisive_geoms(model, scene.decisive), *scene.hidden]
    shown = shot.qpos[pick(np.arange(len(shot.qpos)) / shot.family.physics.fps, spec)]
    with Renderer(model, camera) as renderer:
        seen = float(renderer.visible_pixels(shown[:1], ["cover_panel"], panel=True)[0, 0])
        without, beside = (renderer.visible_pixels(shown, geoms, panel=there) for there in (False, True))
        if seen < DECOY_PX or not np.array_equal(without, beside):
            return None
        return list(renderer.frames(shown, panel=True))
