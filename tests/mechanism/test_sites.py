"""Interventions at one attention head: its slice of what the output projection reads changes, and nothing else."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext

import numpy as np
import pytest
import torch

from tests.local_models import FAMILIES, Family, direction, model, three_prompts
from traps_pipeline import inside
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.models.local.adapter import LocalModel

pytestmark = pytest.mark.slow

each_family = pytest.mark.parametrize("family", FAMILIES)
LAYER, HEAD, HEADS = 2, 1, 4


def projection(of: LocalModel) -> torch.nn.Linear:
    return of.blocks[LAYER - 1].self_attn.o_proj


def seen(of: LocalModel, family: Family, inside_of: AbstractContextManager[None]) -> tuple[torch.Tensor, torch.Tensor]:
    """What the output projection reads, (T, heads * hd), and the logits of the last token."""
    kept: list[torch.Tensor] = []
    with inside_of, torch.inference_mode():
        handle = projection(of).register_forward_hook(lambda _, args, __: kept.append(args[0][0].clone()))
        logits = of.network(**three_prompts(family)[0].inputs, use_cache=False).logits[0, -1]
        handle.remove()
    return kept[0], logits


@contextmanager
def plain_hook(of: LocalModel, change: Callable[[torch.Tensor], torch.Tensor]) -> Iterator[None]:
    """A researcher's own hook: change is given the slice of the head, (1, T, hd)."""
    width = projection(of).in_features // HEADS

    def hook(_: object, args: tuple[torch.Tensor]) -> tuple[torch.Tensor]:
        heads = args[0].unflatten(-1, (HEADS, width)).clone()
        heads[:, :, HEAD] = change(heads[:, :, HEAD])
        return (heads.flatten(-2),)

    handle = projection(of).register_forward_pre_hook(hook)
    yield
    handle.remove()


@each_family
def test_a_head_alone_is_changed_as_a_plain_hook_changes_it(family: Family) -> None:
    of = model(family)
    width = projection(of).in_features // HEADS
    vector = np.random.default_rng(0).normal(size=width).astype(np.float32)
    unit = torch.from_numpy(vector / np.linalg.norm(vector))
    mine = slice(HEAD * width, (HEAD + 1) * width)
    before, plain = seen(of, family, nullcontext())
    push = inside.Direction(vector, LAYER)
    changes: dict[str, Callable[[torch.Tensor], torch.Tensor]] = {
        "add": lambda states: states + 6.0 * unit,
        "project out": lambda states: states - 6.0 * (states @ unit)[..., None] * unit,
        "clamp": lambda states: states + (6.0 - states @ unit)[..., None] * unit,
    }
    for how, change in changes.items():
        after, changed = seen(of, family, push.apply(of.network, 6.0, how=how, site="attention", head=HEAD))
        _, theirs = seen(of, family, plain_hook(of, change))
        assert torch.equal(changed, theirs) and not torch.equal(changed, plain)
        assert torch.equal(after[:, mine], change(before[None, :, mine])[0])
        others = torch.ones(before.shape[1], dtype=torch.bool)
        others[mine] = False
        assert torch.equal(after[:, others], before[:, others])
    assert torch.equal(seen(of, family, nullcontext())[1], plain)  # every hook is gone


@each_family
def test_a_direction_of_the_residual_stream_is_the_one_that_the_head_writes_the_most_along(family: Family) -> None:
    of, v = model(family), direction(model(family))
    width = projection(of).in_features // HEADS
    weights = projection(of).weight.detach()[:, HEAD * width : (HEAD + 1) * width]  # (d, hd)
    along = weights.T @ torch.from_numpy(v)
    unit = along / along.norm()
    _, ours = seen(of, family, inside.Direction(v, LAYER).apply(of, 4.0, site="attention", head=HEAD))
    _, theirs = seen(of, family, plain_hook(of, lambda states: states + 4.0 * unit))
    assert torch.allclose(ours, theirs, atol=1e-5)
    last = torch.arange(three_prompts(family)[0].n_tokens) == three_prompts(family)[0].n_tokens - 1
    with inside.Direction(v, LAYER).apply(
        of, 4.0, site="attention", head=HEAD, positions=lambda states: last.expand(states.shape[:2])
    ):
        after, _ = seen(of, family, nullcontext())
    before, _ = seen(of, family, nullcontext())
    assert torch.equal(after[:-1], before[:-1]) and not torch.equal(after[-1], before[-1])


def test_a_head_that_is_not_there_is_told() -> None:
    of, v = model("qwen3-vl"), direction(model("qwen3-vl"))
    push = inside.Direction(v, LAYER, gap=1.0)
    for wrong, message in (
        ({"amount": 1.0, "site": "attention", "head": 4}, "no head 4; the blocks of this model have heads 0 to 3"),
        ({"amount": 1.0, "site": "mlp", "head": 1}, "head 1 is one of a block's attention, not of its mlp"),
        ({"gaps": 1.0, "site": "attention", "head": 1}, "not in a head; give amount"),
    ):
        with pytest.raises(TrapsError, match=message), push.apply(of, **wrong):
            pass
    short, message = inside.Direction(v[:10], LAYER), r"shape \(10,\), but states of this model are 16 finite"
    with pytest.raises(TrapsError, match=message), short.apply(of, 1.0, site="attention", head=0):
        pass
