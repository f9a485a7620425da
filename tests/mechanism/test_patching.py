"""Patching: a patch with itself changes nothing, all positions give the source's answer, deepstack features included;
the positions of a prompt's parts; and an independent re-implementation in plain transformers."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, cast

import numpy as np
import pytest
import torch

from tests.local_models import QUESTIONS, SYSTEM, Family, ask, clip, model
from traps_pipeline.errors import TrapsError
from traps_pipeline.mechanism.margin import abstention_tokens
from traps_pipeline.mechanism.patching import SITES, Patch, Recorded, Site, patched_changes, record, require_patchable
from traps_pipeline.models.local.adapter import LocalModel, Prompt, load_local_model
from traps_pipeline.models.local.clips import ClipMemory
from traps_pipeline.models.local.spans import PARTS, spans
from traps_pipeline.models.registry import get_model
from traps_pipeline.storage.media import MediaSpec, sample

pytestmark = pytest.mark.slow
POCKET = "pocket"  # the shipped weights, whose states mean something, beside tiny random ones
PATCHABLE = ("qwen3-vl", "llava-next-video", POCKET)


def subject(name: str) -> LocalModel:
    """The pocket model, or the tiny random one of a family."""
    return load_local_model(get_model(POCKET), inside=True) if name == POCKET else model(cast(Family, name))


def other(prompt: Prompt, seed: int = 0) -> Prompt:
    """The prompt with other pixels and another question of the same length."""
    generator = torch.Generator().manual_seed(seed)
    inputs = dict(prompt.inputs)
    for name, value in inputs.items():
        if value.is_floating_point():
            inputs[name] = value + torch.randn(value.shape, generator=generator)
    ids = inputs["input_ids"].clone()
    ids[0, -12:-9] = ids[0, -12:-9].flip(0)  # of the question, in all families
    return Prompt(prompt.text, inputs | {"input_ids": ids})


def pair(name: str) -> tuple[LocalModel, Recorded, Recorded, list[int], Prompt, Prompt]:
    of = subject(name)
    if name == POCKET:
        shown = sample(clip(), cast(MediaSpec, get_model(POCKET).media))
        target = of.prompt(SYSTEM, QUESTIONS[0], shown.frames, shown.times_s.tolist())
    else:
        target = ask(of)
    source, tokens = other(target), abstention_tokens(of)
    return of, record(of, target, tokens), record(of, source, tokens), tokens, target, source


@pytest.mark.parametrize("name", PATCHABLE)
def test_all_positions_give_the_source_and_a_patch_with_itself_nothing(name: str) -> None:
    of, target, source, tokens, *_ = pair(name)
    whole = np.ones(target.length, bool)
    assert abs(source.margin - target.margin) > 1e-3
    everywhere = [Patch("residual", layer, whole) for layer in range(of.n_layers + 1)]
    effects = patched_changes(of, target, source, everywhere, tokens) / (source.margin - target.margin)
    assert np.abs(effects - 1).max() < 1e-4
    every_site = [Patch(s, layer, whole) for s in SITES for layer in range(1, of.n_layers + 1)]
    assert (patched_changes(of, target, target, [*everywhere, *every_site], tokens) == 0).all()
    assert (patched_changes(of, target, source, [Patch("residual", 2, ~whole)], tokens) == 0).all()


def test_without_the_deepstack_features_all_positions_do_not_give_the_source() -> None:
    """With the target's own features behind the site, the effect is not 1. The features of a random model are small, so
    they are made larger here."""
    mergers = model("qwen3-vl").network.model.visual.deepstack_merger_list
    with torch.no_grad():
        for merger in mergers:
            merger.linear_fc2.weight.mul_(100)
    model("qwen3-vl").clips = ClipMemory()  # what is remembered is of other weights
    try:
        of, target, source, tokens, *_ = pair("qwen3-vl")
        own = {"deepstack_visual_embeds": target.inputs["deepstack_visual_embeds"]}
        naive = Recorded({**source.inputs, **own}, source.states, source.margin)
        whole = [Patch("residual", layer, np.ones(target.length, bool)) for layer in range(of.n_layers + 1)]
        gap = source.margin - target.margin
        assert np.abs(patched_changes(of, target, source, whole, tokens) / gap - 1).max() < 1e-4
        assert np.abs(patched_changes(of, target, naive, whole[:2], tokens) / gap - 1).max() > 1e-2
    finally:
        with torch.no_grad():
            for merger in mergers:
                merger.linear_fc2.weight.div_(100)
        model("qwen3-vl").clips = ClipMemory()


@pytest.mark.parametrize("name", PATCHABLE)
def test_a_patch_is_what_a_plain_hook_on_the_whole_model_does(name: str) -> None:
    """Independent: the library's own forward pass from pixels to logits, one hook, one prompt at a time."""
    of, target, source, tokens, prompt, donor = pair(name)
    chosen = torch.zeros(target.length, dtype=torch.bool)
    chosen[-9:-2] = True  # text behind the clip, so that no deepstack feature is concerned
    hooked: tuple[tuple[Site, int, Callable[[Any], Any]], ...] = (
        ("residual", 3, lambda block: block), ("attention", 2, lambda block: block.self_attn),
        ("mlp", 4, lambda block: block.mlp),
    )  # fmt: skip
    for site, layer, get in hooked:
        kept: list[torch.Tensor] = []
        module = get(of.network.get_decoder().layers[layer - 1])

        def first(output: object) -> torch.Tensor:
            return output[0] if isinstance(output, tuple) else output  # type: ignore[return-value]

        handle = module.register_forward_hook(lambda m, i, out, kept=kept: kept.append(first(out).clone()))
        with torch.no_grad():
            of.network(**donor.inputs)
        handle.remove()

        def swap(m: object, i: object, out: object, kept: list[torch.Tensor] = kept) -> object:
            states = first(out).clone()
            states[:, chosen] = kept[0][:, chosen]
            return (states, *out[1:]) if isinstance(out, tuple) else states

        handle = module.register_forward_hook(swap)
        with torch.no_grad():
            logits = of.network(**prompt.inputs).logits[0, -1].double()
        handle.remove()
        never = of.network.generation_config.suppress_tokens or []
        rest = [t for t in range(len(logits)) if t not in tokens and t not in never]
        expected = (torch.logsumexp(logits[tokens], 0) - torch.logsumexp(logits[rest], 0)).item()
        change = patched_changes(of, target, source, [Patch(site, layer, chosen.numpy())], tokens)[0]
        assert target.margin + change == pytest.approx(expected, abs=1e-5)


