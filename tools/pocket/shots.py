"""One scene of the pocket model's data: drawn, simulated, and rendered in the few frames that the model sees."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from tools.pocket.recipe import Jitter
from traps_pipeline.scenes.certification.certificates import EARLIEST_CUT_S, settled_outcome, shown_points
from traps_pipeline.scenes.draw.closing import moments, occluder_from
from traps_pipeline.scenes.parts.look import draw_look
from traps_pipeline.scenes.parts.wording import draw_ill_posed
from traps_pipeline.scenes.physics.kit import Family, View, Wording
from traps_pipeline.scenes.physics.simulate import replay
from traps_pipeline.scenes.picture import checks
from traps_pipeline.scenes.picture.camera import HEIGHT, WIDTH, Closing, fit_camera, fit_shot, is_in_frame
from traps_pipeline.scenes.picture.render import Renderer
from traps_pipeline.scenes.worlds.outcome import Outcome, Rejected, compile_scene, decisive_geoms, simulated
from traps_pipeline.scenes.worlds.pace import lengths, shortened
from traps_pipeline.scenes.worlds.world import World
from traps_pipeline.storage.media import MediaSpec, pick

LATEST_CUT_S = 2.0  # released cuts lie between 1.1 and 2.0 s
CUT_BEFORE_COMMIT_S = 0.5
LOOKS = frozenset({"floor"})  # of what may vary in a family, what varies here, so that a family's list changes no scene
DECOY_BEHIND_M, DECOY_PX = 0.1, 2000.0  # a decoy stands so far behind all that is shown, and has so many pixels


@dataclass(frozen=True, eq=False)
class Shot:
    """A simulated scene that was accepted as a pair. control: as in a released pair, with how it closes. control_span:
    the first frame of the control's clip and the one behind its last; void_length, places: as in `data.SceneRecord`."""

    control: World
    wording: Wording
    outcome: Outcome
    cut_frame: int | None
    ill_posed_question: str
    places: dict[str, tuple[float, float]]
    control_span: tuple[int, int]
    void_length: int | None

    def shown(self, first: int, length: int, spec: MediaSpec) -> np.ndarray:
        """Return the simulation's frames that the model is shown of a clip with so many frames, from one of them on."""
        return first + pick(np.arange(length) / self.control.physics.fps, spec)


def draw_shot(family: Family, rng: np.random.Generator, jitter: Jitter) -> Shot:
    """Return a random scene. Raises Rejected, as `scenes.draw.resolve` does, when it gives no valid pair."""
    params = family.draw(rng)
    wording = family.word(params, rng)
    if parts := LOOKS.intersection(family.looks):
        params = replace(params, look=draw_look(rng, parts))
    physics = family.physics
    model, scene = compile_scene(family, params, physics)
    qpos = simulated(model, scene, physics)
    motion = replay(model, qpos, physics)
    outcome = settled_outcome(family, motion, params)
    points = shown_points(model, scene, qpos)
    camera, occluder = fit_shot(scene.view, points, scene.cover)
    if not is_in_frame(camera, points):
        raise Rejected("something decisive leaves the frame")
    cut = None if occluder is not None else _draw_cut(outcome, physics.fps, rng)
    ill_posed = draw_ill_posed(family.taxonomy, scene.inventory, rng)
    # A draw has one length: to try another one would take a certificate that says so.
    world, seed = World(family, params, physics, qpos, camera, occluder), int(rng.integers(2**31))
    control = _closed(shortened(world, lengths((world,), seed)[0]), seed)
    if control.outcome.label != outcome.label:
        raise Rejected("the clip ends before its outcome")
    span, held = (0, len(control.qpos)), None
    if cut is not None:
        span, held = _jittered(jitter, control, rng)
    frames = {"first": span[0], "last": min(span[1], control.open_frames) - 1}
    frames |= {} if cut is None else {"cut": cut - 1}
    pixels = camera.project(motion.pos(scene.decisive[0])[list(frames.values())]) / (WIDTH, HEIGHT)
    places = {name: (round(float(x), 4), round(float(y), 4)) for name, (x, y) in zip(frames, pixels, strict=True)}
    return Shot(control, wording, outcome, cut, ill_posed, places, span, held)


