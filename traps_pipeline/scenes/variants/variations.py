"""Define variations: a scenario asked or shown with one thing changed.

docs/hypotheses.md says what each is for. What varies the question or the way it is put shows the pair's own clips; what
varies the occluder is drawn and certified here. An occluder that lets the outcome through makes no void, and is not
asked as one. Not every scenario admits every variation; `Rejected` says why.
"""

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from traps_pipeline.base.digests import digest
from traps_pipeline.protocol.datasets import FRAMINGS, OCCLUDER_DOSES, OCCLUDER_LOOKS, SCHEMAS
from traps_pipeline.scenes.certification.certificates import legible_groups
from traps_pipeline.scenes.family_registry import get_family
from traps_pipeline.scenes.parts.wording import choices_in, match_slots
from traps_pipeline.scenes.physics.kit import list_choices
from traps_pipeline.scenes.picture import checks
from traps_pipeline.scenes.picture.render import Renderer
from traps_pipeline.scenes.variants.arms import SEEN_PX, Arm, Question, Scenario, Take, questions_to_answer
from traps_pipeline.scenes.worlds.outcome import Rejected, compile_scene, moving_geoms
from traps_pipeline.scenes.worlds.spec import SceneSpec
from traps_pipeline.scenes.worlds.world import World
from traps_pipeline.video.policies import shown_at_end

# --- thresholds -------------------------------------------------------------------------------------------------------

SEEN_LEVELS = 8  # levels of 255 by which a channel must differ for a pixel to count as seen through an occluder
WIDTH_FACTOR = 1.4  # by which the large occluder is wider: a higher one would hide the flags of what the question names
GREY, MAGENTA = (0.55, 0.55, 0.57), (1.0, 0.0, 1.0)  # a colour near the floor's; one that nothing in any scene has
END_S = 0.5  # of the control's end, in which frames shown later must show the outcome
PALETTE = ("red", "green", "blue", "yellow", "orange", "cyan", "purple")  # colours that may be offered as answers

# --- how many answers there are to choose from ------------------------------------------------------------------------


def with_labels(spec: SceneSpec, count: int) -> tuple[str, tuple[str, ...]]:
    """Return the scenario's question with `count` choices, and these choices. Raises Rejected.

    The answer and that of the twin, the other world behind the same void, are always among them, so that the void stays
    open; then come the question's own choices, and then colours that it does not name. Raises Rejected where the
    answers are no colours, or the choices are part of the sentence.
    """
    if spec.answer_type != "colour":
        raise Rejected(f"the answers {list_choices(spec.labels)} are no colours, so that no others can be offered")
    slots = match_slots(get_family(spec.family).questions, spec.question)
    if slots is None or set(choices_in(slots.get("choices", ""))) != set(spec.labels):
        raise Rejected(f"the choices of {spec.question!r} are part of its sentence")
    more_colours = [colour for colour in PALETTE if colour not in slots.values()]
    pool = [spec.ground_truth, spec.twin.ground_truth, *_mixed(spec, spec.labels), *_mixed(spec, more_colours)]
    labels = _mixed(spec, [*dict.fromkeys(pool)][:count])
    if len(labels) < count:
        raise Rejected(f"there are {len(labels)} answers to choose from, {count} are wanted")
    return spec.question.replace(slots["choices"], list_choices(labels)), tuple(labels)


def _mixed(spec: SceneSpec, labels: Sequence[str]) -> list[str]:
    """Return the labels in an order that the scenario alone decides."""
    return sorted(labels, key=lambda label: digest([spec.scenario_id, label]))


def _labels(count: int) -> Callable[[SceneSpec], list[Question]]:
    def ask(spec: SceneSpec) -> list[Question]:
        for choices in (2, 3, 6):  # asked with all numbers of choices or with none, so that doses compare
            with_labels(spec, choices)
        question, labels = with_labels(spec, count)
        return _both(question, spec.ground_truth, labels)

    return ask


def _both(question: str, answer: str, labels: tuple[str, ...] | None = None) -> list[Question]:
    """Return a question for both clips of the pair."""
    return [Question("control", question, answer, "control", labels), Question("void", question, None, "void", labels)]


def _must_abstain(spec: SceneSpec) -> list[Question]:
    return [Question("void", spec.question, None)]


def _pair(spec: SceneSpec) -> list[Question]:
    return _both(spec.question, spec.ground_truth)


def _nothing(scenario: Scenario) -> Take:
    return Take([], {})


def _offered(scenario: Scenario) -> Take:
    """Record that both worlds' answers are offered."""
    return Take([], {"offered": [scenario.spec.ground_truth, scenario.spec.twin.ground_truth]})


