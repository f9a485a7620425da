"""Steering adds alpha v to the output of one block and changes nothing else; at alpha 0 there is no hook at all."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from tests.local_models import FAMILIES, Family, ask, direction, model, three_prompts
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.mechanism.hook import Steering
from traps_pipeline.models.local.adapter import LocalModel

pytestmark = pytest.mark.slow

each_family = pytest.mark.parametrize("family", FAMILIES)


def hooks(of: LocalModel) -> int:
    return sum(len(m._forward_hooks) + len(m._forward_pre_hooks) for m in of.network.modules())


def logits(of: LocalModel, family: Family) -> torch.Tensor:
    with torch.inference_mode():
        return of.network(**three_prompts(family)[0].inputs, use_cache=False).logits


@each_family
@pytest.mark.parametrize("layer", [1, 3, 4])
def test_a_steered_state_is_the_unsteered_one_plus_alpha_v_exactly(family: Family, layer: int) -> None:
    of, prompt = model(family), three_prompts(family)[0]
    v, alpha = direction(of), -7.25
    plain, steered = of.forward_states(prompt), of.forward_states(prompt, steering=Steering(v, layer, (alpha,)))
    assert (steered.raw[layer] == plain.raw[layer] + np.float32(alpha) * v).all()
    assert (steered.raw[:layer] == plain.raw[:layer]).all()
    assert (steered.normed != plain.normed).any()
    assert layer == of.n_layers or (steered.raw[layer + 1] != plain.raw[layer + 1] + np.float32(alpha) * v).any()


@each_family
def test_every_position_of_the_prompt_is_steered_alike(family: Family) -> None:
    of, prompt = model(family), three_prompts(family)[0]
    v = direction(of)
    plain, steered = of.forward_states(prompt, "mean"), of.forward_states(prompt, "mean", Steering(v, 2, (100.0,)))
    np.testing.assert_allclose(
        steered.raw[2] - plain.raw[2], 100 * v, rtol=0, atol=1e-4
    )  # were one of 60 left out: 1.6


@each_family
def test_the_librarys_own_recorder_sees_the_steered_state(family: Family) -> None:
    of, prompt = model(family), three_prompts(family)[0]
    push = Steering(direction(of), 2, (30.0,))

    def recorded() -> np.ndarray:
        with torch.inference_mode():
            out = of.network.base_model(**prompt.inputs, use_cache=False, output_hidden_states=True)
        return out.hidden_states[2][0, -1].numpy()

    plain = recorded()  # installs the library's hooks, which stay and come before later ones
    with push.applied(of):
        assert (recorded() == plain + np.float32(30) * push.direction).all()


@each_family
def test_alpha_zero_is_bit_identical_in_tokens_and_logits(family: Family) -> None:
    of, prompts = model(family), three_prompts(family)
    none = Steering(direction(of), 2, (0.0,) * 3)
    before, expected = hooks(of), logits(of, family)
    with none.applied(of):
        assert hooks(of) == before
        assert torch.equal(logits(of, family), expected)
    plain = [answer.tokens for answer in of.generate(prompts, 8)]
    assert [answer.tokens for answer in of.generate(prompts, 8, steering=none)] == plain
    mixed = of.generate(prompts, 8, steering=Steering(direction(of), 2, (0.0, 90.0, 0.0)))
    assert [mixed[0].tokens, mixed[2].tokens] == [plain[0], plain[2]]
    assert mixed[1].tokens != plain[1]


@each_family
def test_an_alpha_a_row_gives_what_separate_runs_give(family: Family) -> None:
    of, prompts = model(family), three_prompts(family)
    v, alphas = direction(of), (60.0, 0.0, -60.0)
    together = of.generate(prompts, 8, steering=Steering(v, 2, alphas))
    uncached = of.generate(prompts, 8, steering=Steering(v, 2, alphas), use_cache=False)
    for prompt, alpha, answer, slow in zip(prompts, alphas, together, uncached, strict=True):
        (alone,) = of.generate([prompt], 8, steering=Steering(v, 2, (alpha,)))
        assert alone.tokens == answer.tokens == slow.tokens
    assert together[0].tokens != of.generate([prompts[0]], 8)[0].tokens


@each_family
def test_the_hook_is_gone_after_an_exception(family: Family) -> None:
    of = model(family)
    before, expected = hooks(of), logits(of, family)
    with pytest.raises(RuntimeError, match="in between"), Steering(direction(of), 2, (5.0,)).applied(of):
        assert hooks(of) == before + 1
        assert not torch.equal(logits(of, family), expected)
        raise RuntimeError("in between")
    assert hooks(of) == before
    assert torch.equal(logits(of, family), expected)
    with pytest.raises(ValueError, match="the pass has 1 rows, but 2 alphas"):
        of.forward_states(ask(of), steering=Steering(direction(of), 2, (5.0, 5.0)))
    assert hooks(of) == before


def test_a_direction_of_another_model_or_layer_is_refused() -> None:
    of = model("qwen3-vl")
    v = direction(of)
    for wrong, complaint in (
        (Steering(v[:10], 2, (1.0,)), r"shape \(10,\).*states are 64"),
        (Steering(v * np.nan, 2, (1.0,)), "finite"),
        (Steering(v, 5, (1.0,)), "no block 5; it has blocks 1 to 4"),
        (Steering(v, 0, (1.0,)), "no block 0"),
    ):
        with pytest.raises(TrapsError, match=complaint):
            of.generate([ask(of)], 4, steering=wrong)
