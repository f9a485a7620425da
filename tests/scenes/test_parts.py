"""Parts of scene families: draws in the order of the fields, mirrored courses, readings and words worked by hand."""

from __future__ import annotations

from dataclasses import dataclass, make_dataclass

import numpy as np
import pytest

from tests.build.errors import raises
from traps_pipeline.scenes.parts import observers, questions, vary, vision
from traps_pipeline.scenes.parts import readings as outcome
from traps_pipeline.scenes.parts.course import Course, Surface
from traps_pipeline.scenes.physics.kit import COLOURS, Motion, Physics

PLAY_COLOURS = vary.apart("red", "green", "blue", "yellow")


def _direction(rng: np.random.Generator, so_far: vary.Drawn) -> int:
    so_far["lanes"] = 2
    return int(rng.choice([-1, 1]))


@dataclass(frozen=True)
class Params:
    direction: int = vary.drawn_by(_direction)
    ball_colour: str = PLAY_COLOURS()
    length_m: float = vary.between(0.1, 0.2)
    lane_colours: tuple[str, ...] = PLAY_COLOURS("lanes")
    gate: str = vary.hidden("open", "shut", "ajar")
    lane: int = vary.one_of(3, 4)
    azimuth_deg: float = vary.facing(-10, 10)
    elevation_deg: float = vary.between(-30, -20)


def world(**positions: list[list[float]]) -> Motion:
    """A motion of ten frames a second from the places of its bodies."""
    paths = {body: np.array(path, dtype=float) for body, path in positions.items()}
    count = len(next(iter(paths.values())))
    return Motion(np.arange(count) / 10, paths, {body: np.tile(np.eye(3), (count, 1, 1)) for body in paths})


# --- what varies ------------------------------------------------------------------------------------------------------


def test_fields_are_drawn_in_their_order_and_a_group_at_its_first_field() -> None:
    p, rng = vary.draw_params(Params, np.random.default_rng(3)), np.random.default_rng(3)
    assert p.direction == rng.choice([-1, 1])
    colours = [str(c) for c in rng.permutation(["red", "green", "blue", "yellow"])[:3]]
    assert (p.ball_colour, *p.lane_colours) == tuple(colours)
    assert p.length_m == round(float(rng.uniform(0.1, 0.2)), 4)
    assert p.gate == ("open", "shut", "ajar")[int(rng.integers(3))]
    assert p.lane == rng.integers(3, 5)
    assert p.azimuth_deg == 90 - p.direction * round(float(rng.uniform(-10, 10)), 4)


def test_a_twin_has_another_value_of_the_hidden_element_and_nothing_else() -> None:
    p = vary.draw_params(Params, np.random.default_rng(0))
    others = vary.twins(p)
    assert [other.gate for other in others] == [g for g in ("open", "shut", "ajar") if g != p.gate]
    assert all(vars(other) | {"gate": p.gate} == vars(p) for other in others)


def test_the_hidden_element_is_as_likely_whatever_is_seen() -> None:
    draws = [vary.draw_params(Params, np.random.default_rng(seed)) for seed in range(600)]
    for direction in (-1, 1):
        share = np.mean([p.gate == "shut" for p in draws if p.direction == direction])
        assert abs(share - 1 / 3) < 0.08


def test_params_that_cannot_be_drawn_are_named() -> None:
    two = make_dataclass("Two", [("a", bool, vary.hidden(False, True)), ("b", bool, vary.hidden(False, True))])
    with raises(TypeError, "scenes.parts.vary.hidden_field"):
        vary.hidden_field(two)
    with raises(TypeError, "scenes.parts.vary.draw_params", "speed"):
        vary.draw_params(make_dataclass("Bare", [("speed", float)]), np.random.default_rng(0))
    with raises(TypeError, "scenes.parts.vary.twins"):
        vary.twins(make_dataclass("Seen", [("speed", float, vary.between(0, 1))])(0.5))


