"""Patching beside the three families: experts, spread models, attributions, and what is refused.

What a patch does at every site is held against plain hooks in `test_independent.py`."""

from __future__ import annotations

from copy import deepcopy
from dataclasses import replace
from pathlib import Path
from typing import cast

import numpy as np
import pytest
import torch
from accelerate.hooks import AlignDevicesHook, add_hook_to_module, remove_hook_from_module

from tests import local_models
from tests.build.errors import raises
from tests.local_models import QUESTIONS, SYSTEM, Family, ask, clip, model
from tools.tiny_checkpoints import build_tiny
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.mechanism.adapter_checks import CHECKS, Subject, brightening_clip
from traps_pipeline.mechanism.margin import abstention_tokens
from traps_pipeline.mechanism.patching_effects import (
    Patch,
    RecordedPass,
    _margins,
    attributed_changes,
    patched_changes,
    require_patchable,
    trace_pass,
)
from traps_pipeline.models.local.adapter import LocalModel, Prompt, load_local_model
from traps_pipeline.models.registry.entries import get_model
from traps_pipeline.storage.media import MediaSpec, pick_frames

pytestmark = pytest.mark.slow
POCKET = "pocket"  # the shipped weights, whose states mean something, beside tiny random ones
PATCHABLE = ("qwen3-vl", "gemma-4", "llava-next-video", POCKET)


def subject(name: str) -> LocalModel:
    """The pocket model, or the tiny random one of a family."""
    return load_local_model(get_model(POCKET), inside=True) if name == POCKET else model(cast(Family, name))


def other(prompt: Prompt, seed: int = 2) -> Prompt:
    """The prompt with other pixels and another question of the same length. The default seed is one at which the
    outcomes of all models are far apart."""
    generator = torch.Generator().manual_seed(seed)
    inputs = dict(prompt.inputs)
    for name, value in inputs.items():
        if value.is_floating_point():
            inputs[name] = value + torch.randn(value.shape, generator=generator)
    ids = inputs["input_ids"].clone()
    ids[0, -12:-9] = ids[0, -12:-9].flip(0)  # of the question, in all families
    return Prompt(prompt.text, inputs | {"input_ids": ids})


def pair(
    name: str, of: LocalModel | None = None
) -> tuple[LocalModel, RecordedPass, RecordedPass, list[int], Prompt, Prompt]:
    of = of or subject(name)
    if name == POCKET:
        shown = pick_frames(clip(), cast(MediaSpec, get_model(POCKET).media))
        target = of.prompt(SYSTEM, QUESTIONS[0], shown.frames, shown.times_s.tolist())
    else:
        target = ask(of)
    source, tokens = other(target), abstention_tokens(of)
    return of, trace_pass(of, target, tokens), trace_pass(of, source, tokens), tokens, target, source


def test_what_experts_make_beside_an_mlp_is_of_its_site(tmp_path: Path) -> None:
    """As in Gemma 4's large checkpoints, which have none of the side paths."""
    experts = {"enable_moe_block": True, "num_experts": 4, "top_k_experts": 2, "moe_intermediate_size": 32}
    none = {"num_kv_shared_layers": 0, "hidden_size_per_layer_input": 0}
    folder = build_tiny("gemma-4", tmp_path / "experts", text=experts | none)
    of = load_local_model(local_models.entry("gemma-4", folder))
    of, target, source, tokens, prompt, donor = pair("gemma-4", of)
    assert (target.per_layer, target.shared) == ((), {})
    whole, gap = np.ones(target.length, bool), source.margin - target.margin
    everywhere = [Patch("residual", layer, whole) for layer in range(of.n_layers + 1)]
    assert np.abs(patched_changes(of, target, source, everywhere, tokens) / gap - 1).max() < 1e-4
    block = of.blocks[1]
    kept: list[torch.Tensor] = []
    handle = block.post_feedforward_layernorm.register_forward_hook(lambda _, __, output: kept.append(output))
    of.forward(donor)
    handle.remove()
    handle = block.post_feedforward_layernorm.register_forward_hook(lambda *_: kept[0])
    margin = trace_pass(of, prompt, tokens).margin
    handle.remove()
    change = patched_changes(of, target, source, [Patch("mlp", 2, whole)], tokens)[0]
    assert abs(change) > 1e-3 and target.margin + change == pytest.approx(margin, abs=1e-5)


