"""What a control shows: its compiled scene, its outcome, and what must be legible of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from traps_pipeline.scenes.camera import Panel
from traps_pipeline.scenes.kit import PANEL_GROUP, Family, Motion, Physics, Scene, add_box

if TYPE_CHECKING:
    import mujoco

COMMITTED_BEFORE_END_S = 0.6
LEGIBLE_PIXELS = 150.0  # of each decisive body at the end of the control


class Rejected(ValueError):
    """This draw makes no valid pair; the message says why."""


@dataclass(frozen=True)
class Outcome:
    """What the control shows. commit_frame: first frame from which the label holds to the end."""

    label: str
    commit_frame: int
    margin_m: float


def read_outcome(family: Family, motion: Motion, params: Any) -> Outcome:
    """The outcome of a trajectory, settled at least 0.6 s before the end. Raises Rejected."""
    reading = family.outcome(motion, params)
    labels, margin = reading.labels, reading.margin_m
    label = labels[-1]
    if label is None:
        raise Rejected("the outcome is undecided at the end of the control")
    commit = len(labels)
    while commit > 0 and labels[commit - 1] == label:
        commit -= 1
    fps = 1.0 / float(motion.times[1] - motion.times[0])
    left = (len(labels) - 1 - commit) / fps
    if left < COMMITTED_BEFORE_END_S - 1e-9:
        raise Rejected(f"outcome {label!r} is committed only {left:.1f} s before the end")
    if margin < family.min_margin_m:
        raise Rejected(f"outcome {label!r} has a margin of {margin:.4f} m, below {family.min_margin_m} m")
    return Outcome(label, commit, float(margin))


def compile_scene(
    family: Family, params: Any, physics: Physics, panel: Panel | None = None
) -> tuple[mujoco.MjModel, Scene]:
    """The compiled model of a scene, with the cover panel (own geom group, collides with nothing) if one is given."""
    scene = family.build(params, physics)
    if panel is not None:
        geom = add_box(scene.spec.worldbody, "cover_panel", panel.centre, panel.half, "navy")
        half = np.radians(panel.yaw_deg) / 2
        geom.quat = [float(np.cos(half)), 0.0, 0.0, float(np.sin(half))]
        geom.contype = geom.conaffinity = 0
        geom.group = PANEL_GROUP
    return scene.spec.compile(), scene


def decisive_geoms(model: mujoco.MjModel, bodies: Sequence[str]) -> tuple[str, ...]:
    """Names of the geoms of some bodies."""
    ids = {model.body(name).id for name in bodies}
    return tuple(model.geom(i).name for i in range(model.ngeom) if int(model.geom_bodyid[i]) in ids)


def legible_groups(
    family: Family, model: mujoco.MjModel, scene: Scene, motion: Motion, params: Any
) -> list[tuple[tuple[str, ...], float]]:
    """Groups of geoms that must be seen at the end of the control, each with its least number of pixels."""
    if family.legible is not None:
        return list(family.legible(motion, params))
    return [(decisive_geoms(model, [body]), LEGIBLE_PIXELS) for body in scene.decisive]