def test_models_that_read_more_than_the_residual_stream_are_refused() -> None:
    require_patchable(model("qwen3-vl"))
    with pytest.raises(TrapsError, match="later blocks reuse keys and values of earlier ones"):
        require_patchable(model("gemma-4"))


def test_prompts_of_another_form_are_refused() -> None:
    of, target, _, tokens, *_ = pair("qwen3-vl")
    longer = record(of, ask(of, QUESTIONS[1]), tokens)
    with pytest.raises(TrapsError, match="cannot be patched into one of"):
        patched_changes(of, target, longer, [], tokens)


@pytest.mark.parametrize("family", ["qwen3-vl", "gemma-4", "llava-next-video"])
def test_the_parts_of_a_prompt_are_where_their_texts_are(family: Family) -> None:
    of = model(family)
    prompt = ask(of, QUESTIONS[1])
    found = spans(of, prompt, SYSTEM, QUESTIONS[1])
    assert set(found) == {*PARTS} and np.stack([*found.values()]).sum(axis=0).max() == 1
    ids, decode = prompt.inputs["input_ids"][0], of.processor.tokenizer.decode

    def text(part: str) -> str:
        return "".join(decode(ids[found[part]]).split())

    assert text("system") == "".join(SYSTEM.split()) and text("question") == "".join(QUESTIONS[1].split())
    videos = ids == of.processor.tokenizer.convert_tokens_to_ids(of.processor.video_token)
    assert np.array_equal(found["visual"], videos.numpy()) and videos.any()
    assert not found["visual"][found["question"].argmax() :].any()
    stamps = {"qwen3-vl": 3, "gemma-4": 6, "llava-next-video": 0}[family]  # Qwen3-VL merges two of the six frames
    assert text("stamps").count("seconds" if family == "qwen3-vl" else ":") == stamps
    assert found["last"].nonzero()[0].tolist() == [len(ids) - 1]
