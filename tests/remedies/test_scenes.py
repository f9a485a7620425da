"""What errors about families and their parts say to do lets the family be read, drawn or shown."""

from __future__ import annotations

import contextlib
import sys
from pathlib import Path

import numpy as np
import pytest

from tests.build.families import Add, add
from tests.remedies.remedied import remedied
from traps_pipeline.scenes import families as package
from traps_pipeline.scenes import family_registry as registry
from traps_pipeline.scenes.parts.course import Course
from traps_pipeline.scenes.physics.kit import Box, Physics, View

__all__ = ["add"]  # the fixture


def write(add: Add, name: str = "plank_post", **changes: tuple[str, str]) -> None:
    """A family's file with other text, read anew."""
    sys.modules.pop(f"{package.__name__}.{name}", None)
    add(name, **changes)


FOLLOWS = (
    "drawn_by(lambda rng, so_far: uniform(rng, 0.55, 0.59) + 0.04 * (so_far['post_in_way'] or rng.random() < 0.2))"
)


@pytest.mark.parametrize(
    ("wrong", "by"),
    [
        ({"family": ("FAMILY = ", "MINE = ")}, "scenes.family_registry.get_family"),
        ({"called": ('"plank_post"', '"plank"')}, "scenes.family_registry.get_family"),
        ({"category": ('"ramps_rolling"', '"planks"')}, "scenes.family_registry.get_family"),
        (
            {
                "seen": ("seen_m: float = between(0.55, 0.65)", f"seen_m: float = {FOLLOWS}"),
                "names": ("import apart,", "import drawn_by, apart,"),
                "kit": ("import Motion, Physics, Scene", "import Motion, Physics, Scene, uniform"),
            },
            "scenes.family_registry.fit_to_sample",
        ),
    ],
)
def test_a_family_that_is_written_as_told_may_be_drawn(add: Add, wrong: dict[str, tuple[str, str]], by: str) -> None:
    write(add, **wrong)
    family = remedied(lambda: registry.fit_to_sample("plank_post"), by, lambda: write(add))
    assert family.name == "plank_post"


def test_a_file_without_a_family_may_also_be_taken_away(add: Add, tmp_path: Path) -> None:
    write(add, family=("FAMILY = ", "MINE = "))

    def taken_away() -> None:
        (tmp_path / "plank_post.py").unlink()
        for cached in (registry.family_names, registry.families, registry.get_family):
            cached.cache_clear()

    found = remedied(registry.families, "scenes.family_registry.get_family", taken_away)
    assert "plank_post" not in {family.name for family in found}


@pytest.mark.slow  # opens a renderer
def test_the_next_renderer_is_opened_once_the_first_is_closed() -> None:
    from traps_pipeline.scenes.picture.camera import fit_camera
    from traps_pipeline.scenes.picture.render import Renderer

    course = Course(Physics())
    course.block("wall", (0.2, 0.6), (0, 1), (0, 1), "red")
    model = course.spec.compile()
    camera = fit_camera(View(70.0, -25.0, 40.0), Box((-0.5, -0.5, 0.0), (0.5, 0.5, 0.8)).corners())
    first = contextlib.ExitStack()
    first.enter_context(Renderer(model, camera))

    def draw() -> np.ndarray:
        with Renderer(model, camera) as renderer:
            return next(renderer.frames(np.zeros((1, 0))))

    shown = remedied(draw, "scenes.picture.render", first.close, error=RuntimeError)
    assert shown.shape == (360, 480, 3)
