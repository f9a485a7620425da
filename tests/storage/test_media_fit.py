"""A clip of another shape is stretched to a model's size, or cropped; what is stretched is known as it was before."""

from __future__ import annotations

import numpy as np
import pytest
from pydantic import ValidationError

from traps_pipeline.digests import digest
from traps_pipeline.storage.media import MediaSpec, profile_digest, resized


def test_a_cropped_frame_keeps_its_shape_and_its_middle():
    # 4 x 2 onto 2 x 2: nothing is resized, and one column is lost on each side; stretching would mix the columns.
    frame = np.repeat(np.array([[10, 20, 30, 40]], np.uint8), 2, axis=0)[None, :, :, None].repeat(3, axis=3)
    assert resized(frame, (2, 2), "crop")[0, :, :, 0].tolist() == [[20, 30], [20, 30]]
    assert resized(frame, (2, 2))[0, 0, :, 0].tolist() == [15, 35]
    with pytest.raises(ValidationError, match="it goes with size"):
        MediaSpec(profile="frames", fps=2, fit="crop")


def test_a_profile_that_stretches_has_the_digest_that_it_had_before_clips_could_be_cropped():
    plain = MediaSpec(profile="frames", fps=2, most=32, size=(336, 336))
    assert profile_digest(plain) != profile_digest(plain.model_copy(update={"fit": "crop"}))
    made = {"revision": 1, "spec": plain.model_dump(mode="json", exclude={"fit"})}
    assert profile_digest(plain) == digest(made)