# --- course -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("direction", [-1, 1])
def test_a_stage_mirrors_what_stands_on_it(direction: int) -> None:
    course = Course(Physics(), direction)
    block = course.block("wall", (0.2, 0.6), (-0.1, 0.3), (0, 0.5), "red", Surface(0.002))
    np.testing.assert_allclose(block.pos, [direction * 0.4, 0.1, 0.25])
    np.testing.assert_allclose(block.size, [0.2, 0.2, 0.25])
    np.testing.assert_allclose(block.friction, [0.8, 0.005, 0.002])
    course.ball("ball", (-0.5, 0, 0.05), 0.05, "blue", speed=0.4)
    np.testing.assert_allclose(course.post("peg", (0.3, 0, 0.1), 0.02, 0.1, "red").pos, [direction * 0.3, 0, 0.1])
    course.hull("wedge", [(1.0, y, z) for y in (0, 1) for z in (0, 1)] + [(1.6, 0.5, 0)], "green")
    assert course.spec.mesh("wedge").uservert[0] == direction * 1.0
    p = vary.draw_params(Params, np.random.default_rng(0))
    scene = course.scene(
        p, decisive=["ball"], hidden=["wall"], cover=None, in_view=[], things=["red wall"], also=["ball"]
    )
    np.testing.assert_allclose(scene.velocity["ball"], [direction * 0.4, 0, 0, 0, direction * 8, 0])
    assert scene.inventory.objects == ("wall", "ball")
    box = course.box((0.1, 0.5), (0, 1), (0, 1), right=0.02)
    assert (box.low[0], box.high[0]) == ((0.1, 0.52) if direction > 0 else (-0.5, -0.08))
    assert course.ahead(0.3) == (0.3 if direction > 0 else 0.0)


# --- outcome ----------------------------------------------------------------------------------------------------------


def test_from_when_a_thing_is_still() -> None:
    line, space = np.array([0, 1, 2, 2.0005, 2]), np.array([[0, 0, 0]] * 3 + [[0, 0, 1]] * 2, dtype=float)
    assert outcome.still_from(line, within_m=0.001) == 2
    assert outcome.still_from(line, space, within_m=0.001) == 3
    assert outcome.still_from(np.stack([space, 0 * space], axis=1), within_m=0.001) == 3
    assert outcome.lasting_from(np.array([True, False])) == 2


def test_readings_that_were_worked_by_hand() -> None:
    holds = np.array([False, False, True, False, False])
    assert outcome.yes_while(holds, 4) == [None, None, "yes", None, "no"]
    assert outcome.side_while(holds, np.array([1, 1, -1, 1, 1.0])) == [None, None, "no", None, None]
    past = np.array([-0.3, 0.1, -0.1, 0.2, 0.25])
    assert outcome.read_crossing(past) == outcome.Reading([None, None, None, "yes", "yes"], 0.25)
    assert outcome.read_crossing(-past, np.arange(5) > 3) == outcome.Reading([None] * 4 + ["no"], 0.25)
    stays = np.array([-0.6, -0.4, -0.31, -0.3])
    assert outcome.read_passage(stays, 0.05).labels == [None, None, "no", "no"]
    assert outcome.read_passage(stays, 0.05).margin_m == pytest.approx(0.2)
    assert outcome.clear_m(stays, 0.1) == pytest.approx(0.2)


def test_the_first_past_a_line_needs_a_lead() -> None:
    motion = world(ball=[[0, 0, 0]] * 8)
    ahead = np.array([[-0.4, -0.5], [0.1, -0.4], [0.2, -0.2], [0.3, 0.1], *[[0.4, 0.2]] * 4])
    won = outcome.first_past(motion, ahead, ("red", "blue"), 0.15)
    assert won == outcome.Reading([None, *["red"] * 7], 0.4, in_order=(1, 3))
    assert set(outcome.first_past(motion, ahead, ("red", "blue"), 0.25).labels) == {None}


# --- questions and observers ------------------------------------------------------------------------------------------


def test_a_question_is_filled_and_read_back() -> None:
    p = vary.draw_params(Params, np.random.default_rng(1))
    asked = questions.yes_no("Does the {ball} ball pass?", yes=["it passes"], no=["it stops"])
    aside = questions.colour_from("ball", "What colour is it: {choices}?", list(COLOURS), unlike=("ball",))
    words = asked.word(p, np.random.default_rng(0), [aside])
    assert words.question == f"Does the {p.ball_colour} ball pass?"
    assert asked.slots_in(words.question) == {"ball": p.ball_colour}
    assert asked.slots_in("Does it pass?") is None
    assert words.aliases == {"it passes": "yes", "it stops": "no"}
    other = questions.yes_no("Does {it} pass?", yes=[], no=[], fills=lambda p, rng: {"it": str(rng.choice(["a", "b"]))})
    assert other.word(p, np.random.default_rng(0), [aside]).question in ("Does a pass?", "Does b pass?")
    answerable = words.answerable_question
    assert answerable.answer == p.ball_colour
    assert len(set(answerable.labels)) == 3 and p.ball_colour in answerable.labels
    sides = questions.left_or_right("To which side?", forms=["{1} bin"], colours=lambda p: ("red", "blue"))
    assert sides.fill(p, np.random.default_rng(0)).aliases == {"red bin": "left", "blue bin": "right"}
    count = questions.how_many("How many, {choices}?", ranges=lambda p: [(0, 1), (2, 2)])
    filled = count.fill(p, np.random.default_rng(0))
    assert (filled.labels, filled.fills) == (("0-1", "2-2"), {"choices": "0-1 or 2-2"})
    assert filled.aliases["0 or 1"] == filled.aliases["one"] == "0-1" != filled.aliases["2"]
    assert [questions.range_of([(0, 1), (2, 2)], n) for n in (1, 2, 3)] == ["0-1", "2-2", None]


