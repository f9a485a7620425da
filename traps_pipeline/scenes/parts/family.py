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
from traps_pipeline.scenes.parts.vision import after_occluder, before_occluder, is_still, until_covered, without_flags
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
        if slots is None or len(frames) < 3:  # fewer do not show rest
            return None
        if frames.shape[1:3] != (HEIGHT, WIDTH):  # what an observer takes for large is so at this size
            frames = np.stack([cv2.resize(frame, (WIDTH, HEIGHT), interpolation=cv2.INTER_AREA) for frame in frames])
        n_before = len(before_occluder(frames))  # what an occluder covers at the end was seen before it came
        comes = n_before < len(frames)
        visible = until_covered(frames, n_before) if comes and foresee is not None else frames[:n_before]
        seen = visible if twins is None else without_flags(visible)
        if comes and foresee is not None:
            before, longest_first = seen[:n_before], [seen[:n] for n in range(len(seen), n_before, -1)]
            if any(n > 1 and is_still(frames[:n]) for n in (n_before, n_before - 1)):  # its shadow may come first
                return _first_answer([before], slots, (observe, foresee))
            return _first_answer(longest_first, slots, (foresee,)) or _first_answer([before], slots, (foresee, observe))
        answer = observe(seen, slots)
        if answer is None and look is not None and 3 <= len(end := after_occluder(seen)) < len(seen):
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


def _first_answer(clips: Sequence[np.ndarray], slots: Mapping[str, str], observers: Sequence[Observer]) -> str | None:
    answers = (observe(frames, slots) for frames in clips if len(frames) > 2 for observe in observers)
    return next((answer for answer in answers if answer is not None), None)
