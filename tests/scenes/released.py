"""Released records with everything rebuilt from them, shared by the tests of scenes."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

os.environ.setdefault("MUJOCO_GL", "osmesa")

import numpy as np

from traps_pipeline.base.paths import RELEASED
from traps_pipeline.benchmark.records import load_released
from traps_pipeline.scenes.family_registry import get_family
from traps_pipeline.scenes.physics.kit import Family, Physics
from traps_pipeline.scenes.picture.camera import Camera, Occluder
from traps_pipeline.scenes.picture.checks import closing_frames
from traps_pipeline.scenes.picture.render import Renderer
from traps_pipeline.scenes.worlds.outcome import compile_scene
from traps_pipeline.scenes.worlds.spec import SceneSpec, load_trajectory
from traps_pipeline.scenes.worlds.world import World

# One family of each way in which an outcome comes about, for `make test`; the campaign takes them all.
SIX = {"hidden_race", "domino_chain", "tower", "lever_gate", "plinko", "tumbling_dice"}
SAMPLED = slice(None, None, 2)  # the 5 FPS frames that models are shown


@dataclass(frozen=True)
class Released:
    """A released scenario, its values restored."""

    spec: SceneSpec
    qpos: np.ndarray
    twin: np.ndarray

    @property
    def family(self) -> Family:
        return get_family(self.spec.family)

    @property
    def params(self) -> Any:
        return self.family.params_from(self.spec.params)

    @property
    def physics(self) -> Physics:
        return Physics(**self.spec.physics)

    @property
    def camera(self) -> Camera:
        return Camera.from_record(self.spec.camera)

    @property
    def occluder(self) -> Occluder | None:
        return Occluder.from_record(self.spec.void["panel"]) if self.spec.void_kind == "occluder" else None

    @cached_property
    def control_frames(self) -> np.ndarray:
        """The control as it is sampled, (25, 360, 480, 3)."""
        return self._closing(occluder=False)

    def _closing(self, *, occluder: bool) -> np.ndarray:
        world = World.of_record(self.spec, self.qpos)
        with world.closed_renderer() as renderer:
            return np.stack(list(closing_frames(renderer, self.qpos[SAMPLED], world.board[SAMPLED], occluder=occluder)))

    @cached_property
    def void(self) -> np.ndarray:
        """The void as it is sampled, (n, 360, 480, 3)."""
        if self.occluder is None:
            return self.control_frames[: -(-self.spec.void["cut_frame"] // 2)]
        return self._closing(occluder=True)

    def void_behind(self, occluder_rgb: tuple[float, float, float]) -> np.ndarray:
        """The void with its occluder in another colour. Only the first frame is drawn: nothing passes before an
        occluder, so its pixels are the same in all frames, but for a few at its edges where something is seen to
        move."""
        model, _ = compile_scene(self.family, self.params, self.physics, self.occluder)
        model.geom_rgba[model.geom("occluder").id, :3] = occluder_rgb
        with Renderer(model, self.camera) as renderer:
            (first,) = renderer.frames(self.qpos[:1], occluder=True)
        frames, changed = self.void.copy(), (first != self.void[0]).any(axis=-1)
        frames[:, changed] = first[changed]
        return frames


def load(scenario_id: str, folder: Path = RELEASED) -> Released:
    """A released scenario by id."""
    spec = load_released(folder)[scenario_id]
    path = folder / "trajectories" / f"{scenario_id}.npz"
    qpos = load_trajectory(path, spec.trajectory_sha256)
    return Released(spec, qpos, load_trajectory(path, spec.twin.trajectory_sha256, "twin"))


def first_of_each(void_kind: str, of: Callable[[Family], str] = lambda family: family.name) -> list[str]:
    """The first released scenario of every family of a kind, or of every other thing `of` a family."""
    firsts: dict[str, str] = {}
    for scenario_id, spec in load_released().items():
        if spec.void_kind == void_kind:
            firsts.setdefault(of(get_family(spec.family)), scenario_id)
    return sorted(firsts.values())