def test_what_rests_beyond_a_mark_is_seen_there() -> None:
    frames, see = moving("red", (40, 140, 340, 340, 340)), observers.beyond("ball", "line")
    named = {"ball": "red", "line": "blue"}
    assert (see(frames, named), see(frames[:2], named), see(frames[[0, 1, 1, 1]], named)) == ("yes", None, "no")
    assert see(frames, named | {"line": "purple"}) is None


def moving(colour: str, xs: tuple[int, ...], ys: tuple[int, ...] | None = None) -> np.ndarray:
    """Frames of a square that moves towards a blue mark at 250 px, 150 px high."""
    frames = np.full((len(xs), 360, 480, 3), 200, np.uint8)
    frames[:, 150:170, 240:260] = np.array(COLOURS["blue"]) * 255
    for frame, x, y in zip(frames, xs, ys or (150,) * len(xs), strict=True):
        frame[y : y + 20, x : x + 20] = np.array(COLOURS[colour]) * 255
    return frames


def test_what_moves_is_carried_on_as_it_moved_last() -> None:
    named = {"ball": "red", "line": "blue"}
    foresee = observers.beyond("ball", "line", ahead=1.5)
    assert foresee(moving("red", (40, 110, 180)), named) == "yes"  # 180 + 1.5 * 70 px
    assert foresee(moving("red", (40, 170, 180)), named) == "no"
    lost = moving("red", (40, 110, 180, 200))
    lost[3, 150:170, 200:220] = 200  # behind something: where it was last is where it goes on from
    path = [observers.compact_blob(frame, "red") for frame in lost]
    end = observers.extrapolate(path, 1.0)
    assert path[-1] is None and end is not None and abs(end.x - (189.5 + 2 * 70)) < 1
    assert observers.extrapolate([*path, None, None], 1.0) is None  # for too long
    assert observers.end_of(path) is None  # it does not rest


def test_what_flies_over_a_mark_clears_it_and_what_flies_lower_does_not() -> None:
    named, foresee = {"ball": "red", "wall": "blue"}, observers.will_clear("ball", "wall")
    assert foresee(moving("red", (100, 160, 210), (60, 70, 90)), named) == "yes"
    assert foresee(moving("red", (100, 160, 210), (140, 145, 150)), named) == "no"
    assert foresee(moving("red", (100, 210, 160), (60, 70, 90)), named) == "no"  # it comes back


def test_what_was_struck_has_begun_and_what_nothing_moves_at_has_not() -> None:
    named, foresee = {"last": "blue"}, observers.has_begun("last", reach=0.25)
    assert foresee(moving("red", (40, 110, 180)), named) == "no"
    assert foresee(moving("red", (40, 150, 220)), named) == "yes"  # it is upon it
    pushed = moving("red", (40, 110, 180))
    pushed[2] = np.roll(pushed[2], 6, axis=1)
    assert foresee(pushed, named) == "yes"


def test_an_observer_sees_no_flag_and_sees_what_is_no_flag() -> None:
    frames = np.full((3, 360, 480, 3), 200, np.uint8)
    frames[:, 100:160, 60:63] = 45  # a mast, and a red flag at its upper end, to the right
    frames[:, 100:118, 63:90] = (220, 25, 30)
    frames[:, 200:230, 300:330] = (220, 25, 30)  # a red block
    seen = vision.without_flags(frames)
    red = [blob.box for blob in vision.blobs(vision.colour_mask(seen[-1], "red"))]
    assert red == [(300, 200, 30, 30)]
    assert len(vision.blobs(vision.colour_mask(frames[-1], "red"))) == 2
    bare = frames.copy()
    bare[:, 100:160, 60:63] = 200  # without its mast it is a thing
    assert np.array_equal(vision.without_flags(bare), bare)
