"""Render a scenario's clips from its frozen trajectory, without simulation.

Occluder: the void is the same replay with the occluder drawn. Truncation: the void is a prefix of the control. A
board comes before a control that closes, and before its void if an occluder makes it; the twin's clip never has one.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from traps_pipeline.scenes.family_registry import get_family
from traps_pipeline.scenes.physics.kit import Family, Physics, Scene
from traps_pipeline.scenes.picture import checks
from traps_pipeline.scenes.picture.camera import Camera, Occluder
from traps_pipeline.scenes.picture.coming_board import LANDED, coming_board
from traps_pipeline.scenes.picture.render import Renderer
from traps_pipeline.scenes.worlds.clip_notes import read_clip, save_clip
from traps_pipeline.scenes.worlds.outcome import compile_scene, decisive_geoms
from traps_pipeline.scenes.worlds.spec import SceneSpec
from traps_pipeline.scenes.worlds.world import closing_of

ABLATION_FRAMES = 5  # evenly spaced void frames that are drawn once more without what they must not show


@dataclass(frozen=True)
class Job:
    """A pair and its twin to render: record, trajectories (F, nq), and clips' paths."""

    spec: SceneSpec
    qpos: np.ndarray
    twin_qpos: np.ndarray
    control: Path
    void: Path
    twin: Path

    @property
    def clips(self) -> tuple[Path, Path, Path]:
        """The clip files that the rendering job writes."""
        return self.control, self.void, self.twin


def render_pair(job: Job) -> int:
    """Render missing clips of a pair and its twin; return the number of new frames.

    The twin's clip is its control: the other world as it is when nothing hides it.
    """
    missing = [path for path in job.clips if read_clip(path) is None]
    if not missing:
        return 0
    family, physics, twin_params = get_family(job.spec.family), Physics(**job.spec.physics), job.spec.twin.params
    n_frames = 0
    if missing != [job.twin] or twin_params is None:
        n_frames += _render_scene(job, family, physics, missing)
    if job.twin in missing and twin_params is not None:
        model, _ = compile_scene(family, family.params_from(twin_params), physics)
        with Renderer(model, Camera.from_record(job.spec.camera)) as renderer:
            n_frames += save_clip(job.twin, list(renderer.frames(job.twin_qpos)), physics.fps)
    return n_frames


def _render_scene(job: Job, family: Family, physics: Physics, missing: Sequence[Path]) -> int:
    """Render what is missing of control, void, and a twin that is another start."""
    spec = job.spec
    occluder, closing = (
        Occluder.from_record(spec.void["panel"]) if spec.void_kind == "occluder" else None,
        closing_of(spec),
    )
    occluder_or_none = occluder if closing is None else closing.occluder
    model, scene = compile_scene(family, family.params_from(spec.params), physics, occluder_or_none)
    camera = Camera.from_record(spec.camera)
    n_frames, open_frames = 0, len(job.qpos) if closing is None else closing.frame
    board = coming_board(closing, camera, len(job.qpos), physics.fps)
    with Renderer(model, camera) as renderer:
        control: list[np.ndarray] = []
        if job.control in missing or (occluder is None and job.void in missing):
            control = list(checks.closing_frames(renderer, job.qpos, board))
            n_frames += len(control)
        if job.control in missing:
            save_clip(job.control, control, physics.fps)
        if job.void in missing and occluder is not None:
            decisive = decisive_geoms(model, scene.decisive)
            closed_frames = control[open_frames:]  # behind the same occluder: these are not drawn again
            open_to = len(job.qpos) - len(closed_frames)
            opening_frames = checks.closing_frames(renderer, job.qpos[:open_to], board[:open_to], occluder=True)
            void = [*opening_frames, *closed_frames]
            still_frames = [frame for frame, offset in enumerate(board) if offset in (None, LANDED)]
            leaked_pixels = _leaked_pixels(renderer, scene, decisive, job, void, still_frames)
            n_frames += save_clip(job.void, void, physics.fps, leaked_pixels)
        elif job.void in missing:
            save_clip(job.void, control[: spec.void["cut_frame"]], physics.fps)
        if job.twin in missing and spec.twin.params is None:
            n_frames += save_clip(job.twin, list(renderer.frames(job.twin_qpos)), physics.fps)
    return n_frames


def _leaked_pixels(
    renderer: Renderer,
    scene: Scene,
    decisive: Sequence[str],
    job: Job,
    void: Sequence[np.ndarray],
    still: Sequence[int],
) -> float:
    """Return the pixels of the certificates `hidden` and `ablation` on some frames.

    0: the occluder hides decisive bodies from hiding on, and the hidden element, without a trace. still: frames in
    which no board comes.
    """
    step = job.spec.physics["fps"] // checks.SAMPLED_FPS
    first = job.spec.void["hidden_from_frame"]
    past_occluder_px = checks.past_occluder(renderer, job.qpos[::step], decisive, scene.hidden).leaked(
        -(-first // step)
    )
    hiding_frames = [frame for frame in still if frame >= first]
    sampled_indices = [
        hiding_frames[i] for i in np.unique(np.linspace(0, len(hiding_frames) - 1, ABLATION_FRAMES).astype(int))
    ]
    complete_frames = [void[frame] for frame in sampled_indices]
    return past_occluder_px + checks.ablation_pixels(
        renderer, job.qpos[sampled_indices], [*decisive, *scene.hidden], complete_frames
    )
