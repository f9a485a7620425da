"""Capture hidden states with hooks that keep one vector per layer, not per token.

Layers count as in the library's hidden_states: 0 = embeddings, l = output of the l-th block as it leaves the block. The
library's own last state is the normed one; here both are kept.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Literal

if TYPE_CHECKING:
    from torch import Tensor
    from torch.nn import Module

# last: the prompt's last token. answer: the first token of the model's own answer. mean: all tokens of the prompt. The
# others: the mean over that part's tokens (`token_spans`); changed and unchanged: over the visual tokens that differ
# between the two clips of a pair (the occluder's), and over the others.
Pooling = Literal["last", "answer", "mean", "visual", "changed", "unchanged", "stamps", "question"]
OF_PAIRS: tuple[Pooling, ...] = ("changed", "unchanged")
OF_PARTS: tuple[Pooling, ...] = ("visual", *OF_PAIRS, "stamps", "question")
ONE_TOKEN: tuple[Pooling, ...] = ("last", "answer")


@dataclass
class CapturedStates:
    """The states of one pass on its device: embeddings and block outputs `raw`, each (d,)."""

    raw: list[Tensor] = field(default_factory=list)
    normed: Tensor | None = None


def first_tensor(output: Any) -> Tensor:
    """Return the hidden states in a block's output, which some models wrap in a tuple."""
    return output[0] if isinstance(output, tuple) else output


def pool(states: Tensor, pooling: Pooling, chosen: Tensor | None = None) -> Tensor:
    """Return states (1, T, d) pooled to (d,): the last token's state, or a mean.

    The state of the last token is in the model's precision; the mean over all tokens, or over those that a mask (T,)
    selects, is in float32. The result is a copy: a view would keep the whole tensor alive.
    """
    if len(states) != 1:
        raise ValueError(f"{len(states)} prompts in one pass: states are taken one prompt at a time")
    if pooling in ONE_TOKEN:
        return states[0, -1].clone()
    return (states[0] if chosen is None else states[0, chosen.to(states.device)]).float().mean(dim=0)


@contextmanager
def capture_states(
    blocks: Iterator[Module], norm: Module, pooling: Pooling, chosen: Tensor | None = None
) -> Iterator[CapturedStates]:
    """Yield the pooled states of passes within the block; remove all hooks afterwards."""
    states = CapturedStates()

    def embeddings(_: Module, args: tuple[Any, ...], kwargs: dict[str, Any]) -> None:
        states.raw.append(pool(args[0] if args else kwargs["hidden_states"], pooling, chosen))

    def block(_: Module, __: Any, output: Any) -> None:
        states.raw.append(pool(first_tensor(output), pooling, chosen))

    def keep_normed(_: Module, __: Any, output: Any) -> None:
        states.normed = pool(first_tensor(output), pooling, chosen)

    with ExitStack() as hooks:
        for number, module in enumerate(blocks):
            if number == 0:
                hooks.callback(module.register_forward_pre_hook(embeddings, with_kwargs=True).remove)
            hooks.callback(module.register_forward_hook(block).remove)
        hooks.callback(norm.register_forward_hook(keep_normed).remove)
        yield states
