"""Compile scenes, read their outcomes, and name the geoms that decide these."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from traps_pipeline.scenes.parts.look import paint_occluders
from traps_pipeline.scenes.physics.flexes import flexes
from traps_pipeline.scenes.physics.kit import COMING_GROUP, OCCLUDER_GROUP, Family, Motion, Physics, Scene, add_box
from traps_pipeline.scenes.physics.simulate import simulate
from traps_pipeline.scenes.picture.camera import Occluder
from traps_pipeline.scenes.picture.coming_board import before_board

if TYPE_CHECKING:
    import mujoco


class Rejected(ValueError):
    """Raised where parameters make no valid pair; the message says why."""


@dataclass(frozen=True)
class Outcome:
    """The outcome that a simulation ends in, before it is certified.

    label: None if it is undecided at the end. commit_frame: first frame from which the label holds to the end (the
    number of frames if it is undecided). margin_m: distance (m) of the end from the nearest other outcome. in_order,
    turns_deg: as in `kit.Reading`.
    """

    label: str | None
    commit_frame: int
    margin_m: float
    in_order: tuple[int, int] | None = None
    turns_deg: float | None = None

    @property
    def answer(self) -> str:
        """The label of the outcome. Raises Rejected if it is undecided."""
        if self.label is None:
            raise Rejected("the outcome is undecided at the end of the control")
        return self.label


def read_outcome(family: Family, motion: Motion, params: Any) -> Outcome:
    """Return a trajectory's outcome, which `settled_outcome` also certifies."""
    reading = family.outcome(motion, params)
    commit = last_run(reading.labels)
    label = reading.labels[-1]
    committed = len(reading.labels) if label is None else commit
    return Outcome(label, committed, float(reading.margin_m), reading.in_order, reading.turns_deg)


def last_run(labels: Sequence[str | None]) -> int:
    """Return the first frame from which the last label holds to the end."""
    return next((i + 1 for i in reversed(range(len(labels))) if labels[i] != labels[-1]), 0)


def compile_scene(
    family: Family, params: Any, physics: Physics, occluder: Occluder | None = None
) -> tuple[mujoco.MjModel, Scene]:
    """Return the compiled model of a scene, and the scene.

    An occluder is added twice, each in its own geom group and without contact: where it stands, and just in front, to
    come before the scene where a control closes.
    """
    scene = family.build(params, physics)
    if occluder is not None:
        occluders = []
        for name, group, offset in (("occluder", OCCLUDER_GROUP, 0), ("coming_occluder", COMING_GROUP, 1)):
            centre = np.array(occluder.centre) + offset * before_board(occluder)
            geom = add_box(scene.spec.worldbody, name, centre.tolist(), occluder.half, "navy")
            half_turn = np.radians(occluder.yaw_deg) / 2
            geom.quat = [float(np.cos(half_turn)), 0.0, 0.0, float(np.sin(half_turn))]
            geom.contype = geom.conaffinity = 0
            geom.group = group
            occluders.append(geom)
        paint_occluders(scene.spec, occluders, params)
    return scene.spec.compile(), scene


def simulated(model: mujoco.MjModel, scene: Scene, physics: Physics) -> np.ndarray:
    """Return the trajectory of a compiled scene, (F, nq). Raises Rejected."""
    try:
        return simulate(model, scene, physics)
    except FloatingPointError as error:
        raise Rejected(str(error)) from error


def moving_geoms(model: mujoco.MjModel) -> tuple[str, ...]:
    """Return the names of the geoms of bodies that move, and of soft bodies."""
    geom_ids = np.flatnonzero(model.body_weldid[model.geom_bodyid] > 0)
    return (*(model.geom(int(i)).name for i in geom_ids if model.geom(int(i)).name), *flexes(model))


def decisive_geoms(model: mujoco.MjModel, bodies: Sequence[str]) -> tuple[str, ...]:
    """Return the names of the geoms that belong to any of these bodies, and of the soft ones among them."""
    soft_bodies = flexes(model)
    ids = {model.body(name).id for name in bodies if name not in soft_bodies}
    geoms = (model.geom(i).name for i in range(model.ngeom) if int(model.geom_bodyid[i]) in ids)
    return (*geoms, *(name for name in soft_bodies if name in bodies))
