"""Compute the output margin: the log-odds that an answer begins with an abstention.

It compares, at the first answer token, the tokens that begin an abstention with all others. A probe says something
about a gap between representation and output only as far as it separates better than this.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from traps_pipeline.base.errors import TrapsError

if TYPE_CHECKING:
    from torch import Tensor

    from traps_pipeline.models.local.adapter import LocalModel

# Beginnings of an abstention. The guided prompt asks for "I don't know" (assets/prompts).
PHRASES = ("i don't know", "i do not know", "i cannot", "i can't", "cannot", "unable", "unanswerable", "unknown")
_FIRST_WORDS = frozenset(phrase.split()[0] for phrase in PHRASES)


def is_abstention_start(token: str) -> bool:
    """Return whether a token begins an abstention: one of PHRASES or its first word.

    "I" counts, although other sentences begin with it too: the margin is a lower bound of the information in the first
    token.
    """
    text = token.strip().lower().replace("\u2019", "'")
    return text in _FIRST_WORDS or text.startswith(PHRASES)


def abstention_tokens(model: LocalModel) -> list[int]:
    """Return the ids of tokens that begin an abstention. Raises TrapsError if there is none."""
    tokenizer = model.processor.tokenizer
    texts = tokenizer.batch_decode([[token] for token in range(len(tokenizer))])
    tokens = [token for token, text in enumerate(texts) if is_abstention_start(text)]
    if not tokens:
        raise TrapsError(
            f"{model.checkpoint.name}: no token of its vocabulary begins an abstention ({', '.join(PHRASES)}), so its "
            "output margin cannot be read; set `patching: null` in the experiment and in study.yaml"
        )
    return tokens


def margin_of(logits: Tensor, tokens: Sequence[int], never: Sequence[int] = ()) -> Tensor:
    """Return the log-odds of `tokens` against all others but `never`, (.., vocabulary) -> (..)."""
    import torch

    is_abstention = torch.zeros(logits.shape[-1], dtype=torch.bool, device=logits.device)
    is_abstention[list(tokens)] = True
    alternatives = ~is_abstention
    if never:
        alternatives[list(never)] = False
    logits = logits.float()
    return torch.logsumexp(logits[..., is_abstention], -1) - torch.logsumexp(logits[..., alternatives], -1)


def first_token_margins(model: LocalModel, normed: Any, tokens: Sequence[int]) -> Tensor:
    """Return margins (n,) of normed states (n, d) at a prompt's end, on the CPU; gradients pass."""
    import torch

    states = torch.as_tensor(np.asarray(normed)) if not torch.is_tensor(normed) else normed
    never = model.network.generation_config.suppress_tokens or ()
    return margin_of(head_logits(model, states), tokens, never).cpu()


def head_logits(model: LocalModel, normed: Tensor) -> Tensor:
    """Return the logits (n, vocabulary) float32 of normed states (n, d)."""
    import torch

    head, config = model.network.get_output_embeddings(), model.network.config.get_text_config()
    # Of a spread model accelerate moves the states on; an offloaded head has no device of its own (`meta`).
    logits = head(normed.to(model.inputs_device, model.network.dtype)).float()
    cap = getattr(config, "final_logit_softcapping", None)
    return torch.tanh(logits / cap) * cap if cap else logits
