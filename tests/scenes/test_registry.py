"""What the registry refuses, and the family of docs/plank_post: drawn, certified, observed."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.build.errors import raises
from tests.conftest import ROOT
from tests.scenes.released import SIX, Released
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.base.plugins import plugins
from traps_pipeline.benchmark.composition import load_composition
from traps_pipeline.scenes import families as package
from traps_pipeline.scenes import family_registry as registry
from traps_pipeline.scenes.certification.certify_record import certify
from traps_pipeline.scenes.draw.resolve import Resolved
from traps_pipeline.scenes.draw.sample import Draw, sample_family, simulated_answer, try_draw
from traps_pipeline.scenes.observe import family_asking
from traps_pipeline.scenes.parts.independence import dependence
from traps_pipeline.scenes.parts.wording import draw_ill_posed
from traps_pipeline.scenes.physics.kit import Family

EXAMPLE = (ROOT / "docs" / "plank_post" / "plank_post.py").read_text()


Add = Callable[..., None]


def forget() -> None:
    for cached in (registry.family_names, registry.get_family, registry.families, registry.fit_to_sample):
        cached.cache_clear()
    family_asking.cache_clear()


@pytest.fixture
def add(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Add]:
    """Adds a family file beside the others for one test: the example, with some of its text replaced."""
    monkeypatch.setattr(package, "__path__", [*package.__path__, str(tmp_path)])
    added: list[str] = []

    def add(name: str, **changes: Sequence[str]) -> None:
        text = EXAMPLE.replace('"plank_post"', f'"{name}"')
        for old, new in changes.values():
            assert old in text
            text = text.replace(old, new)
        (tmp_path / f"{name}.py").write_text(text)
        added.append(name)
        forget()

    yield add
    monkeypatch.undo()
    for name in added:
        sys.modules.pop(f"{package.__name__}.{name}", None)
    forget()


# --- the example ----------------------------------------------------------------------------------------------------


def test_the_example_is_complete_and_no_part_of_the_benchmark(add: Add) -> None:
    assert len(EXAMPLE.splitlines()) <= 110
    assert "plank_post" not in load_composition()
    add("plank_post")
    family = registry.fit_to_sample("plank_post")
    answers = {simulated_answer(family, family.draw(np.random.default_rng(seed))) for seed in range(4)}
    assert answers == {"yes", "no"}


@pytest.mark.slow
def test_the_example_is_drawn_certified_rendered_and_observed(add: Add) -> None:
    add("plank_post")
    family = registry.fit_to_sample("plank_post")
    answers: dict[str, Resolved] = {}
    for number in range(12):
        found = try_draw(Draw("plank_post", 1, number, frozenset(answers)))
        if isinstance(found, Resolved):
            answers[found.spec.ground_truth] = found
        if len(answers) == 2:
            break
    assert set(answers) == {"yes", "no"}
    for answer, found in answers.items():  # the README's commands certify one at full length
        inventory = family.build(family.params_from(found.spec.params), family.physics).inventory
        ill_posed = draw_ill_posed("occlusion", inventory, np.random.default_rng(0))
        spec = found.spec.model_copy(update={"ill_posed_question": ill_posed})
        assert certify(spec, found.qpos, found.twin, frame_step=2).failures == {}
        shown = Released(spec, found.qpos, found.twin)
        assert family.observe is not None
        assert family.observe(shown.control_frames, spec.question) == answer
        assert family.observe(shown.void, spec.question) is None
        assert family_asking(spec.question) is family


# --- what is refused --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("old", "new", "told"),
    [
        ('"ramps_rolling"', '"planks"', "planks"),  # no category
        ('"ramps_rolling"', '"plinko"', "occlusion"),  # a category of the other taxonomy
        ('"plank_post"', '"plank"', "'plank'"),  # another name than its file's
        ("FAMILY = ", "MINE = ", "families/plank_post.py"),  # no family
    ],
)
def test_a_file_that_declares_no_family_of_its_name_and_taxonomy_is_named(
    add: Add, old: str, new: str, told: str
) -> None:
    add("plank_post", changed=(old, new))
    with raises(TrapsError, "scenes.family_registry.get_family", "plank_post.py", told):
        registry.get_family("plank_post")


@pytest.mark.parametrize("placeholder", ["{ball}", "{plank}"])  # a question is the same whatever fills it
def test_two_families_with_one_question_template_are_refused(
    add: Add, placeholder: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    add("plank_post")
    start = "Does the {ball} ball roll along"
    add("plank_post_2", question=(start, start.replace("{ball}", placeholder)), other=("Is the", "Is then the"))
    refusal = (TrapsError, "scenes.family_registry.families", "plank_post.py", "plank_post_2.py")
    with raises(*refusal):
        registry.families()
    with raises(*refusal):
        sample_family("plank_post_2", 1, 1, tmp_path / "released")
    assert not (tmp_path / "released").exists()


def test_a_hidden_element_that_follows_what_is_seen_is_refused_before_anything_is_drawn(
    add: Add, tmp_path: Path
) -> None:
    # Long planks have their post beside them, most of the time.
    drawn = (
        "drawn_by(lambda rng, so_far: uniform(rng, 0.55, 0.59) + 0.04 * (so_far['post_in_way'] or rng.random() < 0.2))"
    )
    add(
        "plank_post",
        seen=("seen_m: float = between(0.55, 0.65)", f"seen_m: float = {drawn}"),
        names=("import apart,", "import drawn_by, apart,"),
        kit=("import Motion, Physics, Scene", "import Motion, Physics, Scene, uniform"),
    )
    with raises(TrapsError, "scenes.family_registry.fit_to_sample", "post_in_way", "seen_m"):
        sample_family("plank_post", 1, 1, tmp_path / "released")
    assert not (tmp_path / "released").exists()


def test_what_is_kept_of_a_packages_family_is_kept_until_any_of_its_modules_changes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder, about = tmp_path / "birds", tmp_path / "birds-1.dist-info"
    folder.mkdir()
    about.mkdir()
    for name in ("__init__", "crow", "wings"):
        (folder / f"{name}.py").write_text("")
    (about / "METADATA").write_text("Name: birds\nVersion: 1\n")
    (about / "entry_points.txt").write_text("[traps.families]\ncrow = birds.crow\n")
    monkeypatch.syspath_prepend(tmp_path)
    plugins.cache_clear()
    before = registry.family_digest("crow")
    assert before in registry.added_digests()
    (folder / "wings.py").write_text("SPAN_M = 0.9")
    after = registry.family_digest("crow")
    assert after in registry.added_digests() and before not in registry.added_digests()
    monkeypatch.undo()
    plugins.cache_clear()


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=[pytest.mark.slow] * (name not in SIX))
        for name in registry.family_names()
        if registry.get_family(name).twins
    ],
)
def test_no_familys_hidden_element_goes_with_what_is_seen(name: str) -> None:
    assert registry.fit_to_sample(name).name == name


def spoilt(name: str, choose: Callable[[Any], bool], hidden: str) -> Family:
    """A family, seven in ten of whose draws are swapped for the twin where `choose(params)` says so."""
    family = registry.get_family(name)
    twins = family.twins
    assert twins is not None

    def draw(rng: np.random.Generator) -> Any:
        p = family.draw(rng)
        worlds = sorted([p, *twins(p)], key=lambda world: getattr(world, hidden))
        return worlds[0 if choose(p) else -1] if rng.random() < 0.7 else p

    return replace(family, draw=draw)


@pytest.mark.parametrize(
    ("name", "hidden"), [("drop_split", "offset_m"), ("hidden_race", "clear_lane"), ("tower", "barred")]
)
def test_a_spoilt_draw_is_found_out_however_a_family_makes_its_twins(name: str, hidden: str) -> None:
    assert dependence(spoilt(name, lambda p: p.azimuth_deg > 90, hidden)) is not None


def test_two_parameters_that_tell_only_together_are_found_out() -> None:
    told = spoilt("drop_split", lambda p: (p.azimuth_deg > 90) == (p.elevation_deg > -28), "offset_m")
    found = dependence(told)
    assert found is not None and "azimuth_deg" in found and "elevation_deg" in found


def test_what_is_hidden_may_be_uneven_as_long_as_it_follows_nothing() -> None:
    assert dependence(spoilt("drop_split", lambda p: True, "offset_m")) is None