# --- the occluder -----------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Look:
    """The look of an occluder. colour: RGB or None; alpha: 1 is opaque; wide: a factor."""

    colour: tuple[float, float, float] | None = None
    alpha: float = 1.0
    wide: float = 1.0


def _renderer(world: World, look: Look) -> Renderer:
    """Return a renderer of a world, from the pair's camera, with another occluder."""
    assert world.occluder is not None, "an occlusion scenario has an occluder"
    across, thickness, up = world.occluder.half
    occluder = replace(world.occluder, half=(round(across * look.wide, 6), thickness, up))
    model, _ = compile_scene(world.family, world.params, world.physics, occluder)
    geom = model.geom("occluder")
    if look.colour is not None:
        geom.matid[:], geom.rgba[:3] = -1, look.colour  # of one colour, whatever the occluder is of
    geom.rgba[3] = look.alpha
    return Renderer(model, world.camera)


def _void_with(scenario: Scenario, look: Look) -> Take:
    """Return the void with another occluder, alike in both worlds. Raises Rejected."""
    control, twin = scenario.control, scenario.twin
    moving_names = moving_geoms(control.model)
    with _renderer(control, look) as renderer:
        frames = list(checks.occluded_frames(renderer, control.qpos))
        shown_px = float(renderer.visible_pixels(control.qpos[:1], ["occluder"], occluder=True)[0, 0])
        cause = float(
            renderer.visible_pixels(control.qpos[scenario.sampled], moving_names, occluder=True).sum(axis=1).max()
        )
    with _renderer(twin, look) as renderer:
        n_differing, levels = checks.differing_pixels(frames, checks.occluded_frames(renderer, twin.qpos))
    if n_differing:
        raise Rejected(
            f"behind this occluder the two worlds differ in {n_differing} pixels, by {levels} levels at most"
        )
    if cause < SEEN_PX:
        raise Rejected(
            f"past this occluder at most {cause:.0f} pixels of what moves are seen, {SEEN_PX:.0f} are wanted"
        )
    evidence = {"panel_px": shown_px, "cause_px": cause, "twin_px": n_differing}
    looks = {"wide": look.wide, "contrast": _contrast(frames[0], scenario.control_frames[0])}
    return Take(frames, evidence | looks)


def _contrast(void: np.ndarray, control: np.ndarray) -> float:
    """Return the mean CIELAB distance of an occluder from what it covers."""
    import cv2

    lab = [cv2.cvtColor((frame / 255).astype(np.float32), cv2.COLOR_RGB2LAB) for frame in (void, control)]
    colour_distances = np.linalg.norm(lab[0] - lab[1], axis=2)
    return round(float(colour_distances[colour_distances > 0].mean()), 1) if (colour_distances > 0).any() else 0.0


def _coloured(colour: tuple[float, float, float]) -> Callable[[Scenario], Take]:
    return lambda scenario: _void_with(scenario, Look(colour=colour))


def _large(scenario: Scenario) -> Take:
    return _void_with(scenario, Look(wide=WIDTH_FACTOR))


def _sheer(alpha: float) -> Callable[[Scenario], Take]:
    def film(scenario: Scenario) -> Take:
        """Return a clip whose sheer occluder shows the outcome. Raises Rejected."""
        look, last = Look(alpha=alpha), checks.last_sampled(len(scenario.control.qpos), scenario.fps)
        with _renderer(scenario.control, look) as renderer:
            frames = list(checks.occluded_frames(renderer, scenario.control.qpos))
        with _renderer(scenario.twin, look) as renderer:
            twin_frames = list(checks.occluded_frames(renderer, scenario.twin.qpos))
        gaps = [np.abs(frames[k].astype(np.int16) - twin_frames[k]).max(axis=2) for k in last]
        n_noticed, levels = (max(int((gap >= SEEN_LEVELS).sum()) for gap in gaps), max(int(gap.max()) for gap in gaps))
        evidence = {"alpha": alpha, "seen_through_px": n_noticed, "levels": levels}
        if n_noticed < SEEN_PX:
            raise Rejected(
                f"through an occluder of alpha {alpha:g} the two worlds differ by {SEEN_LEVELS} levels or more in "
                f"{n_noticed} pixels of a late frame ({levels} levels at most), {SEEN_PX:.0f} are wanted"
            )
        return Take(frames, evidence)

    return film


# --- which frames are shown -------------------------------------------------------------------------------------------


