"""What the blocks below a steered one make of a prompt, kept: steering changes the output of block l, so blocks 1 to l
give the same for every direction and dose. A steered answer is then resumed at block l: the kept states are steered,
and only the blocks behind l read the prompt again.

The states at block l and the keys and values of blocks 1 to l are kept for each prompt, on the model's device, the
latest ones up to `MOST_BYTES`. A prompt is known by the digest of its inputs. Models whose later blocks read more of
earlier ones than the residual stream and the cache (Gemma 4), or whose cache is no plain one, run from the start.
Whoever changes weights in memory must give the model a new `PrefixMemory`.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Protocol

from traps_pipeline.models.local.library import load_transformers
from traps_pipeline.models.local.prompts import Prompt

if TYPE_CHECKING:
    from torch import Tensor
    from torch.nn import Module

MOST_BYTES = 4 * 2**30  # of what is kept, on the model's device


class Resumable(Protocol):
    """What is used of a `LocalModel` here and in `decoding`."""

    network: Any
    blocks: Any
    prefixes: PrefixMemory

    def block(self, layer: int) -> Module:
        """The block whose output is hidden_states[layer]."""
        ...

    def placed(self, inputs: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Inputs on the model's device."""
        ...

    def remembering_clips(self) -> AbstractContextManager[None]:
        """Inside, the vision tower sees each clip once."""
        ...


class _EnoughError(Exception):
    """Ends a pass behind the block whose output was wanted."""


@dataclass(frozen=True, eq=False)
class Prefix:
    """Of one prompt of T tokens: the output of block l (T, d), and for each of the blocks 1 to l keys and values
    (heads, T, width)."""

    states: Tensor
    keys: tuple[Tensor, ...]
    values: tuple[Tensor, ...]

    @property
    def size(self) -> int:
        """Bytes."""
        return sum(part.numel() * part.element_size() for part in (self.states, *self.keys, *self.values))


@dataclass(eq=False)
class PrefixMemory:
    """Prefixes by prompt and layer. passes: prompts that went through the lower blocks; used: those that did not have
    to. active: whether `LocalModel.generate` resumes (`remembering`)."""

    most_bytes: int = MOST_BYTES
    active: bool = False
    passes: int = 0
    used: int = 0
    _kept: OrderedDict[tuple[str, int], Prefix] = field(default_factory=OrderedDict)
    _size: int = 0

    @contextmanager
    def remembering(self) -> Iterator[None]:
        """Inside, steered answers are resumed at the steered block."""
        before, self.active = self.active, True
        try:
            yield
        finally:
            self.active = before

    def of(self, model: Resumable, prompts: Sequence[Prompt], layer: int) -> list[Prefix] | None:
        """The prefix of each prompt up to a layer; None for a model that cannot be resumed there."""
        if not resumable(model):
            return None
        found: dict[str, Prefix] = {}
        for prompt in prompts:
            key = prompt.digest, layer
            known = found.get(prompt.digest) or self._kept.get(key)
            if known is None:
                known = _record(model, prompt, layer)
                if known is None:
                    return None
                self.passes += 1
                self._keep(key, known)
            else:
                self.used += 1
                if key in self._kept:
                    self._kept.move_to_end(key)
            found[prompt.digest] = known
        return [found[prompt.digest] for prompt in prompts]

    def _keep(self, key: tuple[str, int], prefix: Prefix) -> None:
        self._kept[key] = prefix
        self._size += prefix.size
        while self._size > self.most_bytes and len(self._kept) > 1:
            _, oldest = self._kept.popitem(last=False)
            self._size -= oldest.size


def resumable(model: Resumable) -> bool:
    """Whether blocks read nothing of earlier ones but the residual stream and their own cache."""
    config = model.network.config.get_text_config()
    return not any(getattr(config, name, 0) for name in ("num_kv_shared_layers", "hidden_size_per_layer_input"))


def without_pictures(model: Resumable, prompts: Sequence[Prompt], layer: int) -> list[Prompt]:
    """The prompts as a resumed pass needs them: without pixels, unless what the vision tower made of them is added
    behind the layer too (deepstack). Their grids stay, since positions follow from them."""
    added = getattr(getattr(model.network.config, "vision_config", None), "deepstack_visual_indexes", None) or ()
    if layer <= len(added):
        return [*prompts]
    return [
        Prompt(prompt.text, {name: value for name, value in prompt.inputs.items() if not value.is_floating_point()})
        for prompt in prompts
    ]


@contextmanager
def resumed(model: Resumable, prefixes: Sequence[Prefix], layer: int) -> Iterator[None]:
    """Inside, the next pass, over these prompts padded on the left, takes blocks 1 to `layer` from the prefixes; hooks
    on block `layer` see and change its output as ever. Later passes are the model's own."""
    width = max(len(prefix.states) for prefix in prefixes)

    def once(number: int, block: Module) -> Callable[..., Any]:
        def forward(hidden_states: Tensor, *_: Any, past_key_values: Any, **__: Any) -> Any:
            del block.forward  # pyright: ignore[reportAttributeAccessIssue] - the class's own method is found again
            keys = _padded([prefix.keys[number] for prefix in prefixes], width)
            values = _padded([prefix.values[number] for prefix in prefixes], width)
            past_key_values.update(keys, values, number)
            if number + 1 < layer:
                return hidden_states  # which block `layer` does not read
            return _padded([prefix.states for prefix in prefixes], width)

        return forward

    blocks = [*model.blocks][:layer]
    for number, block in enumerate(blocks):
        block.forward = once(number, block)
    try:
        yield
    finally:
        for block in blocks:
            vars(block).pop("forward", None)


def _padded(rows: Sequence[Tensor], width: int) -> Tensor:
    """Rows (..., T, d) as one batch (rows, ..., width, d), with zeros on the left, which attention masks hide."""
    import torch

    if all(row is rows[0] for row in rows):
        return rows[0].expand(len(rows), *rows[0].shape)
    return torch.stack([torch.nn.functional.pad(row, (0, 0, width - row.shape[-2], 0)) for row in rows])


def _record(model: Resumable, prompt: Prompt, layer: int) -> Prefix | None:
    """A plain pass over a prompt up to a layer; None if its cache is no plain one."""
    import torch

    transformers = load_transformers()
    cache, states = transformers.DynamicCache(config=model.network.config.get_text_config()), list[Any]()

    def enough(_: Module, __: Any, output: Any) -> None:
        states.append(output)
        raise _EnoughError

    handle = model.block(layer).register_forward_hook(enough)
    try:
        with torch.inference_mode(), model.remembering_clips():
            model.network.base_model(**model.placed(prompt.inputs), past_key_values=cache, use_cache=True)
    except _EnoughError:
        pass
    finally:
        handle.remove()
    kept = cache.layers[:layer]
    plain = isinstance(states[0], torch.Tensor) and all(type(row).__name__ == "DynamicLayer" for row in kept)
    if not plain:
        return None
    return Prefix(states[0][0], tuple(row.keys[0] for row in kept), tuple(row.values[0] for row in kept))
