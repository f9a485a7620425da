"""States at chosen positions equal the library's own, in every family."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import torch

from tests.local_models import FAMILIES, QUESTIONS, SYSTEM, Family, ask, model
from traps_pipeline.errors import TrapsError
from traps_pipeline.mechanism.hidden_states import Item, item_states
from traps_pipeline.models.local.adapter import LocalModel, Prompt
from traps_pipeline.models.local.spans import spans

pytestmark = pytest.mark.slow


def library(of: LocalModel, prompt: Prompt) -> torch.Tensor:
    """hidden_states of the library at the output of block 2, (T, d)."""
    with torch.no_grad():
        return of.network(**prompt.inputs, output_hidden_states=True).hidden_states[2][0]


def still(of: LocalModel, *images: int) -> Prompt:
    """A prompt about images of these brightnesses in the place of a clip, as the library's own processor makes it."""
    kind = of.processor
    text = ask(of, QUESTIONS[1]).text.replace(kind.video_token, "\n".join([kind.image_token] * len(images)))
    pictures = [np.full((112, 112, 3), shade, np.uint8) for shade in images]
    made = kind(text=[text], images=[pictures], return_tensors="pt", add_special_tokens=False)
    return Prompt(text, dict(made))


def both(of: LocalModel) -> Prompt:
    """A prompt about an image and then a clip."""
    kind = of.processor
    text = ask(of, QUESTIONS[1]).text.replace(kind.video_token, f"{kind.image_token}\n{kind.video_token}")
    picture, clip = np.full((112, 112, 3), 99, np.uint8), np.full((4, 112, 112, 3), 50, np.uint8)
    clock = {"total_num_frames": 4, "fps": 2.0, "frames_indices": [0, 1, 2, 3], "duration": 2.0}
    made = kind(
        text=[text], images=[[picture]], videos=[clip], video_metadata=[clock], do_sample_frames=False,
        return_tensors="pt", add_special_tokens=False,
    )  # fmt: skip
    made.pop("video_metadata", None)
    return Prompt(text, dict(made))


@pytest.mark.parametrize("family", FAMILIES)
@pytest.mark.parametrize("shown", ["video", "image", "two images", "image and video"])
def test_visual_tokens_are_those_of_the_processors_placeholders_and_no_others(family: Family, shown: str) -> None:
    of = model(family)
    made: dict[str, Callable[[], Prompt]] = {
        "video": lambda: ask(of, QUESTIONS[1]),
        "image": lambda: still(of, 40),
        "two images": lambda: still(of, 40, 200),
        "image and video": lambda: both(of),
    }
    prompt = made[shown]()
    ids = prompt.inputs["input_ids"][0]
    places = {kind: ids == getattr(of.processor, f"{kind}_token_id") for kind in ("image", "video")}
    assert {kind for kind, found in places.items() if found.any()} == {kind for kind in places if kind in shown}
    found = spans(of, prompt, SYSTEM, QUESTIONS[1])
    assert np.array_equal(found["visual"], (places["image"] | places["video"]).numpy())
    assert np.stack([*found.values()]).sum(axis=0).max() == 1
    text = "".join(of.processor.tokenizer.decode(ids[torch.from_numpy(found["question"])]).split())
    assert text == "".join(QUESTIONS[1].split())
    if "video" not in shown:
        assert not found["stamps"].any()
        with torch.no_grad():  # the library takes as many tokens for pictures, or refuses the prompt
            of.network(**prompt.inputs)


def item(prompt: Prompt) -> Item:
    return Item("a:b:control", "control", {"system": SYSTEM, "question": QUESTIONS[1]}, lambda: prompt)


@pytest.mark.parametrize("family", FAMILIES)
def test_states_are_means_over_the_part_that_the_pooling_names(family: Family) -> None:
    of = model(family)
    prompt = ask(of, QUESTIONS[1])
    parts, own = spans(of, prompt, SYSTEM, QUESTIONS[1]), library(of, prompt)
    for part in ("visual", "question"):
        found = item_states(of, item(prompt), prompt, part).raw[2]  # pyright: ignore[reportArgumentType]
        assert found == pytest.approx(own[torch.from_numpy(parts[part])].mean(dim=0).numpy(), abs=1e-5)
    if family == "llava-next-video":
        with pytest.raises(TrapsError, match="has no stamps; choose another pooling"):
            item_states(of, item(prompt), prompt, "stamps")


@pytest.mark.parametrize("family", FAMILIES)
def test_the_state_at_the_first_answer_token_is_that_of_the_prompt_with_the_models_own_token(family: Family) -> None:
    of = model(family)
    prompt = ask(of, QUESTIONS[1])
    token = of.generate([prompt], 1)[0].tokens[0]
    longer = {
        name: torch.cat([value, value.new_full((1, 1), {"input_ids": token, "attention_mask": 1}.get(name, 0))], dim=1)
        for name, value in prompt.inputs.items() if name in prompt.sequences
    }  # fmt: skip
    own = library(of, Prompt(prompt.text, {**prompt.inputs, **longer}))[-1].numpy()
    found = item_states(of, item(prompt), prompt, "answer").raw[2]
    assert found == pytest.approx(own, abs=1e-5)
    assert np.abs(found - of.forward_states(prompt).raw[2]).max() > 1e-3
