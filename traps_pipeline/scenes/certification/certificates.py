"""Define the certificates of a pair: what they promise, their evidence and thresholds.

A certificate is one entry of `CERTIFICATES`. From there it is picked up by `resolve` (a draw that loses one is
rejected, and what it measures goes into the record), by `certify` (all are measured again from the record and its two
trajectories), by the asset checks (the stored evidence is judged again), and by the table of the documentation's site.
All thresholds are here.
"""

from __future__ import annotations

import math
import re
from collections.abc import Collection, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from traps_pipeline.scenes.certification import ensemble
from traps_pipeline.scenes.certification.evidence import (
    About,
    Certificate,
    Claim,
    Evidence,
    Failures,
    Number,
    Pair,
    VoidKind,
)
from traps_pipeline.scenes.parts.difficulty import DISTRACTOR
from traps_pipeline.scenes.parts.look import fineness
from traps_pipeline.scenes.parts.wording import FAR_COLOUR, false_premises, none_as_answer, refutation
from traps_pipeline.scenes.physics.flexes import flexes, soft_body_mask
from traps_pipeline.scenes.physics.kit import Family, Motion, Physics, Scene, flag_of
from traps_pipeline.scenes.physics.simulate import swept_points
from traps_pipeline.scenes.picture import checks
from traps_pipeline.scenes.picture.camera import is_in_frame
from traps_pipeline.scenes.picture.walls import FACES_THE_EYE_DEG, outlines
from traps_pipeline.scenes.worlds.outcome import (
    Outcome,
    Rejected,
    compile_scene,
    decisive_geoms,
    read_outcome,
    simulated,
)
from traps_pipeline.scenes.worlds.pace import (
    EARLIEST_SHARE,
    IN_VIEW_S,
    LATEST_SHARE,
    is_exchangeable,
    lengths,
    moments,
    out_of_pace,
    settles_share,
    with_length,
)
from traps_pipeline.scenes.worlds.shot import shown_points
from traps_pipeline.scenes.worlds.spec import SceneSpec
from traps_pipeline.scenes.worlds.world import World
from traps_pipeline.video.policies import POLICIES, fewest_within, last_of_all, shown_at_end

if TYPE_CHECKING:
    import mujoco

# --- thresholds: a family has its own `min_margin_m`, and may have its own `legible` ----------------------------------

TURNS_DEG = 10.0  # so far the thing turns that a scene is about
COMMITTED_BEFORE_END_S = 0.6  # so long the outcome must have stood at the end
WALL_PIXELS = 150.0  # of the drawn edges of a wall that is not drawn itself
LEGIBLE_PIXELS = 150.0  # of each decisive body at the end of the control
REFERENT_PIXELS = 80.0  # of whatever a question names, in each frame of the void
MOVING_S = 0.5  # so long a body must be seen moving that is hidden later
MOVES_PX = 0.5  # from one frame to the next: less is at rest to the eye
SAME_START_S = 0.3  # so long any machine's physics agrees
SAME_START_M = 0.005
EARLIEST_CUT_S = 1.0  # the last frame that a cut void shows is not before this
MAX_DEVIATION_PX = 0.5  # futures less far from the control than this look like it
MIN_ACCEPTED = 64  # futures that look like the control up to the cut and have an outcome
TOP_SHARE = 0.60  # of the commonest outcome among them: how often the best guess is right
MIN_ENTROPY_BITS = 1.0
MIN_ENTROPY_THREE_LABELS_BITS = 0.9
CUT_SETTLED = 16  # futures of the state at the cut that have an outcome
CUT_TOP_SHARE = 0.75  # of the commonest outcome among them: a sample of few of what is drawn to be at most TOP_SHARE
CUT_TRUTH_SHARE = 0.05  # of the recorded outcome: less is a rare future, which nobody who reckons well would expect
# The futures of another CPU are another sample: what a cut promised by a narrow margin it may miss there by chance.
ELSEWHERE_ACCEPTED = 48
ELSEWHERE_TOP_SHARE = 0.80
ELSEWHERE_LESS_BITS = 0.35
SAME_TWIN_START = 2.5e-7  # (m, rad) two roundings to float32 are no further apart
_NOISE_S = 1e-6  # far below a frame


def earliest_cut(physics: Physics) -> int:
    """Return the first admissible cut frame; the frame before is at 1.0 s or later."""
    return math.ceil(EARLIEST_CUT_S * physics.fps - 1e-9) + 1


def least_entropy_bits(labels: int) -> float:
    """Return the minimum entropy (bits) of an open cut for a number of answers."""
    return MIN_ENTROPY_THREE_LABELS_BITS if labels == 3 else MIN_ENTROPY_BITS


# --- records ----------------------------------------------------------------------------------------------------------


def certificates_for(kind: VoidKind, *about: About) -> list[Certificate]:
    """Return a void kind's certificates in order; `about` selects some by subject."""
    return [c for c in CERTIFICATES if kind in c.kinds and (not about or c.about in about)]


def pair_of(spec: SceneSpec, qpos: np.ndarray, twin: np.ndarray, *, frame_step: int = 1) -> Pair:
    """Return the pair of a record from its trajectories, (F, nq), without evidence.

    frame_step: step between the frames of pixel certificates (1: full rate; 2: the 5 FPS sample).
    """
    control = World.of_record(spec, qpos, frame_step=frame_step)
    void_frame = spec.void["hidden_from_frame" if spec.void_kind == "occluder" else "cut_frame"]
    return Pair(
        control=control,
        claim=Claim.of_record(spec),
        futures=futures_of(control, spec.seed, void_frame),
        void_frame=void_frame,
        twin=World.of_record(spec, twin, twin=True, frame_step=frame_step),
        rollout=spec.twin.rollout,
    )


