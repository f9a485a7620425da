"""What the blocks below a steered one make of a prompt, kept: steering changes the output of block l, so blocks 1 to l
give the same for every direction and dose. A steered answer is then resumed at block l: the kept states are steered,
and only the blocks behind l read the prompt again.

The states at block l and the keys and values of blocks 1 to l are kept for each prompt, on the model's device, the
latest ones up to `MOST_BYTES`. A prompt is known by the digest of its inputs. Of Gemma 4's two side paths
(`sidepaths`) the keys and values that blocks behind l read of those up to l are handed on as they would be, and the
vectors of each block are made anew from the embeddings, pictures included. Models with another such path, or whose
cache holds more than keys and values, run from the start. Whoever changes weights in memory must give the model a new
`PrefixMemory`.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, field
from itertools import product
from typing import TYPE_CHECKING, Any, Protocol

from traps_pipeline.models.local.library import load_transformers
from traps_pipeline.models.local.prompt_batches import Prompt
from traps_pipeline.models.local.sidepaths import SHARED, given, unknown_path

if TYPE_CHECKING:
    from torch import Tensor
    from torch.nn import Module

MOST_BYTES = 4 * 2**30  # of what is kept, on the model's device
# Caches of keys and values alone: of all of them, or of the latest ones, which is given all of a prompt's once more.
_PLAIN = ("DynamicLayer", "DynamicSlidingWindowLayer")


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
    """Of one prompt of T tokens: the output of block l (T, d), and for each of the blocks 1 to l that makes its own,
    which are the lowest ones, keys and values (heads, T, width). shared: which blocks' ones are handed on to later
    blocks, counted from 0, by the name under which they are."""

    states: Tensor
    keys: tuple[Tensor, ...]
    values: tuple[Tensor, ...]
    shared: Mapping[str, int]

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
    """Whether all that blocks read of earlier ones is known: the residual stream, their own cache, `sidepaths`."""
    return unknown_path(model.network.config.get_text_config(), model.blocks[0]) is None


def without_pictures(model: Resumable, prompts: Sequence[Prompt], layer: int) -> list[Prompt]:
    """The prompts as a resumed pass needs them: without pixels, unless what the vision tower made of them enters behind
    the layer too (deepstack, and vectors of each block that are made of embeddings). Their grids stay, since positions
    follow from them."""
    added = getattr(getattr(model.network.config, "vision_config", None), "deepstack_visual_indexes", None) or ()
    if layer <= len(added) or getattr(model.network.config.get_text_config(), "hidden_size_per_layer_input", 0):
        return [*prompts]
    return [
        Prompt(prompt.text, {name: value for name, value in prompt.inputs.items() if not value.is_floating_point()})
        for prompt in prompts
    ]


@contextmanager
def resumed(model: Resumable, prefixes: Sequence[Prefix], layer: int) -> Iterator[None]:
    """Inside, the next pass, over these prompts padded on the left, takes blocks 1 to `layer` from the prefixes; hooks
    on block `layer` see and change its output as ever. Later passes are the model's own."""
    width, one = max(len(prefix.states) for prefix in prefixes), prefixes[0]

    def once(number: int, block: Module) -> Callable[..., Any]:
        def forward(hidden_states: Tensor, *args: Any, past_key_values: Any, **kwargs: Any) -> Any:
            del block.forward  # pyright: ignore[reportAttributeAccessIssue] - the class's own method is found again
            if number < len(one.keys):
                keys = _padded([prefix.keys[number] for prefix in prefixes], width)
                values = _padded([prefix.values[number] for prefix in prefixes], width)
                made = past_key_values.update(keys, values, number)
                for name in [name for name, maker in one.shared.items() if maker == number]:
                    given(block, SHARED, (hidden_states, *args), kwargs)[name] = made
            if number + 1 < layer:
                return hidden_states  # which block `layer` does not read
            states = _padded([prefix.states for prefix in prefixes], width)
            return states[:, -hidden_states.shape[1] :]  # upper blocks of Gemma 4 are shown the last token alone

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
    """A plain pass over a prompt up to a layer; None if its cache holds more than keys and values."""
    import torch

    config, states, named = model.network.config.get_text_config(), list[Any](), list[str]()
    cache = load_transformers().DynamicCache(config=config)
    made: dict[int, tuple[Tensor, Tensor]] = {}
    shared: dict[str, int] = {}
    update = cache.update

    def kept(keys: Tensor, values: Tensor, number: int, *rest: Any, **other: Any) -> tuple[Tensor, Tensor]:
        made[number] = update(keys, values, number, *rest, **other)  # all of them, whatever the cache forgets
        return made[number]

    def enough(block: Module, args: tuple[Any, ...], kwargs: dict[str, Any], output: Any) -> None:
        states.append(output)
        handed_on = given(block, SHARED, args, kwargs) or {}
        named.extend(handed_on)
        for name, number in product(handed_on, made):
            if handed_on[name][0] is made[number][0]:
                shared[name] = number
        raise _EnoughError

    cache.update = kept
    handle = model.block(layer).register_forward_hook(enough, with_kwargs=True)
    try:
        with torch.inference_mode(), model.remembering_clips():
            model.network.base_model(**model.placed(prompt.inputs), past_key_values=cache, use_cache=True)
    except _EnoughError:
        pass
    finally:
        handle.remove()
    makers = len(model.blocks) - getattr(config, "num_kv_shared_layers", 0)  # the upper ones read those of the lower
    known = isinstance(states[0], torch.Tensor) and {*shared} == {*named} and [*made] == [*range(min(layer, makers))]
    if not known or any(type(cache.layers[number]).__name__ not in _PLAIN for number in made):
        return None
    pairs = made.values()
    return Prefix(states[0][0], tuple(keys[0] for keys, _ in pairs), tuple(values[0] for _, values in pairs), shared)