def test_a_pass_of_a_spread_model_begins_at_the_patched_block_and_leaves_its_hooks_of_devices() -> None:
    """accelerate replaces the `forward` of every block, which is replaced in turn by a pass that begins behind it."""
    of, target, source, tokens, *_ = pair("qwen3-vl")
    whole = [Patch("residual", layer, np.ones(target.length, bool)) for layer in (1, 3)]
    expected = patched_changes(of, target, source, whole, tokens)
    for block in of.blocks:
        add_hook_to_module(block, AlignDevicesHook(execution_device="cpu"))
    try:
        placed = [vars(block)["forward"] for block in of.blocks]
        assert patched_changes(of, target, source, whole, tokens) == pytest.approx(expected)
        assert [vars(block)["forward"] for block in of.blocks] == placed
    finally:
        for block in of.blocks:
            remove_hook_from_module(block)
            vars(block).pop("forward", None)
    assert patched_changes(of, target, source, whole, tokens) == pytest.approx(expected)


def test_margins_are_read_off_a_head_whose_weights_are_offloaded() -> None:
    of, target, _, tokens, prompt, _ = pair("qwen3-vl")
    head = deepcopy(of.network.lm_head)
    add_hook_to_module(head, AlignDevicesHook(execution_device="cpu", offload=True))
    assert head.weight.is_meta
    own_head, of.network.lm_head = of.network.lm_head, head  # what monkeypatch would not give back to a module
    try:
        assert trace_pass(of, prompt, tokens).margin == target.margin
    finally:
        of.network.lm_head = own_head


def test_an_attribution_is_the_gradient_of_the_outcome_along_the_difference_of_states() -> None:
    """Independent: the library's own pass, a block's output as a leaf, autograd; at positions of text behind the clip,
    so that no side path is concerned."""
    of, target, source, tokens, prompt, _ = pair("qwen3-vl")
    block, leaves = of.network.get_decoder().layers[1], list[torch.Tensor]()

    def as_leaf(_: object, __: object, output: torch.Tensor) -> torch.Tensor:
        leaves.append(output.detach().clone().requires_grad_())
        return leaves[0]

    handle = block.register_forward_hook(as_leaf)
    with torch.enable_grad():
        logits = of.network(**prompt.inputs, use_cache=False).logits[0, -1].double()
        handle.remove()
        never = of.network.generation_config.suppress_tokens or []
        rest = [t for t in range(len(logits)) if t not in tokens and t not in never]
        (torch.logsumexp(logits[tokens], 0) - torch.logsumexp(logits[rest], 0)).backward()
    slope = leaves[0].grad
    assert slope is not None
    expected = (slope[0] * (source.states["residual", 2] - target.states["residual", 2])).sum(dim=1).numpy()
    estimated = attributed_changes(of, target, source, tokens)["residual", 2]
    assert np.abs(expected[-9:-2]).max() > 1e-4
    assert estimated[-9:-2] == pytest.approx(expected[-9:-2], rel=1e-3, abs=1e-6)


@pytest.mark.parametrize("name", PATCHABLE)
def test_an_attribution_of_all_positions_is_what_a_small_step_towards_the_source_does(name: str) -> None:
    """Side paths included: deepstack features, shared keys and values, vectors of the token's own."""
    of, target, source, tokens, *_ = pair(name)
    share, nothing = 1e-2, torch.zeros(1, target.length)
    estimated = attributed_changes(of, target, source, tokens)
    for key in [("residual", layer) for layer in range(of.n_layers + 1)] + [("attention", 2), ("mlp", 1)]:
        with torch.inference_mode():
            ends = [_margins(of, target, source, {key: nothing + step}, 0, 1, tokens)[0] for step in (share, -share)]  # pyright: ignore[reportArgumentType]
        stepped = float(ends[0].double() - ends[1].double()) / (2 * share)
        assert estimated[key].sum() == pytest.approx(stepped, rel=0.05, abs=2e-3), key  # pyright: ignore[reportArgumentType]


@pytest.mark.parametrize("field", ["num_kv_shared_layers", "hidden_size_per_layer_input", "altup_num_inputs"])
def test_models_whose_blocks_read_more_than_is_known_are_refused(field: str, monkeypatch: pytest.MonkeyPatch) -> None:
    for family in local_models.FAMILIES:
        require_patchable(model(family))
    of = model("qwen3-vl")
    monkeypatch.setattr(of.network.config.text_config, field, 1, raising=False)
    with raises(TrapsError, "mechanism.patching_effects.require_patchable", field, of.checkpoint.name) as refused:
        require_patchable(of)
    (check,) = [check for check in CHECKS if check.name == "patching"]
    _, _, why = check.found(Subject(of, *brightening_clip())).partition(": ")
    assert why and why in str(refused.value)


def test_prompts_of_another_form_are_refused() -> None:
    of, target, _, tokens, *_ = pair("qwen3-vl")
    longer = trace_pass(of, ask(of, QUESTIONS[1]), tokens)
    elsewhere = replace(target, pictures=np.roll(target.pictures, 1))
    for source in (longer, elsewhere):
        with raises(TrapsError, "mechanism.patching_effects._require_one_form", str(source.length), str(target.length)):
            patched_changes(of, target, source, [], tokens)