def futures_of(control: World, seed: int, cut: int | None = None) -> ensemble.Futures:
    """Return the simulated futures of a control, to choose a cut by or to certify the cut."""
    first = earliest_cut(control.physics) if cut is None else cut
    alike_px = MAX_DEVIATION_PX / fineness(control.params)
    return ensemble.Futures(control, seed, first=first, alike_px=alike_px, held_s=COMMITTED_BEFORE_END_S)


def stored_evidence(spec: SceneSpec) -> dict[str, Any]:
    """Return a record's evidence, with its other fields on void and twin."""
    evidence = spec.evidence | {"twin_answer": spec.twin.ground_truth}
    physics = Physics(**spec.physics)
    evidence |= _closes(spec.closes_frame, physics)
    if "commit_s" in spec.evidence:
        commit_s: float = spec.evidence["commit_s"]
        evidence["settles_share"] = settles_share(round(commit_s * physics.fps), physics.n_frames)
    if spec.void_kind == "truncation":
        evidence |= _cut_evidence(spec.void["cut_frame"], spec.physics["fps"])
    return evidence


# --- outcome ----------------------------------------------------------------------------------------------------------


def _outcome_evidence(outcome: Outcome, fps: float) -> Evidence:
    return {"label": outcome.label, "commit_s": outcome.commit_frame / fps, "margin_m": outcome.margin_m}


def _judge_outcome(e: Evidence, claim: Claim) -> Failures:
    if "label" in e:
        if e["label"] is None:
            yield "the outcome is undecided at the end of the control"
        if e["label"] != claim.answer:
            yield f"the control shows {e['label']!r}, the record says {claim.answer!r}"
    settled_s = claim.end_s - e["commit_s"]
    if settled_s < COMMITTED_BEFORE_END_S - _NOISE_S:
        yield f"outcome {claim.answer!r} is committed only {settled_s:.1f} s before the end"
    min_margin = claim.family.min_margin_m
    if not e["margin_m"] >= min_margin:
        yield f"outcome {claim.answer!r} has a margin of {e['margin_m']:.4f} m, below {min_margin} m"


OUTCOME = Certificate(
    name="outcome",
    about="control",
    promises=f"replayed, the control ends in the ground truth, constant for the last {COMMITTED_BEFORE_END_S} s, a "
    "stated distance (m) from another outcome, which is at least its family's least; measured again, settling time and "
    "margin are those of the record: exactly where simulating gives the frozen trajectory bit by bit, to one unit of "
    "the last stored digit where it does not (another CPU or version)",
    does_not_promise="that a person reads the question as we do: that is what review and corrections are for",
    numbers=(Number("label", kept=False), Number("commit_s", 3), Number("margin_m", 5)),
    measure=lambda pair: _outcome_evidence(pair.control.outcome, pair.control.physics.fps),
    judge=_judge_outcome,
)


def settled_outcome(family: Family, motion: Motion, params: Any) -> Outcome:
    """Return the outcome of a trajectory if it can be certified. Raises Rejected."""
    outcome = read_outcome(family, motion, params)
    fps = 1.0 / float(motion.times[1] - motion.times[0])
    claim = Claim(family, float(motion.times[-1]), 0, outcome.label)
    failure = OUTCOME.failure(_outcome_evidence(outcome, fps), claim)
    if failure is not None:
        raise Rejected(failure)
    return outcome


def settled_answer(world: World) -> str | None:
    """Return the answer that a world ends in; None if it cannot be certified."""
    try:
        return settled_outcome(world.family, world.motion, world.params).label
    except Rejected:
        return None


def _judge_pace(e: Evidence, claim: Claim) -> Failures:
    failure = out_of_pace(e["settles_share"])
    if failure is not None:
        yield failure


PACE = Certificate(
    name="pace",
    about="control",
    promises=f"the outcome settles after {EARLIEST_SHARE:.0%} to {LATEST_SHARE:.0%} of the clip's frames",
    does_not_promise="",
    numbers=(Number("settles_share", kept=False),),
    measure=lambda pair: {"settles_share": settles_share(pair.control.outcome.commit_frame, len(pair.control.qpos))},
    judge=_judge_pace,
)


def _judge_turns(e: Evidence, claim: Claim) -> Failures:
    turns = e.get("turns_deg")
    if turns is not None and turns < TURNS_DEG:
        yield f"what the scene is about turns by {turns:.1f} degrees, {TURNS_DEG:.0f} wanted"


TURNS = Certificate(
    name="turns",
    about="control",
    promises=f"where the scene is about a thing that turns, and nothing but the ball moves it (the seesaw), this is "
    f"struck and turns by {TURNS_DEG:.0f} degrees or more in some frame",
    does_not_promise="that the twin's turns as well",
    numbers=(Number("turns_deg", kept=False),),
    measure=lambda pair: {"turns_deg": pair.control.outcome.turns_deg},
    judge=_judge_turns,
)


def _walls(pair: Pair) -> Evidence:
    control = pair.control
    shown_by = outlines(control.model, control.camera, control.qpos[0])
    if not shown_by:
        return {"walls_px": {}}
    edges = sorted({edge for names in shown_by.values() for edge in names})
    with control.renderer() as renderer:
        pixels_of = dict(zip(edges, renderer.visible_pixels(control.qpos[:1], edges)[0].tolist(), strict=True))
    return {"walls_px": {wall: sum(pixels_of[edge] for edge in names) for wall, names in shown_by.items()}}


