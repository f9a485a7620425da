"""What errors about families and their parts say to do lets the family be read, drawn or shown."""

from __future__ import annotations

import contextlib
import sys
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from tests.remedies.remedied import remedied
from tests.scenes.test_registry import Add, add
from tests.scenes.test_wording import SCENE
from traps_pipeline.scenes import families as package
from traps_pipeline.scenes import registry
from traps_pipeline.scenes.kit import Box, Physics, View
from traps_pipeline.scenes.parts import vary
from traps_pipeline.scenes.parts.stage import Stage
from traps_pipeline.scenes.wording import Inventory, draw_ill_posed

__all__ = ["add"]  # the fixture


def write(add: Add, name: str = "plank_post", **changes: tuple[str, str]) -> None:
    """A family's file with other text, read anew."""
    sys.modules.pop(f"{package.__name__}.{name}", None)
    add(name, **changes)


FOLLOWS = (
    "drawn_by(lambda rng, so_far: uniform(rng, 0.55, 0.59) + 0.04 * (so_far['post_in_way'] or rng.random() < 0.2))"
)


@pytest.mark.parametrize(
    ("wrong", "sentence"),
    [
        (
            {"family": ("FAMILY = ", "MINE = ")},
            "defines no FAMILY = scene_family(...); write it, or take the file away",
        ),
        (
            {"called": ('"plank_post"', '"plank"')},
            "defines a family named {}; give it the name of its file, {}, or rename the file",
        ),
        (
            {"category": ('"ramps_rolling"', '"planks"')},
            "unknown category {}; write one of the categories of {} families: {}",
        ),
        (
            {
                "seen": ("seen_m: float = between(0.55, 0.65)", f"seen_m: float = {FOLLOWS}"),
                "names": ("import apart,", "import drawn_by, apart,"),
                "kit": ("import Motion, Physics, Scene", "import Motion, Physics, Scene, uniform"),
            },
            "draw it from nothing but its own values, `hidden(...)`, and what is seen not from it",
        ),
    ],
)
def test_a_family_that_is_written_as_told_may_be_drawn(
    add: Add, wrong: dict[str, tuple[str, str]], sentence: str
) -> None:
    write(add, **wrong)
    family = remedied(lambda: registry.fit_to_sample("plank_post"), sentence, lambda: write(add))
    assert family.name == "plank_post"


def test_a_file_without_a_family_may_also_be_taken_away(add: Add, tmp_path: Path) -> None:
    write(add, family=("FAMILY = ", "MINE = "))

    def taken_away() -> None:
        (tmp_path / "plank_post.py").unlink()
        for cached in (registry.family_names, registry.families, registry.get_family):
            cached.cache_clear()

    found = remedied(registry.families, "write it, or take the file away", taken_away)
    assert "plank_post" not in {family.name for family in found}


@dataclass(frozen=True)
class Bare:
    speed: float


@dataclass(frozen=True)
class Ranged:
    speed: float = vary.between(1.0, 2.0)


def test_a_field_with_a_range_is_drawn() -> None:
    drawn = remedied(
        lambda: vary.drawn(Bare, np.random.default_rng(0)),
        "has no range; write it as `= between(low, high)`",
        again=lambda: vary.drawn(Ranged, np.random.default_rng(0)),
        error=TypeError,
    )
    assert 1.0 <= drawn.speed <= 2.0


def test_a_flag_stands_at_a_place_where_a_thing_has_two_ends() -> None:
    stage = Stage(Physics())
    stage.rod("rail", (0.0, 0.0, 0.1), (0.5, 0.0, 0.1), 0.01, "red")
    remedied(
        lambda: stage.mark("the rail", "rail"),
        "{} has two ends; give a place",
        again=lambda: stage.mark("the rail", (0.2, 0.0), "red"),
        error=AssertionError,
    )


def test_a_scene_with_more_things_has_another_question() -> None:
    more = replace(SCENE, things=(*SCENE.things, "wooden box"))

    def draw(inventory: Inventory) -> str:
        return draw_ill_posed("occlusion", inventory, np.random.default_rng(0), lambda said: "wooden box" in said)

    question = remedied(
        lambda: draw(SCENE),
        "every ill-posed question about this scene is taken; name more things in its inventory",
        again=lambda: draw(more),
        error=ValueError,
    )
    assert "wooden box" in question


@pytest.mark.slow  # opens a renderer
def test_the_next_renderer_is_opened_once_the_first_is_closed() -> None:
    from traps_pipeline.scenes.camera import fit_camera
    from traps_pipeline.scenes.render import Renderer

    stage = Stage(Physics())
    stage.block("wall", (0.2, 0.6), (0, 1), (0, 1), "red")
    model = stage.spec.compile()
    camera = fit_camera(View(70.0, -25.0, 40.0), Box((-0.5, -0.5, 0.0), (0.5, 0.5, 0.8)).corners())
    first = contextlib.ExitStack()
    first.enter_context(Renderer(model, camera))

    def draw() -> np.ndarray:
        with Renderer(model, camera) as renderer:
            return next(renderer.frames(np.zeros((1, 0))))

    shown = remedied(
        draw,
        "a Renderer is open in this process; close it before the next one",
        first.close,
        error=RuntimeError,
    )
    assert shown.shape == (360, 480, 3)
