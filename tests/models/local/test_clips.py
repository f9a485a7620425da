"""Remembered clips: the vision tower sees each once, and nothing else changes."""

from __future__ import annotations

import pytest
import torch

from tests.local_models import ask, model
from traps_pipeline.models.local.prompt_batches import Prompt
from traps_pipeline.models.local.vision_cache import ClipMemory

pytestmark = pytest.mark.slow


def other_clip(prompt: Prompt) -> Prompt:
    """The prompt with another clip of the same form."""
    pixels = prompt.inputs["pixel_values_videos"]
    return Prompt(prompt.text, {**prompt.inputs, "pixel_values_videos": pixels.flip(0)})


def test_a_clip_is_known_by_its_pixels_and_the_oldest_are_forgotten() -> None:
    of = model("qwen3-vl")
    prompt = ask(of)
    one, two = prompt, other_clip(prompt)
    own = of.forward_states(two).raw
    memory = ClipMemory()
    with memory.remembering(of.network):
        of.forward_states(one)
        assert (of.forward_states(two).raw == own).all()
        assert memory.passes == 2
        memory.features.most_bytes = 1  # room for one clip alone
        of.forward_states(ask(of, frames=4))
        of.forward_states(one)
    assert memory.passes == 4 and len(memory.features) == 1
    assert not torch.equal(one.inputs["pixel_values_videos"], two.inputs["pixel_values_videos"])
