"""From a family's parameters to a resolved scenario: simulate, read the outcome, fit the shot, choose the void.

`resolve` is the only way a record comes to be; it raises `Rejected` with the reason when the draw makes no good pair.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from traps_pipeline.scenes import checks, ensemble
from traps_pipeline.scenes.camera import Camera, Panel, fit_shot, in_frame
from traps_pipeline.scenes.kit import PANEL_GROUP, Family, Physics, Scene, Wording, add_box, params_to_dict
from traps_pipeline.scenes.render import Renderer
from traps_pipeline.scenes.simulate import Motion, replay, simulate, swept_points
from traps_pipeline.scenes.spec import SceneSpec, trajectory_digest

if TYPE_CHECKING:
    import mujoco

COMMITTED_BEFORE_END_S = 0.6


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
    labels = family.readings(motion, params)
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
    margin = family.margin(motion, params)
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


def resolve(
    family: Family, params: Any, wording: Wording, *, scenario_id: str, seed: int, physics: Physics | None = None
) -> tuple[SceneSpec, np.ndarray]:
    """The record of a scenario and its trajectory (F, nq). Raises Rejected when it makes no valid pair."""
    physics = physics or family.physics
    model, scene = compile_scene(family, params, physics)
    try:
        qpos = simulate(model, scene, physics)
    except FloatingPointError as error:
        raise Rejected(str(error)) from error
    motion = replay(model, qpos, physics)
    outcome = read_outcome(family, motion, params)
    if outcome.label not in wording.labels:
        raise ValueError(f"{family.name}: reading {outcome.label!r} is not one of the labels {list(wording.labels)}")
    points = np.concatenate([swept_points(model, qpos), *(box.corners() for box in scene.stage)])
    camera, panel = fit_shot(scene.view, points, scene.cover)
    if not in_frame(camera, points):
        raise Rejected("something decisive leaves the frame")
    evidence: dict[str, Any] = {
        "commit_s": round(outcome.commit_frame / physics.fps, 3),
        "margin_m": round(outcome.margin_m, 5),
    }
    if panel is not None:
        void, proof = _occluder_void(family, params, physics, panel, camera, qpos, outcome)
    else:
        void, proof = _truncation_void(family, params, physics, camera, qpos, outcome, seed)
    spec = SceneSpec(
        scenario_id=scenario_id,
        taxonomy=family.taxonomy,
        category=family.category,
        sub_scenario=family.sub_scenario,
        family=family.name,
        seed=seed,
        params=_plain(params_to_dict(params)),
        physics=asdict(physics),
        camera=_plain(asdict(camera)),
        void_kind="occluder" if panel is not None else "truncation",
        void=_plain(void),
        question=wording.question,
        labels=list(wording.labels),
        aliases=dict(wording.aliases),
        answer_type=family.answer_type,
        ground_truth=outcome.label,
        ill_posed_question=wording.ill_posed_question,
        answerable_question=_plain(asdict(wording.answerable_question)),
        trajectory_sha256=trajectory_digest(qpos),
        evidence=evidence | proof,
    )
    return spec, qpos


def _occluder_void(
    family: Family,
    params: Any,
    physics: Physics,
    panel: Panel,
    camera: Camera,
    qpos: np.ndarray,
    outcome: Outcome,
) -> tuple[dict[str, Any], dict[str, Any]]:
    model, scene = compile_scene(family, params, physics, panel)
    with Renderer(model, camera) as renderer:
        hidden_from = checks.hidden_from(renderer, qpos, decisive_geoms(model, scene.decisive), scene.hidden)
    if hidden_from is None or hidden_from >= outcome.commit_frame:
        raise Rejected("the panel does not hide the outcome before it is committed")
    return {"panel": asdict(panel), "hidden_from_frame": hidden_from}, {"hidden_from_s": hidden_from / physics.fps}


def _truncation_void(
    family: Family,
    params: Any,
    physics: Physics,
    camera: Camera,
    qpos: np.ndarray,
    outcome: Outcome,
    seed: int,
) -> tuple[dict[str, Any], dict[str, Any]]:
    cut = ensemble.choose_cut(family, params, physics, camera, qpos, outcome.commit_frame, seed)
    if cut is None:
        raise Rejected("no cut at 1.0 s or later leaves the outcome open")
    return {"cut_frame": cut.frame}, cut.evidence()


def _plain(value: Any) -> Any:
    """Tuples to lists, numpy numbers to Python's, so that a record equals itself after a round trip through JSON."""
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    return value.item() if isinstance(value, np.generic) else value