def _closed(control: World, seed: int) -> World:
    """Return the control as those of released scenarios end (`scenes.draw.closing`), but without a certificate: only
    the first and the last frame behind the occluder are looked at. The control as it is if no occluder can close it."""
    for frame in moments((control,), seed):
        closing = replace(control, closing=Closing(frame, occluder_from(frame, control)))
        with closing.closed_renderer() as renderer:
            if not renderer.visible_pixels(control.qpos[[frame, -1]], closing.closed_geoms, occluder=True).any():
                return closing
    return control


def _draw_cut(outcome: Outcome, fps: int, rng: np.random.Generator) -> int:
    first, last = round(EARLIEST_CUT_S * fps) + 1, round(LATEST_CUT_S * fps)
    last = min(last, outcome.commit_frame - round(CUT_BEFORE_COMMIT_S * fps))
    if last < first:
        raise Rejected("the outcome is committed too early for a cut")
    return int(rng.integers(first, last + 1))


def _jittered(jitter: Jitter, control: World, rng: np.random.Generator) -> tuple[tuple[int, int], int | None]:
    """Return the frames of a chaotic control's clip, and the length of its void; the whole control and None for clips
    as they are."""
    fps, n = control.physics.fps, len(control.qpos)
    short, held = rng.random(2) < (jitter.control, jitter.void)
    length = int(rng.integers(round(EARLIEST_CUT_S * fps) + 1, round(LATEST_CUT_S * fps) + 1))
    # A short control ends before the board comes into the picture: on its way it may cover the outcome. A void is held
    # to the very end: of lengths in between there are no controls, so that they alone would tell a void.
    end = next((i for i, offset in enumerate(control.board) if offset is not None), n)
    return (end - length, end) if short else (0, n), (n if held else None)


def render_shot(shot: Shot, spec: MediaSpec) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Return the frames of control and void that the model is shown, each (N, 360, 480, 3) as two lists. Raises
    Rejected.

    A void that is held closes when its control does: else the occluder alone would tell the sides of a chaotic pair.
    """
    control = shot.control
    qpos = control.qpos
    first, end = shot.control_span
    shown = shot.shown(first, end - first, spec)
    with control.closed_renderer() as renderer:
        if shot.cut_frame is not None:
            before = shot.shown(0, shot.void_length or shot.cut_frame, spec)
            held = qpos[np.minimum(before, shot.cut_frame - 1)]
            void = list(checks.closing_frames(renderer, held, [control.board[i] for i in before]))
            return list(checks.closing_frames(renderer, qpos[shown], [control.board[i] for i in shown])), void
        if control.closing is None and renderer.visible_pixels(qpos[-1:], control.concealed_geoms, occluder=True).any():
            raise Rejected("the occluder does not hide the outcome")
        board = [control.board[i] for i in shown]
        drawn = int((shown < control.open_frames).sum())
        hidden = list(checks.closing_frames(renderer, qpos[shown], board, occluder=True))
        return [*checks.closing_frames(renderer, qpos[shown[:drawn]], board[:drawn]), *hidden[drawn:]], hidden


def render_decoy(shot: Shot, spec: MediaSpec) -> list[np.ndarray] | None:
    """Return the frames of the control, which no occluder closes, with the void's occluder behind everything, seen by a
    camera that holds both; None if it hides anything decisive all the same, or is not seen itself."""
    control = shot.control
    if control.occluder is None:
        return None
    points = shown_points(control.model, control.scene, control.qpos)
    azimuth = np.radians(control.camera.azimuth_deg)
    ahead = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
    centre = np.array(control.occluder.centre)
    behind = float((points @ ahead).max()) - float(centre @ ahead) + DECOY_BEHIND_M
    x, y, z = (float(value) for value in centre + ahead * behind)
    occluder = replace(control.occluder, centre=(x, y, z))
    view = View(control.camera.azimuth_deg, control.camera.elevation_deg, control.camera.fovy_deg)
    camera = fit_camera(view, np.concatenate([points, occluder.corners()]))
    model, scene = compile_scene(control.family, control.params, control.physics, occluder)
    geoms: Sequence[str] = [*decisive_geoms(model, scene.decisive), *scene.hidden]
    shown = control.qpos[shot.shown(0, len(control.qpos), spec)]
    with Renderer(model, camera) as renderer:
        seen = float(renderer.visible_pixels(shown[:1], ["occluder"], occluder=True)[0, 0])
        ends = shown[[0, -1]]
        without, beside = (renderer.visible_pixels(ends, geoms, occluder=there) for there in (False, True))
        if seen < DECOY_PX or not np.array_equal(without, beside):
            return None
        return list(renderer.frames(shown, occluder=True))
