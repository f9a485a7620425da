"""Sentences behind one reading of the prompt: as likely as in passes of their own, in every family."""

from __future__ import annotations

import pytest
import torch

from tests.local_models import ask, model
from tools.tiny_checkpoints import FAMILIES, Family
from traps_pipeline.mechanism.sentences import answer_tokens, mean_log_probabilities

pytestmark = pytest.mark.slow
SENTENCES = ("I cannot tell.", "It ends left", "No", "I do not know, since it is hidden.")


@pytest.mark.parametrize("family", FAMILIES)
def test_sentences_of_unlike_length_are_as_likely_together_as_in_passes_of_their_own(family: Family) -> None:
    of = model(family)
    prompt, rows = ask(of), [answer_tokens(of, text) for text in SENTENCES]
    alone: list[float] = []
    for tokens in rows:
        inputs = of.placed(prompt.followed_by(tokens).inputs)
        with torch.inference_mode():
            logits = of.network(**inputs).logits[0, -len(tokens) - 1 : -1].log_softmax(-1)
        alone.append(float(logits[torch.arange(len(tokens)), torch.tensor(tokens)].mean()))
    assert mean_log_probabilities(of, prompt, rows) == pytest.approx(alone, abs=1e-5)
