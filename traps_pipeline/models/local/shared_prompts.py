"""Run the first blocks once per distinct prompt, for rows that differ only behind them.

Steered answers to one item share its prompt, and blocks up to the steered one read the same in every row. So a batch's
first pass takes their keys, values and output from a pass over its distinct prompts. Rows of 16 bits differ from rows
that are computed one by one as batches of other sizes do: by rounding.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from functools import partial
from typing import TYPE_CHECKING, Any

from traps_pipeline.models.local.capture import first_tensor
from traps_pipeline.models.local.prompt_batches import Prompt, collate
from traps_pipeline.models.local.sidepaths import CACHE_NAMES, has_other_paths

if TYPE_CHECKING:
    from torch import Tensor


@contextmanager
def sharing_prompts(model: Any, prompts: Sequence[Prompt], last: int, pad_token: int) -> Iterator[None]:
    """Skip blocks 1 to `last` in the first pass over these prompts inside the context.

    model: a `decoding.DecodingModel`. last: the last block whose input is the same for equal prompts. Models whose
    later blocks read more of earlier ones than the residual stream, or that keep only a window of their keys, run all
    blocks.
    """
    import torch

    distinct = [*dict.fromkeys(prompts)]
    if last < 1 or len(distinct) == len(prompts) or has_other_paths(model.network.config.get_text_config()):
        yield
        return
    place: dict[Prompt, int] = {prompt: number for number, prompt in enumerate(distinct)}
    states: list[Tensor] = []
    rows = torch.tensor([place[prompt] for prompt in prompts])
    blocks = model.blocks[:last]
    keep = blocks[-1].register_forward_hook(lambda _, __, output: states.append(first_tensor(output).clone()))
    try:
        inputs = model.placed(collate(distinct, pad_token))
        # The library's `generate`, since it is what numbers the positions of padded prompts.
        cache = model.network.generate(**inputs, max_new_tokens=1, return_dict_in_generate=True).past_key_values
    finally:
        keep.remove()

    def first_pass(number: int, forward: Any, hidden_states: Tensor, *args: Any, **kwargs: Any) -> Any:
        if hidden_states.shape[1] != states[0].shape[1]:  # a step behind the prompt
            return forward(hidden_states, *args, **kwargs)
        layer = cache.layers[number]
        keys, values = (part[rows.to(part.device)] for part in (layer.keys, layer.values))
        own_cache = next(kwargs[name] for name in CACHE_NAMES if kwargs.get(name) is not None)
        own_cache.update(keys, values, number)
        return states[0][rows.to(states[0].device)] if number == last - 1 else hidden_states

    with ExitStack() as changes:
        for number, block in enumerate(blocks):
            own_forward = vars(block).get("forward")  # set by accelerate on a model that is spread over devices
            changes.callback(_restore, block, own_forward)
            block.forward = partial(first_pass, number, block.forward)
        yield


def _restore(block: Any, own_forward: Any) -> None:
    """Give a block its own `forward` back."""
    del block.forward
    if own_forward is not None:
        block.forward = own_forward
