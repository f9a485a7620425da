"""From a family's parameters to a resolved scenario: simulate, read the outcome, fit the shot, choose void and twin.

`resolve` is the only way a record comes to be; it raises `Rejected` with the reason when the draw makes no good pair.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from traps_pipeline.scenes import checks, ensemble
from traps_pipeline.scenes.camera import Camera, Panel, fit_shot, in_frame
from traps_pipeline.scenes.kit import Family, Physics, Wording, params_to_dict
from traps_pipeline.scenes.outcome import (
    Outcome,
    Rejected,
    compile_scene,
    decisive_geoms,
    legible_groups,
    read_outcome,
)
from traps_pipeline.scenes.render import Renderer
from traps_pipeline.scenes.simulate import replay, simulate, swept_points
from traps_pipeline.scenes.spec import SceneSpec, Twin, trajectory_digest


@dataclass(frozen=True)
class Resolved:
    """A record and its two trajectories, qpos at frame times (F, nq) float32."""

    spec: SceneSpec
    qpos: np.ndarray
    twin: np.ndarray


@dataclass(frozen=True)
class _Void:
    """How the void is made, its twin, and the evidence for both."""

    void: Mapping[str, Any]
    twin: np.ndarray
    twin_params: Mapping[str, Any] | None
    twin_answer: str
    evidence: Mapping[str, Any]


@dataclass(frozen=True)
class _World:
    """A simulated control."""

    family: Family
    params: Any
    physics: Physics
    qpos: np.ndarray
    outcome: Outcome
    camera: Camera


def resolve(
    family: Family,
    params: Any,
    wording: Wording,
    ill_posed_question: str,
    *,
    scenario_id: str,
    seed: int,
    physics: Physics | None = None,
) -> Resolved:
    """The record of a scenario with its trajectories. Raises Rejected when it makes no valid pair."""
    physics = physics or family.physics
    model, scene = compile_scene(family, params, physics)
    qpos = _simulated(family, params, physics)
    motion = replay(model, qpos, physics)
    outcome = read_outcome(family, motion, params)
    if outcome.label not in wording.labels:
        raise ValueError(f"{family.name}: reading {outcome.label!r} is not one of the labels {list(wording.labels)}")
    points = np.concatenate([swept_points(model, qpos), *(box.corners() for box in scene.stage)])
    camera, panel = fit_shot(scene.view, points, scene.cover)
    if not in_frame(camera, points):
        raise Rejected("something decisive leaves the frame")
    groups = legible_groups(family, model, scene, motion, params)
    with Renderer(model, camera) as renderer:
        shown = checks.least_visible(renderer, qpos[checks.last_sampled(len(qpos), physics.fps)], groups)
    for (names, least), pixels in zip(groups, shown, strict=True):
        if pixels < least:
            raise Rejected(f"too small at the end: {pixels:.0f} of {least:.0f} pixels of {names[0]}")
    world = _World(family, params, physics, qpos, outcome, camera)
    void = _occluder_void(world, panel) if panel is not None else _truncation_void(world, seed)
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
        void=_plain(dict(void.void)),
        question=wording.question,
        labels=list(wording.labels),
        aliases=dict(wording.aliases),
        answer_type=family.answer_type,
        ground_truth=outcome.label,
        ill_posed_question=ill_posed_question,
        answerable_question=_plain(asdict(wording.answerable_question)),
        trajectory_sha256=trajectory_digest(qpos),
        twin=Twin(
            params=None if void.twin_params is None else _plain(dict(void.twin_params)),
            ground_truth=void.twin_answer,
            trajectory_sha256=trajectory_digest(void.twin),
        ),
        evidence={
            "commit_s": round(outcome.commit_frame / physics.fps, 3),
            "margin_m": round(outcome.margin_m, 5),
            "least_visible_px": min(shown),
            **void.evidence,
        },
    )
    return Resolved(spec, qpos, void.twin)


def _simulated(family: Family, params: Any, physics: Physics) -> np.ndarray:
    model, scene = compile_scene(family, params, physics)
    try:
        return simulate(model, scene, physics)
    except FloatingPointError as error:
        raise Rejected(str(error)) from error


def _occluder_void(world: _World, panel: Panel) -> _Void:
    candidates = _twin_worlds(world)
    if not candidates:
        raise Rejected("no other hidden element gives another outcome")
    model, scene = compile_scene(world.family, world.params, world.physics, panel)
    decisive = decisive_geoms(model, scene.decisive)
    with Renderer(model, world.camera) as renderer:
        hidden_from = checks.hidden_from(renderer, world.qpos, decisive, scene.hidden)
        if hidden_from is None or hidden_from >= world.outcome.commit_frame:
            raise Rejected("the panel does not hide the outcome before it is committed")
        void = list(renderer.frames(world.qpos, panel=True))
        ablated = renderer.frames(world.qpos[hidden_from:], panel=True, without=[*decisive, *scene.hidden])
        if checks.differing_pixels(void[hidden_from:], ablated)[0]:
            raise Rejected("something decisive reaches the eye past the panel")
    for params, qpos, label in candidates:
        twin_model, _ = compile_scene(world.family, params, world.physics, panel)
        with Renderer(twin_model, world.camera) as renderer:  # one GL context: renderers take turns
            pixels, _ = checks.differing_pixels(void, renderer.frames(qpos, panel=True))
        if pixels == 0:
            return _Void(
                void={"panel": asdict(panel), "hidden_from_frame": hidden_from},
                twin=qpos,
                twin_params=params_to_dict(params),
                twin_answer=label,
                evidence={"hidden_from_s": hidden_from / world.physics.fps, "ablation_px": 0, "twin_px": 0},
            )
    raise Rejected("the twin's void differs from the void")


def _twin_worlds(world: _World) -> list[tuple[Any, np.ndarray, str]]:
    """Scenes with another hidden element and another settled outcome: parameters, trajectory, answer."""
    assert world.family.twins is not None, f"{world.family.name}: an occlusion family needs twins"
    worlds = []
    for params in world.family.twins(world.params):
        try:
            qpos = _simulated(world.family, params, world.physics)
            model, _ = compile_scene(world.family, params, world.physics)
            label = read_outcome(world.family, replay(model, qpos, world.physics), params).label
        except Rejected:
            continue  # this other world settles nothing; the next one may
        if label != world.outcome.label:
            worlds.append((params, qpos, label))
    return worlds


def _truncation_void(world: _World, seed: int) -> _Void:
    found = ensemble.choose_cut(
        world.family, world.params, world.physics, world.camera, world.qpos, world.outcome.commit_frame, seed
    )
    if found is None:
        raise Rejected("no cut at 1.0 s or later leaves the outcome open")
    cut, twin = found
    assert twin.qpos is not None and twin.label is not None
    model, _ = compile_scene(world.family, world.params, world.physics)
    before = slice(0, cut.frame)
    with Renderer(model, world.camera) as renderer:
        control = list(renderer.frames(world.qpos[before]))
        _, largest = checks.differing_pixels(control, renderer.frames(twin.qpos[before]))
    return _Void(
        void={"cut_frame": cut.frame},
        twin=twin.qpos,
        twin_params=None,
        twin_answer=twin.label,
        evidence={**cut.evidence(), "twin_largest_difference": largest},
    )


def _plain(value: Any) -> Any:
    """Tuples to lists, numpy numbers to Python's, so that a record equals itself after a round trip through JSON."""
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    return value.item() if isinstance(value, np.generic) else value
