"""Steering adds alpha v to the output of one block and changes nothing else; at alpha 0 there is no hook at all."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from tests.build.errors import raises
from tests.local_models import FAMILIES, Family, ask, direction, model, three_prompts
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.mechanism.hook import Steering
from traps_pipeline.models.local.adapter import LocalModel

pytestmark = pytest.mark.slow


def hooks(of: LocalModel) -> int:
    return sum(len(m._forward_hooks) + len(m._forward_pre_hooks) for m in of.network.modules())


def logits(of: LocalModel) -> torch.Tensor:
    with torch.inference_mode():
        return of.network(**three_prompts("gemma-4")[0].inputs, use_cache=False).logits


@pytest.mark.parametrize("family", FAMILIES)
def test_every_position_of_the_prompt_is_steered_alike(family: Family) -> None:
    of, prompt = model(family), three_prompts(family)[0]
    v = direction(of)
    plain, steered = of.forward_states(prompt, "mean"), of.forward_states(prompt, "mean", Steering(v, 2, (100.0,)))
    moved = steered.raw[2] - plain.raw[2]
    np.testing.assert_allclose(moved, 100 * v, rtol=0, atol=1e-4)  # were one of 60 left out: 1.6


def test_alpha_zero_is_bit_identical_in_tokens_and_logits() -> None:
    of, prompts = model("gemma-4"), three_prompts("gemma-4")
    none, expected = Steering(direction(of), 2, (0.0,) * 3), logits(of)
    with none.applied(of):
        assert torch.equal(logits(of), expected)
    plain = [answer.tokens for answer in of.generate(prompts, 8)]
    assert [answer.tokens for answer in of.generate(prompts, 8, steering=none)] == plain
    mixed = of.generate(prompts, 8, steering=Steering(direction(of), 2, (0.0, 90.0, 0.0)))
    assert [mixed[0].tokens, mixed[2].tokens] == [plain[0], plain[2]]
    assert mixed[1].tokens != plain[1]


def test_the_hook_is_gone_after_an_exception() -> None:
    of = model("gemma-4")
    before, expected = hooks(of), logits(of)
    with pytest.raises(RuntimeError, match="in between"), Steering(direction(of), 2, (5.0,)).applied(of):
        assert hooks(of) == before + 1
        assert not torch.equal(logits(of), expected)
        raise RuntimeError("in between")
    assert hooks(of) == before
    assert torch.equal(logits(of), expected)
    with raises(ValueError, "mechanism.hook.Steering.applied.<locals>.add", "1", "2"):
        of.forward_states(ask(of), steering=Steering(direction(of), 2, (5.0, 5.0)))
    assert hooks(of) == before


def test_a_direction_of_another_model_or_layer_is_refused() -> None:
    of = model("qwen3-vl")
    v = direction(of)
    for wrong, by, named in (
        (Steering(v[:10], 2, (1.0,)), "mechanism.hook.Steering.applied", "(10,)"),
        (Steering(v * np.nan, 2, (1.0,)), "mechanism.hook.Steering.applied", "(64,)"),
        (Steering(v, 5, (1.0,)), "models.local.model.LocalModel.block", "5"),
        (Steering(v, 0, (1.0,)), "models.local.model.LocalModel.block", "0"),
    ):
        with raises(TrapsError, by, named, of.checkpoint.name):
            of.generate([ask(of)], 4, steering=wrong)
