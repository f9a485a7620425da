"""A clip of another shape is stretched to a model's size, or cropped; what is stretched is known as it was before."""

from __future__ import annotations

from typing import Literal

import numpy as np
import pytest
from pydantic import ValidationError

from tests.build.errors import raises
from traps_pipeline.models.framing import media_for_dataset
from traps_pipeline.storage.media import MediaSpec, pick, profile_digest, resize


def test_a_cropped_frame_keeps_its_shape_and_its_middle():
    # 4 x 2 onto 2 x 2: nothing is resized, and one column is lost on each side; stretching would mix the columns.
    frame = np.repeat(np.array([[10, 20, 30, 40]], np.uint8), 2, axis=0)[None, :, :, None].repeat(3, axis=3)
    assert resize(frame, (2, 2), "crop")[0, :, :, 0].tolist() == [[20, 30], [20, 30]]
    assert resize(frame, (2, 2))[0, 0, :, 0].tolist() == [15, 35]
    with raises(ValidationError, "MediaSpec"):
        MediaSpec(profile="frames", fps=2, fit="crop")


def test_frames_that_are_shown_later_are_the_next_ones_and_the_last_one_stays():
    times = np.arange(50) / 10
    spec = MediaSpec(profile="frames", fps=5)
    assert pick(times, spec).tolist() == list(range(0, 50, 2))
    assert pick(times, media_for_dataset(spec, "frames_later")).tolist() == list(range(1, 50, 2))
    ends = MediaSpec(profile="frames", uniform=2)
    assert [pick(times, each).tolist() for each in (ends, media_for_dataset(ends, "frames_later"))] == [
        [0, 49],
        [1, 49],
    ]
    assert profile_digest(spec) != profile_digest(media_for_dataset(spec, "frames_later"))


def test_a_wide_clip_is_shown_whole_in_its_own_shape_with_no_more_pixels_than_another():
    unsized = MediaSpec(profile="images", fps=5)
    assert media_for_dataset(unsized, "two_events") is unsized  # 640 x 360, as it is
    small = media_for_dataset(MediaSpec(profile="frames", uniform=8, size=(128, 96)), "two_events")
    assert small.size == (144, 80) and 144 * 80 <= 128 * 96
    square = media_for_dataset(MediaSpec(profile="frames", fps=2, size=(336, 336), fit="crop"), "two_events")
    assert (square.size, square.fit) == ((336, 336), "stretch")  # a crop would cut both lanes


@pytest.mark.parametrize("profile", ["video", "images", "frames"])
def test_a_rate_of_frames_takes_the_place_of_a_models_own(profile: Literal["video", "images", "frames"]):
    times = np.arange(50) / 10
    own = MediaSpec(profile=profile, fps=5, size=(336, 336), fit="crop")
    few, every = media_for_dataset(own, "frames_few"), media_for_dataset(own, "frames_all")
    assert len(pick(times, few)) == 10 and len(pick(times, every)) == 50
    assert (few.size, few.fit, every.profile) == ((336, 336), "crop", profile)
    assert MediaSpec.model_validate(few.model_dump()) == few  # what a variation makes, an entry could say
    cut = times[:18]
    assert pick(cut, every).tolist() == list(range(18)) and pick(cut, few).tolist() == [0, 5, 10, 15]
    assert media_for_dataset(own, "occlusion") is own
