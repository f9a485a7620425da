"""States at chosen positions equal the library's own, in every family."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from tests.build.errors import raises
from tests.local_models import FAMILIES, QUESTIONS, SYSTEM, Family, ask, model
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.mechanism.hidden_states import Item, item_states
from traps_pipeline.models.local.adapter import LocalModel, Prompt
from traps_pipeline.models.local.spans import changed_tokens, token_spans

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
@pytest.mark.parametrize("shown", ["two images", "image and video"])
def test_visual_tokens_are_those_of_the_processors_placeholders_and_no_others(family: Family, shown: str) -> None:
    of = model(family)
    prompt = still(of, 40, 200) if shown == "two images" else both(of)
    ids = prompt.inputs["input_ids"][0]
    places = {kind: ids == getattr(of.processor, f"{kind}_token_id") for kind in ("image", "video")}
    assert {kind for kind, found in places.items() if found.any()} == {kind for kind in places if kind in shown}
    found = token_spans(of, prompt, SYSTEM, QUESTIONS[1])
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
    parts, own = token_spans(of, prompt, SYSTEM, QUESTIONS[1]), library(of, prompt)
    for part in ("visual", "question"):
        found = item_states(of, item(prompt), prompt, part).raw[2]  # pyright: ignore[reportArgumentType]
        assert found == pytest.approx(own[torch.from_numpy(parts[part])].mean(dim=0).numpy(), abs=1e-5)
    if family == "llava-next-video":
        with raises(TrapsError, "mechanism.hidden_states._pooled_tokens", "a:b:control", "stamps"):
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


def changed_item(one: Prompt, other: Prompt) -> Item:
    about = {"system": SYSTEM, "question": QUESTIONS[1]}
    return Item("a:b:void", "void", about, lambda: one, lambda: other)


def with_occluder(of: LocalModel) -> tuple[Prompt, Prompt]:
    """Prompts about four frames of 32 x 64 pixels, and about the same with a black occluder over the right half of the
    last two."""
    frames = np.random.default_rng(0).integers(90, 255, (4, 32, 64, 3)).astype(np.uint8)
    covered = frames.copy()
    covered[2:, :, 32:] = 0
    one, other = (of.prompt(SYSTEM, QUESTIONS[1], shown, [0.0, 0.5, 1.0, 1.5]) for shown in (frames, covered))
    return one, other


def test_states_at_occluder_tokens_are_means_over_the_visual_tokens_that_the_occluder_covers() -> None:
    """A token is 32 x 32 pixels of two frames, hence four: left and right, early and late. The occluder is one."""
    of = model("qwen3-vl")
    one, other = with_occluder(of)
    mask = token_spans(of, one, SYSTEM, QUESTIONS[1])["visual"]
    visual, differs = np.flatnonzero(mask), changed_tokens(one, other, mask)
    assert one.inputs["video_grid_thw"].tolist() == [[2, 2, 4]] and len(visual) == 4
    assert differs is not None and np.flatnonzero(differs).tolist() == [visual[3]]
    for prompt, its_other in ((one, other), (other, one)):
        asked, own = changed_item(prompt, its_other), library(of, prompt)
        for pooling, tokens in (("changed", visual[3:]), ("unchanged", visual[:3])):
            found = item_states(of, asked, prompt, pooling).raw[2]  # pyright: ignore[reportArgumentType]
            assert found == pytest.approx(own[torch.from_numpy(tokens)].mean(dim=0).numpy(), abs=1e-5)


def test_states_at_occluder_tokens_are_refused_where_nothing_differs_or_nothing_can_be_compared() -> None:
    of = model("qwen3-vl")
    one, other = with_occluder(of)
    with raises(TrapsError, "mechanism.hidden_states._pooled_tokens", "a:b:void", of.checkpoint.name, "changed"):
        item_states(of, changed_item(one, one), one, "changed")
    same = item_states(of, changed_item(one, one), one, "unchanged").raw
    assert (same == item_states(of, item(one), one, "visual").raw).all()
    for wrong in (item(one), changed_item(one, ask(of, QUESTIONS[1]))):
        with raises(TrapsError, "mechanism.hidden_states._pair_masks", wrong.item_id):
            item_states(of, wrong, one, "changed")
    llava = model("llava-next-video")
    one, other = with_occluder(llava)
    with raises(TrapsError, "mechanism.hidden_states._pair_masks", "a:b:void"):
        item_states(llava, changed_item(one, other), one, "changed")