def _judge_walls(e: Evidence, claim: Claim) -> Failures:
    for wall, pixels in e.get("walls_px", {}).items():
        if pixels < WALL_PIXELS:
            yield f"the edges of {wall!r}, a wall that is not drawn, have {pixels:.0f} pixels, {WALL_PIXELS:.0f} wanted"


WALLS = Certificate(
    name="walls",
    about="control",
    promises="whatever things could bounce off is drawn: each solid part that is not has drawn edges, which have "
    f"{WALL_PIXELS:.0f} pixels in the first frame (but for a pane before the scene that lies parallel to the picture, "
    f"within {FACES_THE_EYE_DEG:.0f} degrees: it stops only what would come towards the eye)",
    does_not_promise="that a person sees at once how far a pane reaches",
    numbers=(Number("walls_px", kept=False),),
    measure=_walls,
    judge=_judge_walls,
)


# --- physics, picture -------------------------------------------------------------------------------------------------


def _physics(pair: Pair) -> Evidence:
    control = pair.control
    if control.same_physics:
        return {"same_physics": True, "simulated_answer": None, "parted_m": 0.0}
    trajectory = control.resimulated
    if trajectory.shape != control.qpos.shape:
        raise Rejected(f"the scene has {trajectory.shape[1]} coordinates, its trajectory others")
    start = round(SAME_START_S * control.physics.fps) + 1
    parted_m = float(np.abs(trajectory[:start] - control.qpos[:start]).max())
    answer = settled_answer(replace(control, qpos=trajectory))
    return {"same_physics": False, "simulated_answer": answer, "parted_m": parted_m}


def _judge_physics(e: Evidence, claim: Claim) -> Failures:
    if e.get("same_physics", True):
        return
    if claim.family.taxonomy == "occlusion" and e["simulated_answer"] != claim.answer:
        yield f"simulated here, the scene ends in {e['simulated_answer']!r}, its trajectory is of another scene"
    if e["parted_m"] > SAME_START_M:
        yield f"simulated here, the scene parts from its trajectory at once ({e['parted_m']:.3f})"


PHYSICS = Certificate(
    name="physics",
    about="control",
    promises="simulating the scene gives the frozen trajectory; on another CPU or version: the same start (for "
    f"{SAME_START_S} s within {SAME_START_M} m), the same outcome (occlusion), and it says so",
    does_not_promise="that chaotic futures are the same on every machine",
    numbers=tuple(Number(name, kept=False) for name in ("same_physics", "simulated_answer", "parted_m")),
    measure=_physics,
    judge=_judge_physics,
)


def _in_frame(pair: Pair) -> Evidence:
    control = pair.control
    return {"in_frame": is_in_frame(control.camera, shown_points(control.model, control.scene, control.qpos))}


def _judge_in_frame(e: Evidence, claim: Claim) -> Failures:
    if not e.get("in_frame", True):
        yield "something decisive leaves the frame"


IN_FRAME = Certificate(
    name="in_frame",
    about="control",
    promises="all that moves, and the outcome zone, stays inside the picture",
    does_not_promise="",
    numbers=(Number("in_frame", kept=False),),
    measure=_in_frame,
    judge=_judge_in_frame,
)


def legible_groups(
    family: Family, model: mujoco.MjModel, scene: Scene, motion: Motion, params: Any
) -> list[tuple[tuple[str, ...], float]]:
    """Return groups of geoms, each with the pixels that it must show at the control's end."""
    if family.legible is not None:
        return list(family.legible(motion, params))
    return [(decisive_geoms(model, [body]), LEGIBLE_PIXELS) for body in scene.decisive]


def _legible(pair: Pair) -> Evidence:
    control = pair.control
    groups = legible_groups(control.family, control.model, control.scene, control.motion, control.params)
    if not groups:
        raise Rejected("nothing says what must be seen at the end of the control")
    with control.renderer() as renderer:
        last_s = COMMITTED_BEFORE_END_S if control.closing is None else IN_VIEW_S
        frames_shown = shown_at_end(len(control.qpos), control.physics.fps, last_s, control.open_frames)
        frames = control.qpos[frames_shown]
        pixels_by_group = checks.least_visible(renderer, frames, groups)
    too_small = [
        f"{pixels:.0f} of {min_pixels:.0f} pixels of {names[0]}"
        for (names, min_pixels), pixels in zip(groups, pixels_by_group, strict=True)
        if pixels < min_pixels
    ]
    return {"too_small": too_small, "least_visible_px": min(pixels_by_group)}


def _judge_legible(e: Evidence, claim: Claim) -> Failures:
    if e.get("too_small"):
        yield f"too small at the end: {e['too_small'][0]}"
    # A family's own groups are told by `too_small` alone.
    min_pixels = LEGIBLE_PIXELS if claim.family.legible is None else 1
    if e["least_visible_px"] < min_pixels:
        yield f"too small at the end: {e['least_visible_px']:.0f} of {min_pixels:.0f} pixels"


LEGIBLE = Certificate(
    name="legible",
    about="control",
    promises=f"each decisive body has {LEGIBLE_PIXELS:.0f} pixels in each frame of the last {COMMITTED_BEFORE_END_S} s "
    f"({IN_VIEW_S} s before a control closes) that a model is shown ({', '.join(map(str, POLICIES))}), or the family's "
    "own groups of geoms (of a die, the top face) have what the family asks for",
    does_not_promise="that a model's own resizing keeps them",
    numbers=(Number("too_small", kept=False), Number("least_visible_px", compared=False)),
    measure=_legible,
    judge=_judge_legible,
)


