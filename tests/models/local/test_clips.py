"""Remembered clips: the vision tower sees each once, and nothing else changes."""

from __future__ import annotations

import pytest
import torch

from tests.local_models import FAMILIES, Family, ask, direction, model, three_prompts
from traps_pipeline.mechanism.hook import Steering
from traps_pipeline.models.local.prompt_batches import Prompt
from traps_pipeline.models.local.vision_cache import ClipMemory

pytestmark = pytest.mark.slow


def other_clip(prompt: Prompt) -> Prompt:
    """The prompt with another clip of the same form."""
    pixels = prompt.inputs["pixel_values_videos"]
    return Prompt(prompt.text, {**prompt.inputs, "pixel_values_videos": pixels.flip(0)})


@pytest.mark.parametrize("family", FAMILIES)
def test_states_and_steered_answers_are_the_same_with_remembered_clips(family: Family) -> None:
    of = model(family)
    prompts = [*three_prompts(family), ask(of, frames=4)]
    hook = Steering(direction(of), 2, (3.0, -3.0, 0.0, 5.0))
    plain = [of.forward_states(prompt).raw for prompt in prompts], of.generate(prompts, 6, steering=hook)
    memory = ClipMemory()
    for _ in range(2):
        with memory.remembering(of.network):
            states = [of.forward_states(prompt).raw for prompt in prompts]
            answers = of.generate(prompts, 6, steering=hook)
        assert all((own == known).all() for own, known in zip(states, plain[0], strict=True))
        assert [one.tokens for one in answers] == [one.tokens for one in plain[1]]
    assert "get_video_features" not in vars(of.network.base_model)  # the hook is gone
    assert memory.passes == 2 and memory.used == 2 * 8 - 2  # two clips, in 2 x (4 passes + a batch of 4)


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
        memory.most_bytes = 1  # room for one clip alone
        of.forward_states(ask(of, frames=4))
        of.forward_states(one)
    assert memory.passes == 4 and len(memory._kept) == 1
    assert not torch.equal(one.inputs["pixel_values_videos"], two.inputs["pixel_values_videos"])
