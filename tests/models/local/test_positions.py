"""States at chosen positions equal the library's own, in every family."""

from __future__ import annotations

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
