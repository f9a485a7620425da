"""Shared prompts: rows of one prompt are read once up to the steered block, and answer as they do alone."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
import pytest

from tests.local_models import ask, model
from tools.tiny_checkpoints import FAMILIES, Family
from traps_pipeline.mechanism.hook import Steering

pytestmark = pytest.mark.slow
LAYER, TOKENS = 2, 5


@pytest.mark.parametrize("family", FAMILIES)
def test_steered_rows_of_two_prompts_answer_as_each_row_does_alone(family: Family) -> None:
    of = model(family)
    prompts = [ask(of), ask(of, question="Which way does the ball go?")]
    assert prompts[0].n_tokens != prompts[1].n_tokens
    rows = [prompts[k] for k in (0, 1, 0, 0, 1)]
    directions = np.random.default_rng(0).standard_normal((len(rows), of.d_model)).astype(np.float32)
    steering = Steering(directions, LAYER, (3.0, -2.0, 0.5, -4.0, 1.0))
    read: dict[int, list[int]] = {1: [], LAYER + 1: []}  # by block: rows of each pass over prompts

    def note(layer: int, _: Any, __: Any, output: Any) -> None:
        if output[0].shape[1] > 1:  # no step of decoding
            read[layer].append(len(output[0]))

    hooks = [of.block(layer).self_attn.register_forward_hook(partial(note, layer)) for layer in read]
    together = of.generate(rows, TOKENS, None, steering)
    for hook in hooks:
        hook.remove()
    alone = [of.generate([row], TOKENS, None, steering.rows([k]))[0] for k, row in enumerate(rows)]
    assert [answer.tokens for answer in together] == [answer.tokens for answer in alone]
    for one, other in zip(together, alone, strict=True):
        assert one.first_token == pytest.approx(other.first_token, abs=1e-4)
    is_shared = family != "gemma-4"  # its upper blocks read keys of lower ones
    assert sum(read[1]) == (2 if is_shared else 5) and sum(read[LAYER + 1]) == (7 if is_shared else 5)


def test_blocks_have_their_own_forward_back_after_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    of, refused = model("qwen3-vl"), RuntimeError("out of order")
    prompt, steering = ask(of), Steering(np.ones(of.d_model, np.float32), LAYER, (1.0, 2.0))
    expected = of.generate([prompt, prompt], TOKENS, None, steering)

    def fails(*_: Any, **__: Any) -> None:
        raise refused

    with monkeypatch.context() as patch:
        patch.setattr(of.network, "generate", fails)
        with pytest.raises(RuntimeError, match="out of order"):
            of.generate([prompt, prompt], TOKENS, None, steering)
    assert not any("forward" in vars(block) for block in of.blocks)
    assert of.generate([prompt, prompt], TOKENS, None, steering) == expected
