"""Steered answers that are resumed at the steered block, and rows that leave a batch: no answer changes by either."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from tests.local_models import FAMILIES, Family, ask, direction, model, three_prompts
from traps_pipeline.mechanism.hook import Steering
from traps_pipeline.models.local.adapter import LocalModel, Sampling
from traps_pipeline.models.local.prefixes import PrefixMemory, resumed, without_pictures
from traps_pipeline.models.local.prompt_batches import collate

pytestmark = pytest.mark.slow

each_family = pytest.mark.parametrize("family", FAMILIES)
NEW_TOKENS = 10


@contextmanager
def ends(of: LocalModel, *tokens: int) -> Iterator[None]:
    """Inside, these tokens end an answer."""
    config = of.network.generation_config
    before, config.eos_token_id = config.eos_token_id, [*tokens]
    yield
    config.eos_token_id = before


@contextmanager
def widths(of: LocalModel) -> Iterator[list[tuple[int, int]]]:
    """Rows and tokens of every pass of the last block."""
    seen: list[tuple[int, int]] = []
    handle = of.blocks[-1].register_forward_hook(lambda _, __, output: seen.append(tuple(output.shape[:2])))
    yield seen
    handle.remove()


@each_family
@pytest.mark.parametrize("layer", [1, 3, -1])
def test_a_resumed_sheet_has_the_answers_of_the_plain_path(family: Family, layer: int) -> None:
    """Prompts of three lengths and two clips, each with three doses along two directions, in one batch."""
    of = model(family)
    layer = layer if layer > 0 else of.n_layers - 1  # in Gemma one of the blocks that read keys and values of others
    prompts = [*three_prompts(family), ask(of, frames=4)]
    of.prefixes = PrefixMemory()
    sheet = [(p, v, alpha) for p in prompts for v in (0, 1) for alpha in (-60.0, 0.0, 60.0)]
    vectors = np.stack([direction(of, v) for _, v, _ in sheet])
    hook = Steering(vectors, layer, tuple(alpha for *_, alpha in sheet))
    rows = [p for p, *_ in sheet]
    plain = [of.generate([p], NEW_TOKENS, steering=hook.rows([n]))[0] for n, p in enumerate(rows)]
    for _ in range(2):
        with of.resuming(), of.remembering_clips():
            made = of.generate(rows, NEW_TOKENS, steering=hook)
        assert [one.tokens for one in made] == [one.tokens for one in plain]
        assert [one.text for one in made] == [one.text for one in plain]
    assert len({one.tokens for one in plain}) > len(prompts)  # directions do change answers
    assert not any("forward" in vars(block) for block in of.blocks)
    assert of.prefixes.passes == len(prompts)


@pytest.mark.parametrize(
    ("family", "layer"), [(family, layer) for family in FAMILIES for layer in range(1, 7 if family == "gemma-4" else 5)]
)
def test_logits_of_a_resumed_pass_are_those_of_a_whole_one(family: Family, layer: int) -> None:
    of, prompts = model(family), [*three_prompts(family)]
    of.prefixes = PrefixMemory()
    hook = Steering(direction(of), layer, (40.0, -40.0, 7.0))

    def logits(inputs: Any) -> torch.Tensor:
        out = of.network.generate(
            **inputs, max_new_tokens=1, return_dict_in_generate=True, output_logits=True, use_cache=True
        )
        return out.logits[0]

    pad = of.network.generation_config.pad_token_id
    with torch.inference_mode(), hook.applied(of):
        whole = logits(collate(prompts, pad))
    found = of.prefixes.of(of, prompts, layer)
    assert found is not None
    few = without_pictures(of, prompts, layer)
    last = {"qwen3-vl": 2, "gemma-4": of.n_layers}.get(family, 0)  # the last layer behind which pictures enter
    assert ("pixel_values_videos" in few[0].inputs) == (layer <= last)
    with torch.inference_mode(), resumed(of, found, layer), hook.applied(of):
        part = logits(collate(few, pad))
    np.testing.assert_allclose(part.numpy(), whole.numpy(), rtol=0, atol=1e-4 * float(whole.abs().max()))


def test_a_prefix_of_gemma_has_all_keys_and_values_that_later_blocks_read() -> None:
    """Those of a whole prompt, of which the cache of its sliding blocks keeps the latest; and none of the upper blocks,
    which make none."""
    of = model("gemma-4")
    prompt, window = ask(of), of.network.config.get_text_config().sliding_window
    for layer, n_made, shared in ((1, 1, {}), (3, 3, {"sliding_attention": 2}), (4, 4, None), (6, 4, None)):
        found = PrefixMemory().of(of, [prompt], layer)
        assert found is not None and len(found[0].keys) == len(found[0].values) == n_made
        both = {"sliding_attention": 2, "full_attention": 3}
        assert found[0].shared == (both if shared is None else shared)
        assert {keys.shape[1] for keys in found[0].keys} == {prompt.n_tokens} and prompt.n_tokens > 2 * window


def test_what_is_not_handed_on_to_later_blocks_tells_in_the_answers(monkeypatch: pytest.MonkeyPatch) -> None:
    """Resumed behind the blocks that make them, Gemma's upper blocks find no keys and values but those handed on."""
    of, prompt = model("gemma-4"), ask(model("gemma-4"))
    hook = Steering(direction(of), 4, (40.0,))
    of.prefixes = PrefixMemory()
    plain = of.generate([prompt], NEW_TOKENS, steering=hook)
    found = PrefixMemory().of(of, [prompt], 4)
    assert found is not None
    lost = replace(found[0], shared={})
    with pytest.raises(KeyError), torch.inference_mode(), resumed(of, [lost], 4):
        of.network.base_model(**of.placed(prompt.inputs), use_cache=True)
    blind = replace(found[0], keys=tuple(0 * keys for keys in found[0].keys))
    for prefix, same in ((found[0], True), (blind, False)):
        monkeypatch.setattr(of.prefixes, "of", lambda *_, prefix=prefix: [prefix])
        with of.resuming():
            assert (of.generate([prompt], NEW_TOKENS, steering=hook)[0].tokens == plain[0].tokens) is same


