"""Settings of a draw make scenes harder by what can be measured of them; the usual settings draw what was drawn."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.build.errors import raises
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.base.paths import RELEASED
from traps_pipeline.benchmark.composition import sample_benchmark
from traps_pipeline.benchmark.records import load_released
from traps_pipeline.cli import build_parser, main
from traps_pipeline.cli.benchmark_commands import MAX_DISTRACTORS as SAID_DISTRACTORS
from traps_pipeline.cli.benchmark_commands import SPEEDS as SAID_SPEEDS
from traps_pipeline.release.commitment import broken_seals, commit, read_reveal, redraw_records
from traps_pipeline.scenes.certification.certify_record import certify
from traps_pipeline.scenes.draw.resolve import json_values
from traps_pipeline.scenes.draw.sample import Draw, DrawnScene, load_tallies, scene_of_draw
from traps_pipeline.scenes.family_registry import families, get_family
from traps_pipeline.scenes.parts.difficulty import (
    DISTRACTOR,
    MAX_DISTRACTORS,
    MAX_SPEEDS,
    SPEEDS,
    Difficulty,
    SceneDifficulty,
    unsupported_settings,
)
from traps_pipeline.scenes.parts.look import look_of_draw
from traps_pipeline.scenes.physics.kit import LOOK_ALIKE, params_to_dict
from traps_pipeline.scenes.picture.camera import fit_shot, is_in_frame
from traps_pipeline.scenes.worlds.outcome import Rejected, compile_scene, decisive_geoms, simulated
from traps_pipeline.scenes.worlds.shot import shown_points
from traps_pipeline.scenes.worlds.spec import load_trajectory, physics_record
from traps_pipeline.scenes.worlds.world import World

HARD = Difficulty(distractors=3, speed=2.0, longer=True)


def first_drawn(family: str, difficulty: Difficulty) -> tuple[int, DrawnScene]:
    """The first draw of seed 1 that comes to an outcome in time."""
    for number in range(40):
        try:
            return number, scene_of_draw(Draw(family, 1, number, frozenset(), (), difficulty))
        except Rejected:
            continue
    raise AssertionError(f"no draw of {family} comes to an outcome")


def world_of(family: str, drawn: DrawnScene) -> World:
    model, scene = compile_scene(get_family(family), drawn.params, drawn.physics)
    qpos = simulated(model, scene, drawn.physics)
    camera, occluder = fit_shot(scene.view, shown_points(model, scene, qpos), scene.cover)
    return World(get_family(family), drawn.params, drawn.physics, qpos, camera, occluder)


def test_the_usual_settings_draw_the_frozen_records() -> None:
    tallies, seen = load_tallies(RELEASED), set[str]()
    for spec in load_released().values():
        if spec.taxonomy == "chaotic" and spec.family in seen:
            continue  # one of each is enough: there are 500
        seen.add(spec.family)
        family, tally = get_family(spec.family), tallies[spec.family]
        rng = np.random.default_rng([tally.seed, *spec.family.encode(), spec.seed])
        params = family.draw(rng)
        wording = family.word(params, rng)
        params = replace(params, look=look_of_draw(tally.seed, spec.family, spec.seed, tally.look))
        assert json_values(params_to_dict(params)) == spec.params, spec.scenario_id
        assert (wording.question, list(wording.labels)) == (spec.question, spec.labels)
        assert physics_record(family.physics) | {"duration_s": spec.physics["duration_s"]} == spec.physics
        assert tally.difficulty == Difficulty()
    assert seen == {spec.family for spec in load_released().values()}


def test_the_usual_settings_leave_no_trace_in_a_scene() -> None:
    drawn = scene_of_draw(Draw("head_on", 1, first_drawn("head_on", Difficulty())[0], frozenset()))
    assert "difficulty" not in params_to_dict(drawn.params) and "speed" not in physics_record(drawn.physics)
    spec = load_released()["head_on-0001"]
    drawn = scene_of_draw(Draw("head_on", 1, spec.seed, frozenset(), tuple(get_family("head_on").looks)))
    qpos = load_trajectory(RELEASED / "trajectories" / "head_on-0001.npz", spec.trajectory_sha256)
    assert np.array_equal(world_of("head_on", drawn).qpos[: len(qpos)], qpos)


def test_a_scene_at_twice_the_speed_shows_every_second_frame_of_the_usual_one() -> None:
    _, drawn = first_drawn("bounce", Difficulty(speed=2.0))
    assert physics_record(drawn.physics)["speed"] == 2.0
    usual = replace(drawn, physics=replace(drawn.physics, speed=1.0, duration_s=2 * drawn.physics.duration_s))
    fast, slow = world_of("bounce", drawn), world_of("bounce", usual)
    assert np.array_equal(fast.qpos, slow.qpos[::2])
    assert fast.outcome.commit_frame <= slow.outcome.commit_frame / 2 + 1


def test_distractors_look_like_what_is_named_move_and_hide_and_touch_nothing() -> None:
    number, drawn = first_drawn("head_on", Difficulty(distractors=3))
    bare = scene_of_draw(Draw("head_on", 1, number, frozenset()))
    world, without = world_of("head_on", drawn), world_of("head_on", bare)
    things = drawn.params.difficulty.distractors
    named = {colour for colour in drawn.params.colours if colour in drawn.wording.question}
    assert [thing.shape for thing in things] == ["puck", "ball", "puck"]
    assert {thing.colour for thing in things if thing.shape == "puck"} <= named
    (ball,) = (thing for thing in things if thing.shape == "ball")
    assert ball.colour not in drawn.wording.question and ball.colour not in without.inventory.colours
    assert any({ball.colour, colour} in LOOK_ALIKE for colour in named)
    assert {*world.inventory.colours} == {*without.inventory.colours, ball.colour}
    assert world.inventory.things == without.inventory.things
    for number in range(len(things)):  # a tenth of a second shows each of them moving, to the last frame
        steps = np.diff(world.motion.pos(f"{DISTRACTOR}{number}")[:, 0])
        assert np.abs(steps).min() > 0.005 and np.ptp(steps) < 1e-4
    assert is_in_frame(world.camera, shown_points(world.model, world.scene, world.qpos))
    for body in without.motion.positions:
        assert np.allclose(world.motion.pos(body), without.motion.pos(body), atol=1e-6)
    same_camera = replace(without, camera=world.camera)
    own = decisive_geoms(world.model, world.scene.decisive)
    at = [0, 20, len(world.qpos) - 1]
    with world.renderer(supersample=1) as renderer:
        seen = renderer.visible_pixels(world.qpos[at], own)
    with same_camera.renderer(supersample=1) as renderer:
        assert np.array_equal(seen, renderer.visible_pixels(same_camera.qpos[at], own))


@pytest.mark.parametrize(
    ("family", "longer_than"),
    [
        ("chain", {"row": 4}),
        ("domino_branch", {"branch": 4, "visible": 3}),
        ("domino_chain", {"concealed": 4, "visible": 4}),
        ("tower", {"blocks": 4}),
    ],
)
def test_longer_rows_are_longer_than_any_usual_one(family: str, longer_than: Mapping[str, int]) -> None:
    drawn = get_family(family).draw(np.random.default_rng(1), longer=True)
    for name, most in longer_than.items():
        assert getattr(drawn, name) > most >= getattr(get_family(family).draw(np.random.default_rng(1)), name)
    params = replace(drawn, difficulty=SceneDifficulty(longer=True))
    stored = json_values(params_to_dict(params))
    assert get_family(family).params_from(stored) == params
    with raises(ValueError, "scenes.parts.vary._check_member"):  # a usual record may not be so long
        get_family(family).params_from({**stored, "difficulty": None})


def test_longer_races_and_counts_offer_more() -> None:
    _, race = first_drawn("hidden_race", Difficulty(longer=True))
    assert len(race.params.colours) == len(race.wording.labels) == 4
    family = get_family("domino_count")
    count = family.draw(np.random.default_rng(1), longer=True)
    assert count.ranges[-1][1] == 9
    wording = family.word(count, np.random.default_rng(1))
    assert wording.aliases["nine"] == wording.labels[-1]


@pytest.mark.parametrize(
    "wrong",
    [
        {"longer": 1},
        {"distractors": [{}]},
        {"distractors": [{"shape": "cone"}]},
        {"distractors": [{"colour": "gold"}]},
        {"distractors": [{"radius_m": 3.0}]},
        {"distractors": [{"speed_m_s": float("nan")}]},
        {"fog": 1},
    ],
)
def test_a_difficulty_that_does_not_exist_is_refused(wrong: dict[str, Any]) -> None:
    _, drawn = first_drawn("bounce", Difficulty(distractors=1))
    stored = json_values(params_to_dict(drawn.params))
    assert get_family("bounce").params_from(stored) == drawn.params
    (thing,) = stored["difficulty"]["distractors"]
    changed = {
        name: [thing | each if each else {} for each in value] if name == "distractors" else value
        for name, value in wrong.items()
    }
    with raises(ValueError, "scenes.parts.difficulty.SceneDifficulty.from_record"):
        get_family("bounce").params_from(stored | {"difficulty": stored["difficulty"] | changed})


def test_families_that_cannot_be_drawn_like_this_are_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    sample = ["benchmark", "sample", "--seed", "1", "--count", "1", "--out", str(tmp_path / "out")]
    assert main([*sample, "--families", "plinko", "chain", "bounce", "--speed", "2", "--longer"]) == 1
    told = capsys.readouterr().err
    wanted = ["bounce", "--longer", "plinko", "--speed", "--longer", "--families", "chain", "domino_branch"]
    assert [word for word in re.findall(r"[a-z_-]+", told) if word in wanted or word[:2] == "--"] == wanted
    assert not (tmp_path / "out").exists()
    assert {*MAX_SPEEDS.values()} <= {*SPEEDS}
    assert {f.name for f in families() if not unsupported_settings(f, Difficulty(speed=1.5))} == {*MAX_SPEEDS}
    assert {f.name for f in families() if unsupported_settings(f, Difficulty(distractors=1))} == {
        f.name for f in families() if f.taxonomy == "chaotic" or f.category == "soft_bodies"
    }


@pytest.mark.parametrize("setting", [["--distractors", "4"], ["--distractors", "-1"], ["--speed", "3"]])
def test_a_setting_that_does_not_exist_is_bad_usage(setting: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert (SAID_DISTRACTORS, SAID_SPEEDS) == (MAX_DISTRACTORS, SPEEDS)
    with pytest.raises(SystemExit) as ended:
        build_parser().parse_args(["benchmark", "sample", "--seed", "1", "--out", "x", *setting])
    assert ended.value.code == 2
    assert f"argument {setting[0]}: " in capsys.readouterr().err


@pytest.mark.slow
@pytest.mark.parametrize(
    ("family", "difficulty"),
    [("hidden_race", Difficulty(distractors=3)), ("head_on", Difficulty(speed=2.0)), ("chain", HARD)],
)
def test_a_harder_benchmark_is_certified_and_committed_with_its_settings(
    family: str, difficulty: Difficulty, tmp_path: Path
) -> None:
    folder = tmp_path / "hard"
    sample_benchmark(folder, {family: 1}, 1, "hard", difficulty=difficulty, workers=1)
    (spec,) = load_released(folder / "released").values()
    load_released.cache_clear()
    path = folder / "released" / "trajectories" / f"{spec.scenario_id}.npz"
    qpos, twin = (
        load_trajectory(path, spec.trajectory_sha256),
        load_trajectory(path, spec.twin.trajectory_sha256, "twin"),
    )
    assert certify(spec, qpos, twin).failures == {}  # at the full rate, as `traps benchmark certify` does
    assert spec.physics.get("speed", 1.0) == difficulty.speed
    stored = spec.params.get("difficulty", {"distractors": [], "longer": False})
    assert (len(stored["distractors"]), stored["longer"]) == (difficulty.distractors, difficulty.longer)
    notes = json.loads((folder / "released" / "draws.json").read_text())
    assert notes[family]["difficulty"] == difficulty.settings()
    published = commit(folder, tmp_path / "public.json", tmp_path / "secret.json")
    assert published.difficulty == difficulty
    reveal = read_reveal(tmp_path / "secret.json")
    assert broken_seals(published, reveal, redraw_records(published, reveal, workers=1)) == []
    with raises(TrapsError, "scenes.draw.sample.require_difficulty", "plinko"):
        sample_benchmark(tmp_path / "other", {"plinko": 1}, 1, "other", difficulty=difficulty)
