"""Two events in one picture: each lane is as by itself, boards tell no side, and what is hidden is as its twin."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from functools import cache
from itertools import combinations

import numpy as np
import pytest

from traps_pipeline.benchmark.filmed_lanes import trajectories_of
from traps_pipeline.benchmark.lane_balance import auc, balance, lane_numbers, telling_numbers
from traps_pipeline.benchmark.records import two_events_lines
from traps_pipeline.protocol.datasets import OCCLUSION_CATEGORIES
from traps_pipeline.protocol.two_events import CLIPS, LANES
from traps_pipeline.scenes.certification.certify_lanes import certify_lane_record, certify_lanes, pixels_of
from traps_pipeline.scenes.draw.draw_lanes import (
    LEFT_OUT,
    DrawnLanes,
    difficulty_of,
    draw_timetable,
    draw_two_events,
    lane_families,
)
from traps_pipeline.scenes.family_registry import families
from traps_pipeline.scenes.parts.difficulty import Difficulty
from traps_pipeline.scenes.physics.kit import flag_of
from traps_pipeline.scenes.picture.render import Renderer
from traps_pipeline.scenes.worlds.lane_layout import fit_lanes
from traps_pipeline.scenes.worlds.lane_records import TwoEventsSpec
from traps_pipeline.scenes.worlds.lanes import TwoLanes
from traps_pipeline.scenes.worlds.outcome import Rejected
from traps_pipeline.scenes.worlds.spec import trajectory_digest
from traps_pipeline.scenes.worlds.timetable import Timetable


@cache
def drawn(family: str) -> TwoEventsSpec:
    *_, last = draw_two_events(family, 1, seed=7)
    assert isinstance(last, DrawnLanes)
    return last.spec


def worlds(spec: TwoEventsSpec) -> tuple[TwoLanes, list[TwoLanes]]:
    return spec.world(), [spec.world(twin_in=k) for k in range(2)]


# --- timetables -------------------------------------------------------------------------------------------------------


def test_a_board_moves_for_four_frames_before_and_after_it_stands():
    away = Timetable(((10, 20),)).away(30)
    assert away[10:20].tolist() == [0] * 10
    assert away[6:10].tolist() == [
        1,
        9 / 16,
        4 / 16,
        1 / 16,
    ]  # it falls: the way left is as the square of the time left
    assert away[20:24].tolist() == [1 / 16, 4 / 16, 9 / 16, 1]
    assert (away[:6] == 1).all() and (away[24:] == 1).all()


def test_a_board_that_stands_from_the_first_frame_did_not_come():
    away = Timetable(((0, 5), (25, 30))).away(30)
    assert (away[:5] == 0).all() and (away[25:] == 0).all()
    assert Timetable(((0, 5), (25, 30))).window(0, 30) == (8, 22)  # frames 5 to 7 and 22 to 24 show it on its way


def test_drawn_timetables_leave_a_second_that_shows_what_has_settled_and_begin_and_end_either_way():
    rng = np.random.default_rng(1)
    timetables = [draw_timetable(rng, settled, 50, 10) for settled in (5, 20, 36) for _ in range(60)]
    ends = Counter[tuple[bool, bool]]()
    for settled, timetable in zip(np.repeat((5, 20, 36), 60), timetables, strict=True):
        assert timetable is not None
        away = timetable.away(50)
        start, stop = timetable.window(int(settled), 50)
        assert start >= settled and stop - start >= 10 and (away[start:stop] == 1).all()
        assert (away == 0).any()
        ends[bool(away[0] == 0), bool(away[-1] == 0)] += 1
    assert len(ends) == 4 and min(ends.values()) > 10


def test_a_window_alone_shows_what_has_settled_and_is_short_only_where_a_draw_says_so():
    timetable = Timetable.of_window(30, 2, 50)
    assert np.flatnonzero(timetable.away(50) == 1).tolist() == [30, 31]
    assert timetable.shows(20, 50, 10, window_s=0.2) and not timetable.shows(31, 50, 10, window_s=0.2)
    assert not timetable.shows(20, 50, 10)


# --- doubles and flags ------------------------------------------------------------------------------------------------


def test_no_double_passes_through_another():
    for scenario_id in ("head_on-e001", "head_on-e007", "hidden_collision-e002", "domino_count-e001"):
        spec = two_events_lines()[scenario_id].spec
        for record, event in zip(spec.lanes, spec.world().events, strict=True):
            widths = [float(np.ptp(span[:, 0])) for span in event.doubles(record.lane.size).values()]
            paths = [np.array(path)[:, 0] for path in record.layout.paths]
            for (one, wide), (other, as_wide) in combinations(zip(paths, widths, strict=True), 2):
                assert (np.abs(one - other) > (wide + as_wide) / 2 - 0.001).all(), scenario_id


@pytest.mark.slow
@pytest.mark.parametrize("scenario_id", ["domino_chain-e007", "ramp_deflect-e007"])  # whose boards reach over the masts
def test_no_board_before_a_scene_hides_a_flag(scenario_id: str):
    spec = two_events_lines()[scenario_id].spec
    world = spec.world(trajectories_of(spec)["qpos"])
    for lane, event in zip(LANES, world.events, strict=True):
        flags = [f"{lane} {flag_of(mark)}" for mark in event.scene.marks]
        seen, hidden = (pixels_of(world, clip, flags, [0, 20]) for clip in ("neither", "both"))
        assert flags and hidden.max(axis=0).tolist() == seen.max(axis=0).tolist()


# --- worlds -----------------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("family", ["slide", "drop_split", "domino_chain", "balance"])
def test_each_lane_ends_as_by_itself_and_its_twin_is_hidden_by_the_same_clip(family: str):
    spec = drawn(family)
    world, twins = worlds(spec)
    assert trajectory_digest(world.qpos) == spec.trajectory_sha256
    for k, record in enumerate(spec.lanes):
        assert world.outcome(k).label == world.events[k].outcome.label == record.ground_truth
        assert twins[k].outcome(k).label == record.twin.ground_truth != record.ground_truth
        assert twins[k].outcome(1 - k).label == spec.lanes[1 - k].ground_truth
        assert trajectory_digest(twins[k].qpos) == record.twin.trajectory_sha256
    frames = [0, 24, 49]
    shown = {}
    for name, each in (("world", world), ("left", twins[0]), ("right", twins[1])):
        with Renderer(each.model, each.camera) as renderer:
            shown[name] = {clip: [*renderer.frames(each.clip(hidden)[frames])] for clip, hidden in CLIPS.items()}
    assert shown["world"]["both"][0].shape == (360, 640, 3)
    for clip in ("left", "both"):
        assert np.array_equal(shown["world"][clip], shown["left"][clip])
    for clip in ("right", "both"):
        assert np.array_equal(shown["world"][clip], shown["right"][clip])
    left, right = slice(None, 320), slice(320, None)
    assert np.array_equal(
        np.array(shown["world"]["left"])[:, :, right], np.array(shown["world"]["neither"])[:, :, right]
    )
    assert np.array_equal(
        np.array(shown["world"]["right"])[:, :, left], np.array(shown["world"]["neither"])[:, :, left]
    )


@pytest.mark.slow
def test_nothing_in_view_depends_on_which_of_its_worlds_a_lane_is_in():
    world, twins = worlds(drawn("slide"))
    pairs = [(world.events[k], twins[k].events[k]) for k in range(2)]
    camera, layouts = fit_lanes(world.lanes, pairs)
    exchanged_camera, exchanged_layouts = fit_lanes(world.lanes, [pair[::-1] for pair in pairs])
    assert exchanged_camera == camera == world.camera
    assert exchanged_layouts == layouts


@pytest.mark.slow
def test_a_board_beside_its_place_and_a_timetable_without_a_window_are_refused():
    world, twins = worlds(drawn("slide"))
    assert certify_lanes(world, twins)["settled_frames"]
    layout = world.layouts[0]
    scene, bench = layout.boards
    narrow = replace(layout, boards=(replace(scene, half=(0.05, *scene.half[1:])), bench))
    tampered = [replace(each, layouts=[narrow, world.layouts[1]]) for each in (world, *twins)]
    with pytest.raises(Rejected, match=r"twin's clip|does not hide"):
        certify_lanes(tampered[0], tampered[1:])
    always = [replace(world.lanes[0], timetable=Timetable(((0, 50),))), world.lanes[1]]
    with pytest.raises(Rejected, match="no window"):
        certify_lanes(replace(world, lanes=always), twins)


@pytest.mark.slow
def test_a_released_record_is_certified_from_its_trajectories_and_an_altered_one_is_not():
    spec = two_events_lines()["slide-e001"].spec
    worlds = trajectories_of(spec)
    verdict = certify_lane_record(spec, worlds)
    assert verdict.passed, verdict.failures
    lane = spec.lanes[0]
    exchanged = lane.model_copy(update={"ground_truth": lane.twin.ground_truth})
    altered = spec.model_copy(update={"lanes": (exchanged, spec.lanes[1])})
    assert "ground_truth" in certify_lane_record(altered, worlds).failures
    assert "lanes" in certify_lane_record(spec, worlds | {"left": worlds["qpos"]}).failures  # a twin that ends alike


@pytest.mark.slow
def test_a_level_is_drawn_in_both_lanes_and_in_their_twins_and_read_back_from_the_record():
    difficulty = Difficulty(distractors=2, speed=1.5)
    *_, last = draw_two_events("slide", 1, 7, difficulty)
    assert isinstance(last, DrawnLanes)
    record = last.spec.model_dump(mode="json")
    assert difficulty_of(record) == difficulty and difficulty_of(drawn("slide").model_dump(mode="json")) == Difficulty()
    world, twins = worlds(last.spec)
    names = {f"{lane} distractor_{n}" for lane in ("left", "right") for n in range(2)}
    for each in (world, *twins):
        assert names <= {each.model.body(i).name for i in range(each.model.nbody)}
        assert each.physics.speed == 1.5


@pytest.mark.slow
def test_the_hard_level_of_a_scenario_is_the_same_scene_that_shows_its_outcomes_for_a_shorter_time():
    *_, last = draw_two_events("slide", 1, 7, Difficulty(window_s=0.2))
    assert isinstance(last, DrawnLanes) and last.spec.evidence["least_px"]
    assert difficulty_of(last.spec.model_dump(mode="json")) == Difficulty(window_s=0.2)
    assert last.spec.trajectory_sha256 == drawn("slide").trajectory_sha256
    lanes = zip(last.spec.lanes, drawn("slide").lanes, last.spec.evidence["settled_frames"], strict=True)
    for hard, usual, settled in lanes:
        assert hard.layout == usual.layout and hard.params == usual.params
        opened = np.flatnonzero(hard.lane.timetable.away(50) == 1)
        assert len(opened) == 2 and opened[0] >= settled


# --- items ------------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_every_text_and_every_mixed_clip_is_as_often_to_be_answered_as_not():
    spec = TwoEventsSpec.model_validate_json(drawn("slide").model_dump_json())
    assert spec == drawn("slide")
    asked = [*spec.questions()]
    assert len(asked) == 8
    texts = Counter((each.text, each.answer is None) for each in asked)
    assert [*texts.values()] == [2] * 4
    mixed = Counter((each.item.clip, each.answer is None) for each in asked if each.item.clip in ("left", "right"))
    assert [*mixed.values()] == [1] * 4
    assert {each.answer for each in asked if each.item.clip == "neither"} == {r.ground_truth for r in spec.lanes}


@pytest.mark.slow
def test_both_sides_have_the_same_boards():
    table = balance(lane_numbers([drawn("slide"), drawn("drop_split")])).set_index("number")
    boards = table[table.index.str.startswith("boards")]
    assert len(boards) == 8 and (boards["seen"] == boards["hidden"]).all() and (boards["auc"] == 0.5).all()


def test_what_tells_the_sides_of_one_family_is_named_though_it_tells_nothing_over_all():
    few = lane_families()[::4]
    specs = [line.spec for line in two_events_lines().values() if line.family in {*few, "slide"}]
    assert telling_numbers(specs) == []

    def doubled(spec: TwoEventsSpec) -> TwoEventsSpec:
        parts = [part | {"hidden": part["seen"] | {"alike_px": [9e9] * 6}} for part in spec.evidence["in_view"]]
        return spec.model_copy(update={"evidence": spec.evidence | {"in_view": parts}})

    planted = [doubled(spec) if spec.family == "slide" else spec for spec in specs]
    found = telling_numbers(planted)
    assert len(found) == 6 and all("alike_px" in line and "of slide" in line and "AUC 1.00" in line for line in found)
    assert telling_numbers([spec for spec in planted if spec.family != "slide" or spec.scenario_id[-1] == "1"]) == []


def test_the_share_of_pairs_in_which_the_hidden_one_has_more_counts_ties_by_half():
    assert auc(np.array([1.0, 2.0]), np.array([2.0, 3.0])) == (1 + 1 + 0.5 + 1) / 4


def test_families_that_are_left_out_are_families():
    names = {family.name for family in families() if family.category in OCCLUSION_CATEGORIES}  # none of soft bodies
    assert {*LEFT_OUT} <= names and {*lane_families()} == names - {*LEFT_OUT}