def _later(scenario: Scenario) -> Take:
    """Return no clip, if the frames after those shown at the end show the outcome too."""
    control = scenario.control
    end_frames = shown_at_end(len(control.qpos), scenario.fps, END_S, control.open_frames - 1)
    late_frames = [frame + 1 for frame in end_frames]
    if late_frames[0] < control.outcome.commit_frame:
        raise Rejected(
            f"the outcome is settled at frame {control.outcome.commit_frame}, frame {late_frames[0]} is shown"
        )
    groups = legible_groups(control.family, control.model, control.scene, control.motion, control.params)
    with control.renderer() as renderer:
        min_pixels = checks.least_visible(renderer, control.qpos[late_frames], groups)
    too_small = [
        f"{px:.0f} of {needed:.0f} pixels" for px, (_, needed) in zip(min_pixels, groups, strict=True) if px < needed
    ]
    if too_small:
        raise Rejected(f"the frames that are shown later show {', '.join(too_small)} of the outcome")
    return Take([], {"late_frames": late_frames, "least_visible_px": min(min_pixels)})


# --- all of them ------------------------------------------------------------------------------------------------------

_SAME_VOID = (
    "the other world behind the void gives the same frames byte for byte, at every frame; at least "
    f"{SEEN_PX:.0f} pixels of what moves are seen past the occluder in some sampled frame"
)
_SEEN_THROUGH = (
    f"not a void: in one of the last three sampled frames the two worlds differ by {SEEN_LEVELS} of 255 levels or more "
    f"in at least {SEEN_PX:.0f} pixels"
)
_COUNTS = {"labels_two": 2, "labels_three": 3, "labels_six": 6}
_COLOURED = {"occluder_grey": GREY, "occluder_magenta": MAGENTA}
_ALPHAS = {name: int(name.removeprefix("occluder_alpha_")) / 100 for name in OCCLUDER_DOSES}
_CHANGES: Mapping[str, str] = {
    "occluder_grey": "the occluder is grey, near the floor's colour",
    "occluder_magenta": "the occluder is magenta, which nothing in any scene is",
    "occluder_large": f"the occluder is {WIDTH_FACTOR:g} times as wide",
    "schema_answer": 'the prompt asks for the object `{"final_answer"}`',
    "schema_reason": 'it asks for `{"reason", "final_answer"}`: the request of the regime `json`',
    "schema_abstain": 'it asks for `{"reason", "abstain", "final_answer"}`',
    "frames_later": "the model's own frames, each one frame of the clip (0.1 s) later",
    "frames_few": "2 frames a second, 10 of a whole clip",
    "frames_all": "10 frames a second, all 50 of a whole clip",
}
_FILMED: Mapping[str, Callable[[Scenario], Take]] = {
    **{name: _coloured(colour) for name, colour in _COLOURED.items()},
    "occluder_large": _large,
}


def _variation(name: str) -> Arm:
    if name in _COUNTS:
        count = _COUNTS[name]
        changes = f"the question offers {count} answers"
        promise = "the true answer and the other world's are always offered; asked with 2, 3 and 6 or not at all"
        return Arm(name, changes, promise, _labels(count), _offered)
    if name in OCCLUDER_LOOKS:
        return Arm(name, _CHANGES[name], _SAME_VOID, _must_abstain, _FILMED[name])
    if name in OCCLUDER_DOSES:
        alpha = _ALPHAS[name]
        return Arm(name, f"the occluder has alpha {alpha:g}", _SEEN_THROUGH, questions_to_answer, _sheer(alpha))
    promises = {
        "frames_later": f"the last {END_S:g} s as shown then show the settled outcome legibly; a void hides it in all",
        "frames_few": "that of the pair, which holds for this rate",
        "frames_all": "that of the pair: nothing is left out",
    }
    promise = promises.get(name, "that of the pair: clips and questions are its own")
    return Arm(name, _CHANGES[name], promise, _pair, _later if name == "frames_later" else _nothing)


VARIATIONS: Mapping[str, Arm] = {
    name: _variation(name) for name in (*_COUNTS, *OCCLUDER_LOOKS, *OCCLUDER_DOSES, *SCHEMAS, *FRAMINGS)
}


def variation_table() -> str:
    """Return the variations as the Markdown table of `docs/hypotheses.md`."""
    groups = itertools.groupby(VARIATIONS.values(), key=lambda arm: arm.promises)
    rows = [("; ".join(f"`{arm.name}`: {arm.takes_away}" for arm in arms), promises) for promises, arms in groups]
    return "\n".join(["| variation: change | certificate |", "| --- | --- |", *(f"| {a} | {b} |" for a, b in rows)])