def _order(pair: Pair) -> Evidence:
    control, span = pair.control, pair.control.outcome.in_order
    if span is None:
        return {"order_frames": None}
    span = (span[0], min(span[1], control.open_frames))  # what an occluder hides is not seen
    return {"order_frames": fewest_within(len(control.qpos), control.physics.fps, span)}


def _judge_order(e: Evidence, claim: Claim) -> Failures:
    if e["order_frames"] == 0:
        yield "no sampled frame shows the first of two events before the second one has happened"


ORDER = Certificate(
    name="order",
    about="control",
    promises="where the question is about which comes first, each model is shown a frame in which the first one has "
    f"come and no other has ({', '.join(map(str, POLICIES))})",
    does_not_promise="that it is seen under other ways to pick frames, such as the first and the last one alone",
    numbers=(Number("order_frames"),),
    measure=_order,
    judge=_judge_order,
)


# --- occlusion --------------------------------------------------------------------------------------------------------


def _first_hidden_frame(pair: Pair) -> int:
    """Return the first evidence frame from which the void hides what decides."""
    return -(-pair.void_from // pair.control.frame_step)


def _hidden(pair: Pair) -> Evidence:
    return {
        "past_panel_px": pair.control.past_occluder.leaked(_first_hidden_frame(pair)),
        "hidden_from_s": pair.void_from / pair.control.physics.fps,
    }


def _judge_hidden(e: Evidence, claim: Claim) -> Failures:
    message = "the occluder does not hide the outcome before it is committed"
    if e.get("past_panel_px"):
        yield f"{message}: {e['past_panel_px']:.0f} pixels of decisive bodies or the hidden element are seen past it"
    if e["hidden_from_s"] >= e["commit_s"]:
        yield message


HIDDEN = Certificate(
    name="hidden",
    about="void",
    promises="no pixel of a decisive body is seen from hiding on, which begins before the outcome is settled; none of "
    "the hidden element in any void frame",
    does_not_promise="",
    numbers=(Number("past_panel_px", kept=False), Number("hidden_from_s")),
    measure=_hidden,
    judge=_judge_hidden,
    kinds=("occluder",),
)


def _ablation(pair: Pair) -> Evidence:
    control = pair.control
    return {
        "ablation_px": control.ablation_px(
            control.evidence_frames[_first_hidden_frame(pair) :], control.concealed_geoms
        )
    }


def _judge_ablation(e: Evidence, claim: Claim) -> Failures:
    if e["ablation_px"] != 0:
        change = f"taking it away changes {e['ablation_px']} pixels of the void"
        yield f"something decisive reaches the eye past the occluder: {change}"


ABLATION = Certificate(
    name="ablation",
    about="void",
    promises="from hiding on, taking away the decisive bodies and the hidden element changes no pixel of the void: not "
    "even a shadow shows",
    does_not_promise="",
    numbers=(Number("ablation_px"),),
    measure=_ablation,
    judge=_judge_ablation,
    kinds=("occluder",),
)


def _judge_answer_of_twin(e: Evidence, claim: Claim) -> Failures:
    if e["twin_answer"] in (None, claim.answer) or e["twin_answer"] != claim.twin_answer:
        contradiction = f"recorded {claim.twin_answer!r}, the scenario ends in {claim.answer!r}"
        yield f"the twin ends in {e['twin_answer']!r}; {contradiction}"


def _twin_behind_occluder(pair: Pair) -> Evidence:
    control, twin, twins = pair.control, pair.other_world, pair.control.family.twins
    pixels, _ = checks.differing_pixels(control.void_frames, twin.void_frames)
    return {
        "hidden_alone": twins is not None and twin.params in list(twins(control.params)),
        "twin_answer": settled_answer(twin),
        "twin_px": pixels,
    }


def _judge_twin_behind_occluder(e: Evidence, claim: Claim) -> Failures:
    if not e.get("hidden_alone", True):
        yield "the twin differs in more, or in less, than the hidden element"
    yield from _judge_answer_of_twin(e, claim)
    if e["twin_px"] != 0:
        yield f"the twin's void differs from the void: in {e['twin_px']} pixels"


TWIN_BEHIND_OCCLUDER = Certificate(
    name="twin",
    about="twin",
    promises="another world, different in the hidden element alone and with another answer, has the same void frames "
    "byte for byte: two worlds, one video, so no observer can know",
    does_not_promise="that the two worlds are equally likely a priori",
    numbers=(Number("hidden_alone", kept=False), Number("twin_answer", kept=False), Number("twin_px")),
    measure=_twin_behind_occluder,
    judge=_judge_twin_behind_occluder,
    kinds=("occluder",),
)


def named_nouns(question: str, scene: Scene) -> list[str]:
    """Return a scene's nouns that a question names, in the inventory's order."""
    text = question.lower()
    return [noun for noun in scene.inventory.objects if re.search(rf"\b{noun}(s|es)?\b", text)]


def _is_called(name: str, nouns: Sequence[str]) -> bool:
    return any(name == noun or name.startswith(f"{noun}_") for noun in nouns)


def _referents(pair: Pair) -> Evidence:
    control = pair.control
    assert control.occluder is not None, "a pair with an occluder has an occluder"
    scene, model, fps = control.scene, control.model, control.physics.fps / control.frame_step
    rigid = np.flatnonzero((model.body_weldid > 0) & ~soft_body_mask(model))
    bodies = {*(model.body(int(i)).name for i in rigid), *flexes(model)}
    # Distractors are neither named nor the cause.
    moving_bodies = {body for body in bodies if not body.startswith(DISTRACTOR)}
    seconds_moving: dict[str, float] = {}
    for body in sorted(moving_bodies):
        pixels = control.pixels_of(decisive_geoms(model, [body]))
        places = control.camera.project(control.motion.pos(body)[:: control.frame_step])
        seconds_moving[body] = checks.seen_moving(pixels, places, least_px=REFERENT_PIXELS, step_px=MOVES_PX) / fps
    flag_px = [float(control.pixels_of([flag_of(phrase)]).min()) for phrase in scene.marks]
    visibility, least_px, least_s = {}, flag_px, []
    for noun in named_nouns(pair.claim.question, scene):
        nouns = (noun, *scene.shown_by.get(noun, ()))
        has_flag = any(phrase.split()[-1] in nouns for phrase in scene.marks)
        moving_s = [seconds_moving[body] for body in seconds_moving if _is_called(body, nouns)]
        static = [name for name in control.geoms if _is_called(name, nouns) and not _is_of(model, name, moving_bodies)]
        if has_flag:
            visibility[noun] = "marked"
        elif moving_s:
            visibility[noun] = "seen moving" if min(moving_s) >= MOVING_S - _NOISE_S else "hidden"
            least_s.append(min(moving_s))
        else:
            least_px.append(float(control.pixels_of(static).min()))
            visibility[noun] = "in view" if least_px[-1] >= REFERENT_PIXELS else "hidden"
    worlds, every = (control, pair.other_world), control.physics.fps // checks.SAMPLED_FPS
    swept_corners = [swept_points(world.model, world.qpos[::every]).reshape(-1, 8, 3) for world in worlds]
    return {
        "referents": visibility,
        "referents_px": min(least_px, default=None),
        "referents_moving_s": None if not least_s else round(min(least_s), 3),
        "cause_moving_s": round(max(seconds_moving.values(), default=0.0), 3),
        "panel_covers": float(
            np.mean([checks.swept_behind(control.camera, list(swept), control.occluder) for swept in swept_corners])
        ),
    }


def _is_of(model: mujoco.MjModel, name: str, bodies: Collection[str]) -> bool:
    """Return whether a soft body, or a geom's body, is one of some bodies."""
    return name in bodies if name in flexes(model) else model.body(int(model.geom(name).bodyid[0])).name in bodies


def _judge_referents(e: Evidence, claim: Claim) -> Failures:
    if not e["referents"]:
        yield "the question names nothing that is in the scene"
    pixels, moving_s = e["referents_px"], e["referents_moving_s"]
    if pixels is not None and pixels < REFERENT_PIXELS:
        yield f"something that the question names has {pixels:.0f} pixels in a void frame, {REFERENT_PIXELS:.0f} wanted"
    for subject, seconds in (("something that the question names", moving_s), ("the cause", e["cause_moving_s"])):
        if seconds is not None and seconds < MOVING_S - _NOISE_S:
            yield f"{subject} is seen moving for {seconds:.1f} s, {MOVING_S} wanted"


REFERENTS = Certificate(
    name="referents",
    about="void",
    promises=f"everything that the question names has {REFERENT_PIXELS:.0f} pixels in every void frame, itself or by a "
    f"flag where it stands or begins in every world, or is seen moving for {MOVING_S} s before it is hidden (the "
    f"record says which); some body is seen moving for {MOVING_S} s; of the pixels over which anything moves, the "
    "occluder covers the stated share, a mean of both worlds",
    does_not_promise="that a person takes the flag for the thing",
    numbers=(
        Number("referents"),
        *(Number(name, compared=False) for name in ("referents_px", "referents_moving_s", "cause_moving_s")),
        Number("panel_covers", 3),
    ),
    measure=_referents,
    judge=_judge_referents,
    kinds=("occluder",),
)


# --- chaotic ----------------------------------------------------------------------------------------------------------


def _cut_evidence(frame: int, fps: float) -> Evidence:
    return {"last_shown_s": (frame - 1) / fps, "cut_s": frame / fps}


def _judge_cut(e: Evidence, claim: Claim) -> Failures:
    if e["last_shown_s"] < EARLIEST_CUT_S - _NOISE_S or e["cut_s"] > e["commit_s"] + _NOISE_S:
        yield f"the cut at {e['cut_s']:.1f} s is before {EARLIEST_CUT_S} s or after commitment"


CUT = Certificate(
    name="cut",
    about="void",
    promises=f"the void ends at {EARLIEST_CUT_S} s or later, and before the outcome is settled",
    does_not_promise="",
    numbers=(Number("last_shown_s", kept=False), Number("cut_s", kept=False)),
    measure=lambda pair: _cut_evidence(pair.void_from, pair.control.physics.fps),
    judge=_judge_cut,
    kinds=("truncation",),
)


def _open(pair: Pair) -> Evidence:
    machine = {"same_physics": pair.control.same_physics}
    evidence: Evidence = {}
    for rollouts in pair.futures.batches():
        evidence = ensemble.at_cut(rollouts, pair.void_from, pair.control.family.perturbation).evidence()
        if OPEN.failure(machine | evidence, pair.claim) is None:
            break
    return {**evidence, **open_from_state(pair.futures, pair.void_from, pair.claim)}


def open_from_state(futures: ensemble.Futures, cut: int, claim: Claim) -> Evidence:
    """Return the evidence that the state at a cut leaves the outcome open."""
    counts = {label: n for label, n in futures.after(cut).items() if label is not None}
    n_settled = sum(counts.values())
    return {
        "cut_settled": n_settled,
        "cut_top_share": max(counts.values(), default=0) / max(1, n_settled),
        "cut_truth_share": counts.get(claim.answer or "", 0) / max(1, n_settled),
    }


def _judge_open(e: Evidence, claim: Claim) -> Failures:
    min_accepted, min_entropy, max_share = MIN_ACCEPTED, least_entropy_bits(claim.labels), TOP_SHARE
    if not e.get("same_physics", True):
        min_accepted, min_entropy, max_share = (
            ELSEWHERE_ACCEPTED,
            round(min_entropy - ELSEWHERE_LESS_BITS, 2),
            ELSEWHERE_TOP_SHARE,
        )
    if e["accepted"] < min_accepted:
        yield f"{e['accepted']} futures that look alike up to the cut have an outcome, {min_accepted} wanted"
    if e["entropy_bits"] < min_entropy:
        yield f"the futures disagree by {e['entropy_bits']:.2f} bits, {min_entropy} wanted"
    if e["top_share"] > max_share:
        yield f"the best guess is right in {e['top_share']:.1%} of the futures, at most {max_share:.0%} allowed"
    if "cut_settled" in e and e.get("same_physics", True):
        yield from _judge_open_at_cut(e)


def _judge_open_at_cut(e: Evidence) -> Failures:
    if e["cut_settled"] < CUT_SETTLED:
        yield f"{e['cut_settled']} futures of the state at the cut have an outcome, {CUT_SETTLED} wanted"
    if e["cut_top_share"] > CUT_TOP_SHARE:
        yield f"{e['cut_top_share']:.1%} of the futures of the state at the cut agree, at most {CUT_TOP_SHARE:.0%} may"
    if e["cut_truth_share"] < CUT_TRUTH_SHARE:
        share = f"{e['cut_truth_share']:.1%} of the futures of the state at the cut"
        yield f"the recorded outcome is a rare one, of {share}, at least {CUT_TRUTH_SHARE:.0%} are wanted"


OPEN = Certificate(
    name="open",
    about="void",
    promises=f"of {ensemble.BATCHES[1]} or {ensemble.TRIED} starts, perturbed by one stated scale, at least "
    f"{MIN_ACCEPTED} stay within {MAX_DEVIATION_PX} px of the control up to the cut and end in an outcome: its entropy "
    f"is {MIN_ENTROPY_BITS} bit or more ({MIN_ENTROPY_THREE_LABELS_BITS} with three answers), and the "
    f"best guess, the commonest answer, is right in at most {TOP_SHARE * 100:.0f} % of them; on another CPU or version "
    f"the futures are simulated there, are another sample, and are held against {ELSEWHERE_ACCEPTED} futures, "
    f"{ELSEWHERE_LESS_BITS} bits less and {ELSEWHERE_TOP_SHARE * 100:.0f} %; where simulating gives the frozen "
    f"trajectory, of {ensemble.AT_CUT} states at the cut that no viewer tells apart (places differ by "
    f"{ensemble.UNSEEN_PX} px, speeds by what that is over {ensemble.READ_OVER_S} s, one standard deviation) at least "
    f"{CUT_SETTLED} end in an outcome, at most {CUT_TOP_SHARE * 100:.0f} % of these in the same one, and at least "
    f"{CUT_TRUTH_SHARE * 100:.0f} % in the recorded one",
    does_not_promise="that no one could ever compute the future from exact pixels: the perturbation is far below one",
    numbers=(
        Number("entropy_bits", 4, of_futures=True),
        Number("top_share", 4, of_futures=True),
        *(Number(name, of_futures=True) for name in ("accepted", "tried", "unresolved")),
        Number("perturbation"),
        *(Number(name, kept=False) for name in ("cut_settled", "cut_top_share", "cut_truth_share")),
    ),
    measure=_open,
    judge=_judge_open,
    kinds=("truncation",),
)


def _twin_of_cut(pair: Pair) -> Evidence:
    if pair.rollout is None:
        raise Rejected("nothing says from which start the twin comes")
    start, future = pair.futures.start(pair.rollout), pair.futures.rollout(pair.rollout)
    control, twin, cut = pair.control, pair.other_world, slice(0, pair.void_from)
    shown_frames = slice(0, pair.void_from, control.frame_step)
    apart_px = ensemble.deviation_px(control.model, control.camera, control.qpos[cut], twin.qpos[cut])
    with control.renderer() as renderer:
        frames = list(renderer.frames(control.qpos[shown_frames]))
        _, largest_difference = checks.differing_pixels(frames, renderer.frames(twin.qpos[shown_frames]))
    return {
        "twin_answer": settled_answer(twin),
        "twin_deviation_px": apart_px * fineness(control.params),
        "twin_largest_difference": largest_difference,
        "start_off": float(np.abs(start.astype(np.float32) - twin.qpos[0]).max()),
        "rebuilt": future.qpos is not None and np.array_equal(future.qpos, twin.qpos),
        "rebuilt_answer": future.label,
    }


def _judge_twin_of_cut(e: Evidence, claim: Claim) -> Failures:
    yield from _judge_answer_of_twin(e, claim)
    if e.get("start_off", 0.0) > SAME_TWIN_START:
        yield f"the twin's trajectory begins {e['start_off']:.1e} beside the start that the record names"
    if e.get("same_physics", True) and not e.get("rebuilt", True):
        yield f"simulated again, the twin's start ends in {e['rebuilt_answer']!r}: its trajectory is of another start"
    if e.get("twin_deviation_px", 0) > MAX_DEVIATION_PX:
        yield f"the twin is {e['twin_deviation_px']:.2f} pixels off before the cut"


TWIN_OF_CUT = Certificate(
    name="twin",
    about="twin",
    promises="one of those futures, with another answer: the start that the record names by its number leads to the "
    "frozen twin bit by bit (on another CPU or version: begins as it does); its largest pixel difference before the "
    "cut is reported",
    does_not_promise="byte-identical frames",
    numbers=(
        Number("twin_answer", kept=False),
        Number("twin_deviation_px", kept=False),
        Number("twin_largest_difference", compared=False),
        *(Number(name, kept=False) for name in ("start_off", "rebuilt", "rebuilt_answer")),
    ),
    measure=_twin_of_cut,
    judge=_judge_twin_of_cut,
    kinds=("truncation",),
)


# --- how a control ends -----------------------------------------------------------------------------------------------


def _closes(frame: int | None, physics: Physics) -> Evidence:
    if frame is None:
        return {"closes_s": None, "looks_until_s": None}
    return {"closes_s": frame / physics.fps, "looks_until_s": last_of_all(physics.n_frames, physics.fps) / physics.fps}


def _closing_evidence(pair: Pair) -> Evidence:
    control, fps = pair.control, pair.control.physics.fps
    if control.closing is None:
        no_reading = {"read_answer": None, "read_s": None, "closed_px": None, "closed_change_px": None}
        return {**_closes(None, control.physics), **no_reading}
    outcome, end = control.outcome_read, control.closed_frames
    ablated = control.ablation_px(end, control.closed_geoms)
    n_differing, _ = checks.differing_pixels(control.behind_occluder(end), pair.other_world.behind_occluder(end))
    return {
        **_closes(control.closing.frame, control.physics),
        "read_answer": outcome.label,
        "read_s": (control.closing.frame - outcome.commit_frame) / fps,
        "closed_px": float(control.pixels_of(control.closed_geoms, end).sum()),
        "closed_change_px": ablated + n_differing,
    }


def _judge_closing(e: Evidence, claim: Claim) -> Failures:
    if e["closes_s"] is None:
        return
    if e.get("read_answer", claim.answer) != claim.answer:
        yield f"before the occluder comes the control shows {e['read_answer']!r}, the record says {claim.answer!r}"
    if min(e["read_s"], e["closes_s"] - e["commit_s"]) < IN_VIEW_S - _NOISE_S:
        yield f"the occluder comes at {e['closes_s']:.1f} s, less than {IN_VIEW_S} s after the outcome has settled"
    if e["closes_s"] > e["looks_until_s"] + _NOISE_S:
        yield f"the occluder comes at {e['closes_s']:.1f} s; a model is shown no frame after {e['looks_until_s']:.1f} s"
    if e["closed_px"]:
        yield f"{e['closed_px']:g} pixels of what the occluder must hide are seen past it"
    if e["closed_change_px"]:
        yield f"behind the occluder the outcome changes {e['closed_change_px']} pixels of the control's end"


CLOSING = Certificate(
    name="closing",
    about="twin",
    promises="where the control closes: the frames before the occluder comes show the ground truth by themselves, "
    "settled "
    f"for {IN_VIEW_S} s or more; the occluder stands to the end and in the last frame that a model is shown "
    f"({', '.join(map(str, POLICIES))}); from its coming on no pixel shows a decisive body or the hidden element "
    "(chaotic: anything that moves), taking them away changes no pixel, and the twin, with its other answer, has the "
    "same frames byte for byte: nobody can answer from the last frame",
    does_not_promise="that what happens before the outcome, seen in part, cannot be answered from some other frame",
    numbers=(
        *(Number(name, kept=False) for name in ("closes_s", "looks_until_s", "read_answer")),
        *(Number(name) for name in ("read_s", "closed_px", "closed_change_px")),
    ),
    measure=_closing_evidence,
    judge=_judge_closing,
)


# --- two worlds -------------------------------------------------------------------------------------------------------


def _uncut(world: World) -> World:
    """Return a record's world at its family's length, simulated here if it was cut."""
    physics = with_length(world.physics, world.family.physics.n_frames)
    if physics == world.physics:
        return world
    return replace(world, physics=physics, qpos=simulated(*compile_scene(world.family, world.params, physics), physics))


def _setting_differences(pair: Pair) -> list[str]:
    """Return the settings of a pair that its worlds, in this order, do not give."""
    worlds, seed = (pair.control, pair.other_world), pair.claim.seed
    full_worlds = [_uncut(world) for world in worlds]
    closing, settings = pair.control.closing, []
    if len(pair.control.qpos) not in lengths(full_worlds, seed):
        settings.append("length")
    if closing is not None and closing.frame not in moments(worlds, seed):
        settings.append("closing")
    return settings


def _exchange(pair: Pair) -> Evidence:
    exchanged, first_failure = pair.exchanged, None
    world, twin = exchanged.control, exchanged.other_world
    evidence: dict[str, Any] = {}
    is_exact = is_exchangeable(world.family) and world.same_physics and twin.same_physics
    for certificate in certificates_for("occluder", "control") if is_exchangeable(world.family) else ():
        evidence |= certificate.measured(exchanged)
        failure = certificate.failure(evidence, exchanged.claim)
        if failure is not None and first_failure is None:
            first_failure = f"{certificate.name}: {failure}"
    return {
        "twin_commit_s": world.outcome.commit_frame / world.physics.fps,
        "twin_read_answer": None if world.closing is None else world.outcome_read.label,
        "other_settings": _setting_differences(exchanged) if is_exact else [],
        "lost_exchanged": first_failure,
    }


def _judge_exchange(e: Evidence, claim: Claim) -> Failures:
    if not is_exchangeable(claim.family):
        return
    if e.get("other_settings"):
        yield f"had the twin been the control, the {' and the '.join(e['other_settings'])} would be another"
    if e.get("lost_exchanged") is not None:
        yield f"with the twin as the control: {e['lost_exchanged']}"
    if e["hidden_from_s"] >= e["twin_commit_s"]:
        yield "the occluder does not hide the outcome of the twin before it is settled"
    if e["closes_s"] is None:
        return
    if e.get("twin_read_answer", claim.twin_answer) != claim.twin_answer:
        yield f"before the occluder comes the twin shows {e['twin_read_answer']!r}, it ends in {claim.twin_answer!r}"
    if e["closes_s"] - e["twin_commit_s"] < IN_VIEW_S - _NOISE_S:
        yield f"the occluder comes at {e['closes_s']:.1f} s, less than {IN_VIEW_S} s after the twin's outcome settles"


EXCHANGE = Certificate(
    name="exchange",
    about="worlds",
    promises="with control and twin exchanged, the length of the clip and the moment at which the control closes are "
    "computed again, and the record's are among those that a draw tries; the twin passes as a control: all that is "
    "certified of a control holds for it, its outcome is hidden before it is settled, and is read before the occluder "
    "comes (on another CPU or version length and moment are not computed again)",
    does_not_promise="that camera and occluder are fitted again (a draw fits them to both worlds, in no order; of the "
    "released records 61 have a camera, and 202 an occluder, that was fitted to the control first); which of several "
    "other worlds is the twin; anything of soft bodies, whose worlds settle too far apart for one length",
    numbers=(
        Number("twin_commit_s", 3),
        *(Number(name, kept=False) for name in ("twin_read_answer", "other_settings", "lost_exchanged")),
    ),
    measure=_exchange,
    judge=_judge_exchange,
    kinds=("occluder",),
)


# --- words ------------------------------------------------------------------------------------------------------------


def _words(pair: Pair) -> Evidence:
    taxonomy, inventory = pair.control.family.taxonomy, pair.control.inventory
    question = pair.claim.ill_posed_question
    return {
        "ill_posed_for": refutation(taxonomy, question, inventory),
        "question_refuted": refutation(taxonomy, pair.claim.question, inventory),
        "premises": 1 if taxonomy == "occlusion" else len(false_premises(question, inventory, near=True)),
        "true_answer": None if taxonomy == "occlusion" else none_as_answer(question),
    }


def _judge_words(e: Evidence, claim: Claim) -> Failures:
    if e["ill_posed_for"] is None:
        yield f"nothing shows that {claim.ill_posed_question!r} has no answer"
    if e["premises"] > 1:
        yield f"{claim.ill_posed_question!r} presumes {e['premises']} things that are not so; one is enough"
    if e["true_answer"] is not None:
        yield f"{claim.ill_posed_question!r} has a true answer: {e['true_answer']}"
    if e["question_refuted"] is not None:
        yield f"the question {claim.question!r} reads as ill-posed: {e['question_refuted']}"


WORDS = Certificate(
    name="words",
    about="words",
    promises="the ill-posed question asks what no video shows (occlusion) or presumes one thing that the inventory "
    f"refutes (chaotic; a colour that it presumes is {FAR_COLOUR:.0f} or more in CIELAB from all in view), and zero, "
    "never, nobody, nothing or no is no true answer to that; the well-posed question does neither",
    does_not_promise="",
    numbers=tuple(
        Number(name, kept=False) for name in ("ill_posed_for", "question_refuted", "premises", "true_answer")
    ),
    measure=_words,
    judge=_judge_words,
)


# --- all of them ------------------------------------------------------------------------------------------------------

CERTIFICATES = (
    OUTCOME,
    PACE,
    TURNS,
    WALLS,
    PHYSICS,
    IN_FRAME,
    LEGIBLE,
    ORDER,
    HIDDEN,
    ABLATION,
    REFERENTS,
    TWIN_BEHIND_OCCLUDER,
    CUT,
    OPEN,
    TWIN_OF_CUT,
    CLOSING,
    EXCHANGE,
    WORDS,
)


def certificate_table() -> str:
    """Return the certificates as a Markdown table; OpenGL affects bracketed numbers."""
    lines = ["| certificate | promises | does not promise | stored |", "| --- | --- | --- | --- |"]
    for certificate in CERTIFICATES:
        kinds = {"occluder": " (occlusion)", "truncation": " (chaotic)"}
        kind = kinds[certificate.kinds[0]] if len(certificate.kinds) == 1 else ""
        numbers = [number for number in certificate.numbers if number.kept]
        stored_names = ", ".join(f"`{number.name}`" if number.compared else f"[`{number.name}`]" for number in numbers)
        cells = (f"`{certificate.name}`{kind}", certificate.promises, certificate.does_not_promise, stored_names)
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)
