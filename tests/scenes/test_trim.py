"""An occluder covers what its twin needs and no more."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.scenes.released import load
from traps_pipeline.scenes.certification.certificates import TWIN_BEHIND_OCCLUDER, pair_of
from traps_pipeline.scenes.certification.evidence import Pair
from traps_pipeline.scenes.draw.trim import cut_to, must_hide
from traps_pipeline.scenes.picture.camera import HEIGHT, WIDTH, Camera, Occluder

DRAWN_ANEW = "hidden_race-0006"  # its occluder was cut for both worlds; those of older records for the control alone
# From 2 m away, half a metre up, along y; 180 pixels are a metre where an occluder stands 1 m away.
CAMERA = Camera((0.0, 0.0, 0.5), 2.0, 90.0, 0.0, 90.0, 1.0, (0.0, 0.0, 0.5))
OCCLUDER = Occluder((0.0, -0.9, 0.6), (1.2, 0.1, 0.6), 0.0)  # its front is at y = -1


def pixels(rows: slice, columns: slice) -> np.ndarray:
    found = np.zeros((HEIGHT, WIDTH), bool)
    found[rows, columns] = True
    return found


def pair(scenario_id: str) -> Pair:
    case = load(scenario_id)
    return pair_of(case.spec.model_copy(update={"control": None}), case.qpos, case.twin)


def test_an_occluder_is_cut_to_the_pixels_that_it_must_hide_and_stands_on_the_floor() -> None:
    # Columns 240 to 330 are the half metre to the right of the middle; row 144 is 0.2 m above the eye.
    cut = cut_to(OCCLUDER, CAMERA, pixels(slice(144, 200), slice(240, 330)), 0)
    assert cut.half == pytest.approx((0.25, 0.1, 0.35), abs=1e-6)
    assert cut.centre == pytest.approx((0.25, -0.9, 0.35), abs=1e-6)
    wider = cut_to(OCCLUDER, CAMERA, pixels(slice(144, 200), slice(240, 330)), 9)  # 0.05 m on each side
    assert wider.half == pytest.approx((0.3, 0.1, 0.375), abs=1e-6)


def test_an_occluder_is_never_larger_than_it_was() -> None:
    everything = pixels(slice(None), slice(None))
    assert cut_to(OCCLUDER, CAMERA, everything, 9) == OCCLUDER
    assert cut_to(OCCLUDER, CAMERA, ~everything, 3) == OCCLUDER


@pytest.mark.slow
def test_a_released_occluder_covers_what_its_pair_needs_and_a_smaller_one_shows_the_twin() -> None:
    released = pair(DRAWN_ANEW)
    occluder, needed = released.control.occluder, must_hide(released)
    assert occluder is not None
    assert cut_to(occluder, released.control.camera, needed, 3) == occluder
    less = cut_to(occluder, released.control.camera, needed, -6)
    control, twin = (replace(world, occluder=less) for world in (released.control, released.other_world))
    shown = replace(released, control=control, twin=twin)
    measured = TWIN_BEHIND_OCCLUDER.measured(shown)
    assert measured["twin_px"] > 0 and str(measured["twin_px"]) in str(
        TWIN_BEHIND_OCCLUDER.failure(measured, shown.claim)
    )
