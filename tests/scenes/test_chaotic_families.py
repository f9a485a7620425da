"""The chaotic families on released records: outcomes, cuts and their evidence; and the rule that chooses a cut."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import mujoco
import numpy as np
import pytest

from tests.build.errors import raises
from tests.scenes.released import Released, first_of_each, load
from traps_pipeline.scenes.certification.certificates import TWIN_OF_CUT, earliest_cut, futures_of, pair_of
from traps_pipeline.scenes.certification.certify_record import certify
from traps_pipeline.scenes.certification.ensemble import Cut, Rollout, along_contacts, entropy_bits, unseen_steps
from traps_pipeline.scenes.certification.evidence import Claim, Evidence
from traps_pipeline.scenes.draw.resolve import choose_cut, open_cuts
from traps_pipeline.scenes.family_registry import get_family
from traps_pipeline.scenes.physics.kit import Physics
from traps_pipeline.scenes.physics.simulate import simulate
from traps_pipeline.scenes.picture.camera import Camera
from traps_pipeline.scenes.worlds.outcome import Rejected, compile_scene
from traps_pipeline.scenes.worlds.world import World

FIRSTS = first_of_each("truncation")


@pytest.fixture(scope="module", params=FIRSTS)
def stored(request: pytest.FixtureRequest) -> Released:
    """The first released scenario of a chaotic family."""
    return load(request.param)


def control_of(case: Released) -> World:
    return World.of_record(case.spec, case.qpos)


def cut_of(case: Released, *, commit_frame: int | None = None, **family: Any) -> Cut | None:
    """The cut chosen anew, with a changed family or another frame at which the outcome settles."""
    control = control_of(case)
    changed = replace(control, family=replace(case.family, **family))
    claim = replace(Claim.of_record(case.spec), family=changed.family)
    found = choose_cut(futures_of(changed, case.spec.seed), claim, commit_frame or control.outcome.commit_frame)
    return found[0] if found else None


def test_a_scenario_of_every_chaotic_family_is_certified(stored: Released):
    verdict = certify(stored.spec, stored.qpos, stored.twin, frame_step=5)
    assert verdict.failures == {}
    assert verdict.measured["twin_deviation_px"] <= 0.5
    evidence = stored.spec.evidence
    if verdict.same_physics:
        assert round(verdict.measured["entropy_bits"], 4) == evidence["entropy_bits"]
        assert verdict.measured["accepted"] == evidence["accepted"]


def test_a_twin_is_rebuilt_from_the_start_that_the_record_names_and_from_no_other(stored: Released):
    def rebuilt(twin: np.ndarray, more: int = 0) -> tuple[Evidence, str]:
        """What the certificate measures and says if the record names a later start and holds this trajectory."""
        assert stored.spec.twin.rollout is not None
        named = stored.spec.twin.model_copy(update={"rollout": stored.spec.twin.rollout + more})
        pair = pair_of(stored.spec.model_copy(update={"twin": named}), stored.qpos, twin, frame_step=10)
        measured = TWIN_OF_CUT.measured(pair)
        return measured, str(TWIN_OF_CUT.failure(measured, pair.claim))

    measured, failure = rebuilt(stored.twin)
    assert (failure, measured["rebuilt"], measured["start_off"]) == ("None", True, 0.0)
    measured, failure = rebuilt(stored.twin, more=1)
    assert f"{measured['start_off']:.1e}" in failure and not measured["rebuilt"]
    model, scene = compile_scene(stored.family, stored.params, stored.physics)
    model.qpos0[:] = stored.twin[0]  # rounded to float32, as it is stored
    measured, failure = rebuilt(simulate(model, scene, stored.physics))
    assert (measured["rebuilt"], measured["start_off"]) == (False, 0.0)
    assert failure != "None" and any(repr(measured[answer]) in failure for answer in ("rebuilt_answer", "twin_answer"))
    with raises(Rejected, "scenes.certification.ensemble.Futures.start", "128"):
        rebuilt(stored.twin, more=128)


def test_no_cut_where_starts_are_alike_or_part_at_once_or_the_outcome_settles_within_a_second(stored: Released):
    assert cut_of(stored, perturbation=0.0) is None
    assert cut_of(stored, perturbation=0.05) is None
    assert cut_of(stored, commit_frame=10) is None


@pytest.mark.slow  # simulates 128 futures
def test_a_cut_that_is_too_late_is_named_on_any_machine():
    plinko = load("plinko-0001")
    settles = control_of(plinko).outcome.commit_frame
    late, beyond = (plinko.spec.model_copy(update={"void": {"cut_frame": settles + more}}) for more in (0, 1))
    elsewhere = certify(late, plinko.qpos + np.float32(1e-7), plinko.twin, frame_step=10)
    assert not elsewhere.same_physics  # the futures of such a machine are simulated all the same
    assert "open" in elsewhere.failures
    assert elsewhere.measured["tried"] == 128
    said = certify(beyond, plinko.qpos, plinko.twin, frame_step=10).failures["cut"]
    assert f"{(settles + 1) / plinko.physics.fps:.1f} s" in said


@pytest.mark.parametrize(
    ("counts", "bits"),
    [
        ({"a": 32, "b": 32}, 1.0),
        ({"a": 48, "b": 16}, 0.811278),  # 3/4 log2(4/3) + 1/4 log2 4
        ({"a": 16, "b": 16, "c": 16, "d": 16}, 2.0),
        ({"a": 64}, 0.0),
        ({"a": 64, "b": 0}, 0.0),
        ({}, 0.0),
    ],
)
def test_the_entropy_of_outcome_counts_is_shannons_in_bits(counts: dict[str, int], bits: float):
    assert math.isclose(entropy_bits(counts), bits, abs_tol=1e-6)


def test_the_last_frame_of_the_earliest_cut_is_at_one_second():
    assert earliest_cut(Physics(fps=10)) == 11
    assert earliest_cut(Physics(fps=20)) == 21


def rollouts(parted: int, **counts: int) -> list[Rollout]:
    """Rollouts by label; `unresolved` ones have none."""
    return [Rollout(0, parted, None if key == "unresolved" else key) for key, n in counts.items() for _ in range(n)]


def asking(labels: int) -> Claim:
    """A question with so many answers, of a family whose starts are perturbed by 1e-5."""
    return Claim(replace(get_family("plinko"), perturbation=1e-5), end_s=4.9, labels=labels, answer="left")


def latest_open_cut(futures: list[Rollout], frames: range, claim: Claim) -> Cut | None:
    return next(open_cuts(futures, frames, claim), None)


def test_of_all_open_frames_the_latest_is_the_cut():
    futures = rollouts(20, left=32, right=32) + rollouts(15, left=40)
    cut = latest_open_cut(futures, range(11, 31), asking(2))
    assert cut == Cut(20, entropy_bits=1.0, top_share=0.5, accepted=64, tried=104, unresolved=0, perturbation=1e-5)


def test_an_unresolved_rollout_is_counted_but_is_no_outcome():
    futures = rollouts(20, left=40, right=40, unresolved=48)
    cut = latest_open_cut(futures, range(11, 31), asking(2))
    assert cut is not None
    assert (cut.entropy_bits, cut.accepted, cut.unresolved) == (1.0, 80, 48)
    assert latest_open_cut(rollouts(20, left=64, unresolved=64), range(11, 31), asking(2)) is None


def test_fewer_than_64_accepted_rollouts_make_no_cut():
    assert latest_open_cut(rollouts(20, left=32, right=31), range(11, 31), asking(3)) is None


def test_an_outcome_above_60_percent_makes_no_cut_however_high_the_entropy():
    futures = rollouts(20, a=61, b=9, c=10, d=10, e=10)  # 1.75 bits, but 61 %
    assert latest_open_cut(futures, range(11, 31), asking(2)) is None
    assert latest_open_cut([*futures[1:], Rollout(0, 20, "b")], range(11, 31), asking(2)) is not None


# --- the state at the cut ---------------------------------------------------------------------------------------------


def ball_and_lever() -> tuple[mujoco.MjModel, mujoco.MjData]:
    """A ball of 5 cm that lies on a plate, and a lever whose ends are half a metre from its hinge."""
    spec = mujoco.MjSpec()
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=[1, 1, 0.1], pos=[0, 0, -0.1])
    ball = spec.worldbody.add_body(name="ball", pos=[0, 0, 0.0499])
    ball.add_freejoint()
    ball.add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[0.05, 0, 0])
    lever = spec.worldbody.add_body(name="lever", pos=[0, 2, 1])
    lever.add_joint(type=mujoco.mjtJoint.mjJNT_HINGE, axis=[0, 1, 0])
    lever.add_geom(type=mujoco.mjtGeom.mjGEOM_CAPSULE, size=[0.1, 0.4, 0])
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return model, data


def test_what_no_viewer_resolves_is_a_tenth_of_a_pixel_where_a_thing_is() -> None:
    # Eye at y = -2, half-angle 45 degrees: a pixel is 2/180 m at the ball, which is 2 m away, and 4/180 m at the lever.
    camera = Camera((0, 0, 0), 2.0, 90.0, 0.0, 90.0, 1.0, (0, 0, 0))
    model, data = ball_and_lever()
    found = unseen_steps(model, data, camera)
    assert found[:3] == pytest.approx(0.1 * 2 / 180)
    assert found[3:6] == pytest.approx(0.1 * 2 / 180 / 0.05)
    assert found[6] == pytest.approx(0.1 * 4 / 180 / 0.5)


def test_a_thing_that_lies_on_another_is_moved_along_it_and_not_into_it() -> None:
    model, data = ball_and_lever()
    assert data.ncon == 1
    step = along_contacts(model, data, np.array([3e-4, 2e-4, 5e-4, 1e-3, 0, 0, 1e-3]))
    assert step == pytest.approx([3e-4, 2e-4, 0, 1e-3, 0, 0, 1e-3], abs=1e-12)


def test_the_futures_of_the_state_at_a_cut_disagree_and_are_the_same_each_time(stored: Released):
    control, seed, cut = control_of(stored), stored.spec.seed, stored.spec.void["cut_frame"]
    found = futures_of(control, seed, cut).after(cut)
    assert found == futures_of(control, seed, cut).after(cut)
    assert found.total() == 48 and len(found) > 1
    late = control.outcome.commit_frame + 1
    assert futures_of(control, seed, late).after(late)[stored.spec.ground_truth] > 40


def test_questions_word_their_choices_and_their_answers(stored: Released):
    family = stored.family
    for draw in range(50):
        rng = np.random.default_rng([5, draw])
        wording = family.word(family.draw(rng), rng)
        assert set(wording.aliases.values()) <= set(wording.labels)
        assert wording.answerable_question.answer in wording.answerable_question.labels
