"""The observer is shown the lane that a question names, where no board is before its scene."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from bench.difficulty import tracked
from traps_pipeline.base.paths import TWO_EVENTS_RELEASED
from traps_pipeline.benchmark.filmed_lanes import trajectories_of
from traps_pipeline.benchmark.records import two_events_lines
from traps_pipeline.protocol.two_events import CLIPS
from traps_pipeline.scenes.observe import observe
from traps_pipeline.scenes.parts.lane_vision import scenes_of_lane
from traps_pipeline.scenes.parts.vision import largest
from traps_pipeline.scenes.parts.wording import lane_asked, lane_question
from traps_pipeline.scenes.physics.kit import COLOURS
from traps_pipeline.scenes.picture.render import Renderer
from traps_pipeline.scenes.worlds.lanes import BENCH_RGBA
from traps_pipeline.scenes.worlds.timetable import Timetable
from traps_pipeline.video.encode import encode

SCENE, BENCH = (slice(100, 150), slice(80, 240)), (slice(220, 270), slice(80, 240))  # rows, columns of a lane's boards


def painted(box: tuple[slice, slice], colour: tuple[float, ...], frame: np.ndarray) -> None:
    frame[box] = np.array(colour[:3]) * 255


def lane(strip: str, hidden: bool) -> np.ndarray:
    """Ten frames of a lane: a ball in the scene and one on the bench; the board that comes stands in the first two."""
    frames = np.full((10, 360, 320, 3), 200, np.uint8)
    for n, frame in enumerate(frames):
        painted((slice(330, 338), slice(60, 260)), COLOURS[strip], frame)
        painted((slice(270, 276), slice(90, 230)), BENCH_RGBA, frame)
        painted((slice(262, 270), slice(90, 230)), BENCH_RGBA, frame)
        painted((slice(130, 146), slice(100 + 5 * n, 116 + 5 * n)), COLOURS["green"], frame)
        painted((slice(240, 262), slice(150, 172)), COLOURS["green"], frame)
        for box, stands in ((SCENE, hidden or n < 2), (BENCH, not hidden or n < 2)):
            if stands:
                painted(box, COLOURS["navy"], frame)
    return frames


@pytest.mark.parametrize("left", [True, False])
def test_the_named_lane_is_shown_without_its_bench_where_its_board_is_away(left: bool):
    lanes = [lane("red", hidden=False), lane("blue", hidden=True)][:: 1 if left else -1]
    frames = np.concatenate(lanes, axis=2)
    scene, shown = scenes_of_lane(frames, "red")
    assert scene.shape == (10, 360, 480, 3)  # with two before which the board stands at first
    assert np.array_equal(shown, scene[2:])
    balls = [largest(frame, "green") for frame in scene]
    assert balls[:2] == [None, None] and all(ball is not None for ball in balls[2:])
    steps = np.diff([ball.x for ball in balls if ball is not None])
    assert steps == pytest.approx(5 * 480 / (1.08 * 200 + 8), rel=0.1)  # it is enlarged to the strip's length
    assert scenes_of_lane(frames, "blue") == []
    assert scenes_of_lane(frames, "yellow") == []


def test_a_question_about_a_lane_gives_its_strip_and_the_familys_question_back():
    question = "Does the red ball reach the blue box, yes or no?"
    assert lane_asked(lane_question("cyan", question)) == ("cyan", question)
    assert lane_asked(question) is None


@pytest.mark.slow
@pytest.mark.parametrize("scenario_id", ["slide-e001", "drop_split-e001", "tower-e001"])
def test_the_observer_answers_about_seen_lanes_and_abstains_about_hidden_ones(scenario_id: str, tmp_path: Path):
    spec = two_events_lines(TWO_EVENTS_RELEASED)[scenario_id].spec
    world = spec.world(trajectories_of(spec)["qpos"])
    with Renderer(world.model, world.camera) as renderer:
        for clip, hidden in CLIPS.items():
            encode([*renderer.frames(world.clip(hidden))], tmp_path / f"{clip}.mp4", world.physics.fps)
    read = {asked.item: observe(tmp_path / f"{asked.item.clip}.mp4", asked.text) for asked in spec.questions()}
    assert read == {asked.item: asked.answer for asked in spec.questions()}


@pytest.mark.slow
def test_a_tracker_reads_what_a_window_shows_it_and_what_it_was_told_at_first_where_no_frame_falls_into_it():
    spec = two_events_lines(TWO_EVENTS_RELEASED)["slide-e001"].spec
    world = spec.world(trajectories_of(spec)["qpos"])
    lane = next(k for k, record in enumerate(spec.lanes) if record.ground_truth == "yes")  # it begins elsewhere
    window = Timetable(((0, 41), (49, 50)))
    assert np.flatnonzero(window.away(50) == 1).tolist() == [44, 45]
    assert tracked(world, lane, window) == ("yes", "yes", "yes", "no")  # at 10, 5, 2 and 1 frames a second
    assert tracked(world, lane, Timetable(((0, 42), (49, 50)))) == ("yes", "no", "yes", "no")  # 45 alone