def test_a_model_whose_blocks_read_more_than_is_known_runs_from_the_start(monkeypatch: pytest.MonkeyPatch) -> None:
    of, prompt = model("qwen3-vl"), ask(model("qwen3-vl"))
    monkeypatch.setattr(of.network.config.text_config, "num_kv_shared_layers", 1, raising=False)
    memory = PrefixMemory()
    assert memory.of(of, [prompt], 2) is None and memory.passes == 0


def test_the_oldest_prefixes_are_forgotten_and_known_by_their_inputs() -> None:
    of, prompts = model("qwen3-vl"), three_prompts("qwen3-vl")
    memory = PrefixMemory(most_bytes=1)
    for prompt in (prompts[0], prompts[0], prompts[1], prompts[0]):
        assert memory.of(of, [prompt], 2) is not None
    assert (memory.passes, memory.used) == (3, 1) and len(memory._kept) == 1
    assert memory.of(of, [ask(of)], 2) is not None and memory.used == 2  # a prompt made anew has the same inputs


@each_family
def test_rows_that_have_ended_leave_the_batch(family: Family) -> None:
    """Tokens that some rows write early end an answer: the passes get fewer rows, and no answer changes."""
    of, prompts = model(family), [*three_prompts(family), ask(of := model(family), frames=4)]
    free = of.generate(prompts, NEW_TOKENS)
    early = free[0].tokens[1]
    with ends(of, early):
        alone = [of.generate([prompt], NEW_TOKENS)[0] for prompt in prompts]
        with widths(of) as seen:
            together = of.generate(prompts, NEW_TOKENS)
        slow = of.generate(prompts, NEW_TOKENS, use_cache=False)
    assert [one.tokens for one in together] == [one.tokens for one in alone] == [one.tokens for one in slow]
    assert [one.finish_reason for one in together] == [one.finish_reason for one in alone]
    lengths = sorted(len(one.tokens) for one in alone)
    assert lengths[0] <= 2
    if 2 * sum(length < NEW_TOKENS for length in lengths) >= len(lengths) and lengths[-1] > lengths[1]:
        assert min(rows for rows, _ in seen) < len(prompts)


@each_family
def test_rows_that_go_on_keep_their_own_random_streams_and_directions(family: Family) -> None:
    of, prompts = model(family), [*three_prompts(family), ask(of := model(family), frames=4)]
    sampling = Sampling(1.5, 0.95, [3, 4, 5, 6])
    hook = Steering(np.stack([direction(of, n) for n in range(4)]), 2, (50.0, -50.0, 20.0, 5.0))
    free = of.generate(prompts, NEW_TOKENS, sampling, hook)
    with ends(of, free[0].tokens[0], free[1].tokens[1]), widths(of) as seen:
        together = of.generate(prompts, NEW_TOKENS, sampling, hook)
        alone = [
            of.generate([prompt], NEW_TOKENS, sampling.rows([n]), hook.rows([n]))[0] for n, prompt in enumerate(prompts)
        ]
    assert [one.tokens for one in together] == [one.tokens for one in alone]
    assert len({rows for rows, _ in seen}) > 1
