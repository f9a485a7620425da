"""Read and replace a block's inputs other than the residual stream and its own cache (side paths).

Gemma 4 has two such paths, both of them arguments of its blocks. Its upper blocks compute no keys and values: each
reads those of the last lower block with its kind of attention (`shared_kv_states`, a mapping by kind). And every block
adds its own vector computed from the token and its embedding (`per_layer_input`). So a state at block l does not
determine the output of later blocks: a patch there replaces both as well.

Qwen3-VL's deepstack features, which are added between blocks, are inputs of its decoder: `mechanism.patching_effects`
replaces them there.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable
from functools import cache
from typing import TYPE_CHECKING, Any, Literal

if TYPE_CHECKING:
    from torch.nn import Module

Argument = Literal["shared_kv_states", "per_layer_input"]
CACHE_NAMES = ("cache", "past_key_values")  # of the cache among a block's arguments: from transformers 5.24 on, before
SHARED_KEYS: Argument = "shared_kv_states"
PER_LAYER: Argument = "per_layer_input"
# By configuration field: the blocks' argument for this path, and a description.
_FIELDS: dict[str, tuple[Argument | None, str]] = {
    "num_kv_shared_layers": (SHARED_KEYS, "later blocks reuse keys and values of earlier ones"),
    "hidden_size_per_layer_input": (PER_LAYER, "every block reads the token's own embedding again"),
    "altup_num_inputs": (None, "blocks hand on several residual streams"),  # Gemma 3n
}


def unknown_side_path(config: Any, block: Module) -> str | None:
    """Return in words an input that the configuration gives to blocks and this module does not know; None if none."""
    for field, (argument, path) in _FIELDS.items():
        if getattr(config, field, 0) and argument not in _arguments(type(block)):
            return f"{path} ({field})"
    return None


def argument_of(block: Module, name: Argument, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
    """Return the value of an argument in a call of a block; None if the block or the call lacks it."""
    names = _arguments(type(block))
    place = names.index(name) if name in names else len(args)
    return args[place] if place < len(args) else kwargs.get(name)


def with_argument(
    block: Module, name: Argument, value: Any, args: tuple[Any, ...], kwargs: dict[str, Any]
) -> tuple[tuple[Any, ...], dict[str, Any]]:
    """Return the arguments (args, kwargs) of a call of a block with one of them replaced."""
    place = _arguments(type(block)).index(name)
    if place < len(args):
        return (*args[:place], value, *args[place + 1 :]), kwargs
    return args, kwargs | {name: value}


def cache_argument(module: Module) -> str:
    """Return the name of the cache among a model's arguments."""
    return next(name for name in CACHE_NAMES if name in _arguments(type(module)))


@cache
def _arguments(kind: type[Module]) -> tuple[str, ...]:
    forward: Callable[..., Any] = kind.forward
    return tuple(inspect.signature(forward).parameters)[1:]  # without self
