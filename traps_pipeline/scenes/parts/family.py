"""Assemble a family from its parts, for the registry."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import cv2
import numpy as np

from traps_pipeline.scenes.parts import vary
from traps_pipeline.scenes.parts.difficulty import SceneDifficulty, add_distractors
from traps_pipeline.scenes.parts.look import OCCLUSION_PARTS, Look, apply_look, look_of
from traps_pipeline.scenes.parts.observers import Observer
from traps_pipeline.scenes.parts.questions import Aside, Question
from traps_pipeline.scenes.parts.vision import after_occluder, before_occluder, is_still, without_flags
from traps_pipeline.scenes.physics.kit import Family, Motion, Physics, Reading, Scene
from traps_pipeline.scenes.picture.camera import HEIGHT, WIDTH

DEFAULT_PHYSICS = Physics()


def scene_family(
    name: str,
    *,
    category: str,
    params: type,
    build: Callable[[Any, Physics], Scene],
    outcome: Callable[[Motion, Any], Reading],
    question: Question,
    asides: Sequence[Aside],
    observe: Observer,
    foresee: Observer | None = None,
    look: Observer | None = None,
    physics: Physics = DEFAULT_PHYSICS,
    min_margin_m: float = 0.005,
    sub_scenario: str | None = None,
    legible: Callable[[Motion, Any], Sequence[tuple[tuple[str, ...], float]]] | None = None,
    twins: Callable[[Any], Sequence[Any]] | None = None,
    perturbation: float = 1e-4,
    looks: tuple[str, ...] | None = None,
) -> Family:
    """Build a family from its parts; fields as in `kit.Family`.

    Parameters with a hidden element make an occlusion family, whose twins are derived from it; parameters without one
    make a chaotic family. observe: reads the outcome from the frames. foresee: predicts the outcome from the frames
    before an occluder, if one comes before the outcome. look: reads the outcome from the frames after an occluder has
    left, if `observe` finds none. twins: replaces the derived twins if the hidden element spans several fields.
    sub_scenario: defaults to the family's name. looks: the parts of the scene's look that vary; by default all but the
    size in an occlusion family, none in a chaotic one.
    """
    if twins is None and vary.hidden_field(params) is not None:
        twins = vary.twins

    def observe_question(frames: np.ndarray, text: str) -> str | None:
        slots = question.slots_in(text)
        if slots is None:
            return None
        if frames.shape[1:3] != (HEIGHT, WIDTH):  # what an observer takes for large is so at this size
            frames = np.stack([cv2.resize(frame, (WIDTH, HEIGHT), interpolation=cv2.INTER_AREA) for frame in frames])
        visible = before_occluder(frames)  # what an occluder covers at the end was seen before it came
        frames_without_flags = visible if twins is None else without_flags(visible)
        if foresee is not None and len(visible) < len(frames):
            # The shadow of an occluder may come before it does.
            is_at_rest = is_still(visible) or is_still(visible[:-1])
            return _first_answer(frames_without_flags, slots, (observe, foresee) if is_at_rest else (foresee, observe))
        answer = observe(frames_without_flags, slots)
        if (
            answer is None
            and look is not None
            and len(end := after_occluder(frames_without_flags)) < len(frames_without_flags)
        ):
            return look(end, slots)
        return answer

    params = vary.with_field(vary.with_field(params, "look", Look), "difficulty", SceneDifficulty)
    return Family(
        name=name,
        taxonomy="chaotic" if twins is None else "occlusion",
        category=category,
        sub_scenario=sub_scenario or name,
        answer_type=question.answer_type,
        params=params,
        draw=lambda rng, longer=False: vary.draw_params(params, rng, longer),
        build=lambda p, physics: add_distractors(apply_look(build(p, physics), look_of(p)), p),
        outcome=outcome,
        word=lambda p, rng: question.word(p, rng, asides),
        questions=question.templates,
        observe=observe_question,
        legible=legible,
        physics=physics,
        min_margin_m=min_margin_m,
        twins=twins,
        perturbation=perturbation,
        looks=(() if twins is None else OCCLUSION_PARTS) if looks is None else looks,
        check=vary.check,
    )


def _first_answer(frames: np.ndarray, slots: Mapping[str, str], observers: Sequence[Observer]) -> str | None:
    return next((answer for observe in observers if (answer := observe(frames, slots)) is not None), None)
