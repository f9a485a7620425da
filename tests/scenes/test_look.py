"""A look is stored with a scene's parameters, changes what is seen and nothing that happens, and is certified."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from tests.build.errors import raises
from tests.scenes.released import load
from tools.redraw import redraw_looks, with_look
from traps_pipeline.base.paths import RELEASED
from traps_pipeline.benchmark.records import load_released
from traps_pipeline.cli.benchmark_commands import LOOKS
from traps_pipeline.scenes.certification.certify_record import certify
from traps_pipeline.scenes.draw.sample import load_tallies, record_line, save_tallies
from traps_pipeline.scenes.family_registry import get_family
from traps_pipeline.scenes.parts.look import MATERIALS, OCCLUDERS, PARTS, Look, frame_size, look_of_draw
from traps_pipeline.scenes.physics.kit import params_to_dict
from traps_pipeline.scenes.picture.render import Renderer
from traps_pipeline.scenes.worlds.outcome import compile_scene, simulated
from traps_pipeline.scenes.worlds.pace import IN_VIEW_S
from traps_pipeline.scenes.worlds.spec import SceneSpec
from traps_pipeline.scenes.worlds.world import World

EVERYTHING = Look(
    floor_pattern="checks",
    floor_tones=("chalk", "coal"),
    floor_repeat_m=0.8,
    light_turn_deg=10.0,
    light=(0.9, 1.0, 1.1),
    panel="maroon",
    bystanders=((0.3, 0.3, 0.1, 0.2),),
    bystander_tones=("moss",),
    orbit_deg=(5.0, -2.0),
)


def test_a_look_is_read_back_from_a_record_and_one_that_is_not_there_leaves_none() -> None:
    family, params = get_family("bounce"), replace(load("bounce-0001").params, look=None)
    plain = params_to_dict(params)
    assert "look" not in plain
    seen = replace(params, look=EVERYTHING)
    assert family.params_from(params_to_dict(seen)) == seen
    assert params_to_dict(seen) == plain | {"look": params_to_dict(seen)["look"]}


@pytest.mark.parametrize(
    "look", [{"floor_tones": ["chalk", "gold"]}, {"panel": "pink"}, {"material": "felt"}, {"size": "4k"}, {"fog": 1.0}]
)
def test_a_look_that_does_not_exist_is_refused_by_name(look: dict[str, object]) -> None:
    with raises(ValueError, "scenes.parts.look.Look.from_record"):
        get_family("bounce").params_from(load("bounce-0001").spec.params | {"look": look})


def test_a_draws_look_follows_from_its_number_and_varies_in_the_parts_that_are_named() -> None:
    assert LOOKS == PARTS
    assert look_of_draw(1, "bounce", 4, ()) is None
    everything = look_of_draw(1, "bounce", 4, PARTS)
    assert everything == look_of_draw(1, "bounce", 4, PARTS) != look_of_draw(1, "bounce", 5, PARTS)
    assert look_of_draw(1, "bounce", 4, ("panel",)) in [Look(panel=name) for name in OCCLUDERS]
    assert look_of_draw(1, "bounce", 4, ("material",)) in [Look(material=name) for name in MATERIALS]
    assert {look_of_draw(1, "bounce", number, ("size",)) for number in range(20)} == {Look(size="720p")}
    floor = look_of_draw(1, "bounce", 4, ("floor",))
    assert floor is not None and floor.floor_pattern is not None
    assert replace(floor, **{f: getattr(Look(), f) for f in vars(floor) if f.startswith("floor_")}) == Look()


def test_released_records_look_as_their_draws_say_and_differ() -> None:
    tallies = load_tallies(RELEASED)
    looks = list[Look]()
    for spec in load_released().values():
        family = get_family(spec.family)
        look = look_of_draw(tallies[spec.family].seed, spec.family, spec.seed, tallies[spec.family].look)
        assert look == family.params_from(spec.params).look, spec.scenario_id
        looks += [look] if look else []
    assert len(looks) == 702
    assert 0.45 < np.mean([bool(look.bystanders) for look in looks]) < 0.55
    assert len({look.panel for look in looks}) == len(OCCLUDERS)
    assert {look.material for look in looks} == {*MATERIALS}
    assert len({(look.light_turn_deg, look.light) for look in looks}) > 600
    assert len({(look.floor_pattern, look.floor_tones) for look in looks}) > 60


def test_a_look_changes_no_trajectory() -> None:
    case = load("bounce-0001")
    model, scene = compile_scene(case.family, replace(case.params, look=EVERYTHING), case.physics)
    assert np.array_equal(simulated(model, scene, case.physics), case.qpos)


def test_the_floor_the_light_and_the_occluder_are_seen() -> None:
    case = load("bounce-0001")
    world = World.of_record(case.spec, case.qpos)
    shown = {}
    for name, look in {"plain": None, "panel": Look(panel="maroon"), "floor": replace(EVERYTHING, panel=None)}.items():
        seen = replace(world, params=replace(case.params, look=look))
        with Renderer(seen.model, seen.camera) as renderer:
            (shown[name],) = renderer.frames(case.qpos[:1], occluder=True)
    red = {name: frame.astype(int) for name, frame in shown.items()}
    repainted = (red["panel"] != red["plain"]).any(axis=2)
    navy = (red["plain"][..., 2] - red["plain"][..., 0])[repainted]  # bluer than red before, redder than blue after
    maroon = (red["panel"][..., 0] - red["panel"][..., 2])[repainted]
    assert repainted.sum() > 1000
    assert (navy > 0).mean() > 0.95 and (maroon > 0).mean() > 0.95
    assert (red["floor"] != red["plain"]).any(axis=2).mean() > 0.3


def test_an_occluder_of_slats_or_tiles_has_thin_paler_lines_and_is_as_opaque() -> None:
    case = load("bounce-0001")
    assert case.occluder is not None
    shown = {}
    for material in MATERIALS:
        world = replace(
            World.of_record(case.spec, case.qpos), params=replace(case.params, look=Look(material=material))
        )
        with world.renderer() as renderer:
            (frame,) = renderer.frames(case.qpos[:1], occluder=True)
            assert renderer.visible_pixels(case.qpos[-1:], world.concealed_geoms, occluder=True).sum() == 0
        shown[material] = frame.astype(int).sum(axis=2)
    paler = {name: (frame > shown["plain"] + 20).sum() for name, frame in shown.items()}
    changed = (shown["tiles"] != shown["plain"]).any(axis=None) and (shown["tiles"] < shown["plain"] - 20).sum()
    on_occluder = (shown["plain"] < 200).sum()  # navy; the floor is pale
    assert changed == 0  # lines are paler, and nothing else is darker
    assert 0 == paler["plain"] < paler["slats"] < paler["tiles"] < 0.3 * on_occluder


@pytest.mark.slow
def test_a_frame_of_720_lines_shows_the_same_scene_twice_as_fine_and_counts_the_same_pixels() -> None:
    case = load("bounce-0001")
    world = World.of_record(case.spec, case.qpos)
    fine = replace(world, params=replace(case.params, look=replace(case.params.look, size="720p")))
    with world.renderer() as renderer:
        (coarse,) = renderer.frames(case.qpos[:1])
        pixels = renderer.visible_pixels(case.qpos[:1], ["ball"])[0, 0]
    for _ in range(2):  # the second renderer of the same model, too
        with fine.renderer() as renderer:
            (large,) = renderer.frames(case.qpos[:1])
            assert renderer.visible_pixels(case.qpos[:1], ["ball"])[0, 0] == pytest.approx(pixels, rel=0.03)
    assert large.shape == (720, 960, 3) and coarse.shape == (360, 480, 3)
    halved = large.reshape(360, 2, 480, 2, 3).mean(axis=(1, 3))
    assert abs(halved - coarse).mean() < 1.0  # levels of 255
    assert frame_size(params_to_dict(fine.params)) == (960, 720) and frame_size(case.spec.params) == (480, 360)
    assert case.family.observe is not None
    frames = np.stack([large, large])
    assert case.family.observe(frames, case.spec.question) == case.family.observe(
        np.stack([cv2.resize(large, (480, 360), interpolation=cv2.INTER_AREA)] * 2), case.spec.question
    )


def test_the_first_picture_that_a_renderer_draws_of_a_scene_with_textures_is_as_later_ones() -> None:
    case = load("behind_wall-0001")
    world = World.of_record(case.spec, case.qpos)
    with world.renderer() as renderer:
        first, other, again = renderer.frames([case.qpos[0], case.qpos[-1], case.qpos[0]])
    assert np.array_equal(first, again) and not np.array_equal(first, other)


@pytest.mark.slow
def test_a_record_without_its_look_is_given_the_look_of_its_draw(tmp_path: Path) -> None:
    (tmp_path / "trajectories").mkdir()
    shutil.copy(RELEASED / "trajectories" / "plinko-0001.npz", tmp_path / "trajectories")
    spec = load("plinko-0001").spec
    bare = spec.model_copy(update={"params": {k: v for k, v in spec.params.items() if k != "look"}})
    (tmp_path / "plinko.jsonl").write_text(record_line(bare), encoding="utf-8")
    save_tallies(tmp_path, {"plinko": replace(load_tallies(RELEASED)["plinko"], look=[])})
    assert redraw_looks(tmp_path, "plinko", workers=1) == {}
    assert SceneSpec.model_validate_json((tmp_path / "plinko.jsonl").read_text(encoding="utf-8")) == spec
    assert load_tallies(tmp_path)["plinko"].look == sorted(get_family("plinko").looks)


@pytest.mark.slow
def test_a_record_under_another_floor_has_the_same_worlds_and_is_certified() -> None:
    case = load("plinko-0001")
    seen = with_look(
        case.spec, replace(EVERYTHING, orbit_deg=(0.0, 0.0), bystanders=(), bystander_tones=()), case.qpos, case.twin
    )
    assert isinstance(seen, SceneSpec)
    assert seen.params == case.spec.params | {"look": seen.params["look"]}
    assert seen.scene_hash != case.spec.scene_hash and seen.trajectory_sha256 == case.spec.trajectory_sha256
    assert certify(seen, case.qpos, case.twin, frame_step=5).failures == {}
    red = replace(EVERYTHING, bystanders=((0.0, -1.6, 0.6, 0.7),), bystander_tones=("moss",))  # over the board
    assert str(with_look(case.spec, red, case.qpos, case.twin)).startswith("legible: ")


@pytest.mark.slow
def test_under_another_look_a_record_loses_every_certificate_that_it_does_not_pass() -> None:
    """Also those whose numbers would be the same: one record once took a light in which its occluder no longer hid
    all."""
    case = load("tumbling_dice-0005")
    assert case.spec.control is not None and isinstance(with_look(case.spec, None, case.qpos, case.twin), SceneSpec)
    soon = round(case.spec.evidence["commit_s"] * case.physics.fps) + 4
    early = case.spec.model_copy(update={"control": {**case.spec.control, "closes_frame": soon}})
    lost = str(with_look(early, None, case.qpos, case.twin))
    assert lost.startswith("closing: ") and f"{soon / case.physics.fps:.1f} s" in lost and f"{IN_VIEW_S} s" in lost
