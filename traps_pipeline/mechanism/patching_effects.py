"""Patch activations: replace a part of one pass by another's, and measure answers.

A pass over a target prompt (say, a control) is made again with the states of a source prompt (its void) at some
positions of one site: the residual stream as it leaves block l (0: the embeddings), or the output of a block's
attention or MLP. The outcome is the log-odds that the answer begins by abstaining (`margin`), and the indirect effect
is the share of the way from the target's outcome to the source's: 0 if nothing changed, 1 if it is the source's.

`patched_changes` measures it; a pass begins at the patched block, from the target's recorded state.
`attributed_changes` estimates it for every position, site and layer from one backward pass (attribution patching): the
gradient of the target's outcome along the difference of the two states.

A residual patch at layer l replaces everything that blocks behind l read of the patched positions; without that,
replacing all positions does not give the source's answer. In some models this is more than the state there:

- Qwen3-VL adds deepstack features to the residual stream behind its first blocks, at visual positions. A patch takes
  the source's features wherever they are added behind its site.
- Gemma 4's upper blocks read keys and values that lower ones made, and each block is given a vector of the token's own
  (`models.local.sidepaths`). A patch takes the source's keys and values where block l or an earlier one made them and
  blocks behind l read them, and the source's vectors for the blocks behind l. What the blocks up to l read stays the
  target's.

A patch of attention or MLP replaces what that part adds to the residual stream, and nothing else: keys and values are
read off the state before it, and the other paths begin below the blocks. Models in which later blocks read anything
else of earlier ones are refused (`require_patchable`).
"""

from __future__ import annotations

import operator
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from functools import partial, reduce
from typing import TYPE_CHECKING, Any

import numpy as np

from traps_pipeline.base.errors import TrapsError
from traps_pipeline.mechanism.hook import Site
from traps_pipeline.mechanism.margin import first_token_margins
from traps_pipeline.models.local.capture import first_tensor
from traps_pipeline.models.local.sidepaths import (
    CACHE_NAMES,
    PER_LAYER,
    SHARED_KEYS,
    argument_of,
    unknown_side_path,
    with_argument,
)
from traps_pipeline.models.local.spans import visual_tokens

if TYPE_CHECKING:
    from torch import Tensor
    from torch.nn import Module

    from traps_pipeline.models.local.adapter import LocalModel, Prompt

SITES: tuple[Site, ...] = ("residual", "attention", "mlp")
ROWS, TOKENS = 64, 2**14  # maximum number of patches in one pass; fewer for long prompts


@dataclass(frozen=True, eq=False)
class Patch:
    """A replacement of states at a site and layer. positions: (T,) bool, the tokens whose states are replaced."""

    site: Site
    layer: int
    positions: np.ndarray


@dataclass(frozen=True, eq=False)
class RecordedPass:
    """A pass with the recorded states of its decoder, to patch from or into.

    inputs: the decoder's arguments, after the vision tower. states: by site and layer, (T, d); always the residual
    stream, other sites on request. margin: the outcome. pictures: which tokens are visual, (T,) bool. per_layer: each
    block's per-token input vector, (T, width), empty for a model without it. shared: by name, the layer whose keys and
    values later blocks read, and these, (1, heads, T, width).
    """

    inputs: Mapping[str, Any]
    states: Mapping[tuple[Site, int], Tensor]
    margin: float
    pictures: np.ndarray
    per_layer: Sequence[Tensor] = ()
    shared: Mapping[str, tuple[int, Tensor, Tensor]] = field(default_factory=dict)

    @property
    def length(self) -> int:
        """The number of tokens of the prompt."""
        return int(self.inputs["inputs_embeds"].shape[1])

    @property
    def visual(self) -> np.ndarray | None:
        """Positions of deepstack features, (T,) bool; None for a model without any."""
        mask = self.inputs.get("visual_pos_masks")
        return None if mask is None else mask[0].cpu().numpy()


def require_patchable(model: LocalModel) -> None:
    """Raise TrapsError if later blocks read more of earlier ones than is replaced."""
    unknown = unknown_side_path(model.network.config.get_text_config(), model.blocks[0])
    if unknown:
        raise TrapsError(
            f"{model.checkpoint.name}: {unknown}, which patching does not replace, so that its effects would be too "
            "small; set `patching: null` in the experiment and in study.yaml"
        )


def _sites(model: LocalModel) -> Iterator[tuple[Site, int, Module]]:
    for layer, block in enumerate(model.blocks, start=1):
        yield "residual", layer, block
        # Behind the norm of a block that has one there, what experts make beside its `mlp` is in it too (Gemma 4's
        # large checkpoints); without experts, replacing before or behind a norm of single positions is the same.
        feedforward = "post_feedforward_layernorm" if hasattr(block, "post_feedforward_layernorm") else "mlp"
        parts: tuple[tuple[Site, str], ...] = (("attention", "self_attn"), ("mlp", feedforward))
        for site, name in parts:
            part = getattr(block, name, None)
            if part is None:
                raise TrapsError(
                    f"{model.checkpoint.name}: its blocks have no `{name}`, so the {site} cannot be patched there"
                )
            yield site, layer, part


def trace_pass(model: LocalModel, prompt: Prompt, tokens: Sequence[int], sites: Sequence[Site] = SITES) -> RecordedPass:
    """Run one pass and return its record: states of `sites` and of the residual stream.

    tokens: those that begin an abstention. Raises TrapsError for a block that passes on more than the residual stream.
    """
    import torch

    inputs: dict[str, Any] = {}
    states: dict[tuple[Site, int], Tensor] = {}
    per_layer: list[Tensor] = []
    shared_keys: dict[str, tuple[int, Tensor, Tensor]] = {}

    def keep_inputs(_: Module, __: Any, kwargs: dict[str, Any]) -> None:
        inputs.update(kwargs)

    def keep(site: Site, layer: int, module: Module, __: Any, output: Any) -> None:
        if site == "residual" and not torch.is_tensor(output):
            raise TrapsError(
                f"{model.checkpoint.name}: {type(module).__name__} returns more than the residual stream, so no pass "
                "can begin behind it; set `patching: null` in the experiment and in study.yaml"
            )
        states[site, layer] = first_tensor(output)[0].clone()

    def keep_own(block: Module, args: tuple[Any, ...], kwargs: dict[str, Any]) -> None:
        layer_input = argument_of(block, PER_LAYER, args, kwargs)
        if layer_input is not None:
            per_layer.append(layer_input[0])

    def keep_shared(layer: int, block: Module, args: tuple[Any, ...], kwargs: dict[str, Any], _: Any) -> None:
        for name, (keys, values) in (argument_of(block, SHARED_KEYS, args, kwargs) or {}).items():
            if name not in shared_keys or shared_keys[name][1] is not keys:
                shared_keys[name] = layer, keys, values

    with ExitStack() as hooks, torch.inference_mode():
        decoder = model.network.get_decoder()
        hooks.callback(decoder.register_forward_pre_hook(keep_inputs, with_kwargs=True).remove)
        for site, layer, module in _sites(model):
            if site == "residual" or site in sites:
                hooks.callback(module.register_forward_hook(partial(keep, site, layer)).remove)
        for layer, block in enumerate(model.blocks, start=1):
            hooks.callback(block.register_forward_pre_hook(keep_own, with_kwargs=True).remove)
            hooks.callback(block.register_forward_hook(partial(keep_shared, layer), with_kwargs=True).remove)
        hooks.enter_context(model.caching_clips())
        last = model.forward(prompt).last_hidden_state[:, -1]
        states["residual", 0] = inputs["inputs_embeds"][0].clone()
        margin = float(first_token_margins(model, last, tokens)[0])
        return RecordedPass(inputs, states, margin, visual_tokens(model, prompt), tuple(per_layer), shared_keys)


def patched_changes(
    model: LocalModel, target: RecordedPass, source: RecordedPass, patches: Sequence[Patch], tokens: Sequence[int]
) -> np.ndarray:
    """Return by how much each patch changes the target's outcome, (patches,), measured.

    Patches at one block share passes that begin there; the vision tower is not run again. Every pass has one row
    without a patch, and changes are relative to that row, so that rounding by the size of a batch does not count; what
    several threads do to the rounding of one row does. Raises TrapsError if the two prompts have different numbers of
    tokens, or different visual positions.
    """
    import torch

    _require_one_form(target, source)
    changes, rows = np.empty(len(patches)), max(1, min(ROWS, TOKENS // target.length))
    numbers_by_start: dict[int, list[int]] = {}
    for number, patch in enumerate(patches):
        numbers_by_start.setdefault(_first_layer(model, patch), []).append(number)
    for start, same_start in numbers_by_start.items():
        for numbers in (same_start[k : k + rows] for k in range(0, len(same_start), rows)):
            weights = _masks([patches[i] for i in numbers], target.length, model.inputs_device)
            with torch.inference_mode():
                margins = _margins(model, target, source, weights, start, 1 + len(numbers), tokens)
            changes[numbers] = (margins[1:] - margins[0]).double().numpy()
    return changes


def attributed_changes(
    model: LocalModel, target: RecordedPass, source: RecordedPass, tokens: Sequence[int]
) -> dict[tuple[Site, int], np.ndarray]:
    """Return by how much a patch of each token would change the outcome, (T,) by site and layer, estimated.

    One pass with gradients gives all of them, to first order; the estimate of a group of positions is its sum. Raises
    TrapsError as `patched_changes`.
    """
    import torch

    _require_one_form(target, source)
    dtype = model.network.dtype
    shares = {
        key: torch.zeros(1, target.length, device=states.device, dtype=dtype, requires_grad=True)
        for key, states in source.states.items()
    }
    with torch.enable_grad():
        (margin,) = _margins(model, target, source, shares, 0, 1, tokens)
        slopes = torch.autograd.grad(margin, [*shares.values()])
    return {key: slope[0].double().cpu().numpy() for key, slope in zip(shares, slopes, strict=True)}


# --- one pass ---------------------------------------------------------------------------------------------------------

# By site and layer, (rows, T): how much of each token's state is the source's. bool: all of it or nothing; else that
# share of the difference is added, so that the gradient at zeros is what `attributed_changes` asks for.
Weights = Mapping[tuple[Site, int], "Tensor"]


def _require_one_form(target: RecordedPass, source: RecordedPass) -> None:
    if not np.array_equal(target.pictures, source.pictures):
        raise TrapsError(
            f"a prompt of {source.length} tokens cannot be patched into one of {target.length}, or their visual tokens "
            "stand at other places; patch between prompts of one form"
        )


def _first_layer(model: LocalModel, patch: Patch) -> int:
    """Return the layer a patched pass starts from. Raises TrapsError for a wrong site."""
    if not 0 <= patch.layer <= model.n_layers or (patch.layer == 0 and patch.site != "residual"):
        raise TrapsError(f"no {patch.site} at layer {patch.layer}; there are blocks 1 to {model.n_layers}")
    return patch.layer if patch.site == "residual" else patch.layer - 1


def _masks(patches: Sequence[Patch], length: int, device: str) -> Weights:
    """Return the weights of a pass: one row without a patch, then one row per patch."""
    import torch

    masks: dict[tuple[Site, int], Tensor] = {}
    for row, patch in enumerate(patches, start=1):
        empty_mask = torch.zeros(len(patches) + 1, length, dtype=torch.bool)
        masks.setdefault((patch.site, patch.layer), empty_mask)[row] = torch.from_numpy(patch.positions)
    return {key: mask.to(device) for key, mask in masks.items()}


def _residual_weights(weights: Weights, layer: int) -> Tensor | None:
    """Return the weights of residual patches up to a layer. They affect all later layers."""
    parts = [part for (site, patch_layer), part in weights.items() if site == "residual" and patch_layer <= layer]
    return reduce(operator.add, [part.to(parts[0].device) for part in parts]) if parts else None


def _mix(states: Tensor, source: Tensor, weights: Tensor) -> Tensor:
    """Return states (rows, .., T, d), mixed with theirs, (T, d) or (1, .., T, d)."""
    import torch

    weights = weights.reshape(len(weights), *[1] * (states.ndim - 3), -1, 1).to(states.device)
    source = source.to(states.device)
    return torch.where(weights, source, states) if weights.dtype == torch.bool else states + weights * (source - states)


def _margins(
    model: LocalModel,
    target: RecordedPass,
    source: RecordedPass,
    weights: Weights,
    start: int,
    rows: int,
    tokens: Sequence[int],
) -> Tensor:
    """Return outcomes (rows,) of a pass over copies of the target from layer `start`."""
    inputs = _repeat_inputs(target, rows)
    if ("residual", 0) in weights:
        inputs["inputs_embeds"] = _mix(inputs["inputs_embeds"], source.states["residual", 0], weights["residual", 0])
    for number, source_embeds in enumerate(source.inputs.get("deepstack_visual_embeds") or ()):
        # Features number k are added to what block k + 1 puts out: behind the sites up to there.
        weight, features = _residual_weights(weights, number + 1), inputs["deepstack_visual_embeds"]
        if weight is not None and target.visual is not None:
            row_features = features[number].unflatten(0, (rows, -1))
            features[number] = _mix(row_features, source_embeds, weight[:, target.visual]).flatten(0, 1)
    with _replace_states(model, target, source, weights, start, rows):
        last = model.network.get_decoder()(**inputs).last_hidden_state[:, -1]
    return first_token_margins(model, last, tokens)


def _repeat_inputs(target: RecordedPass, rows: int) -> dict[str, Any]:
    """Return the decoder's inputs for several rows of one prompt."""
    import torch

    length, inputs = target.length, dict(target.inputs)
    for name, value in target.inputs.items():
        if name == "deepstack_visual_embeds" and value is not None:
            inputs[name] = [features.repeat(rows, 1) for features in value]
        elif torch.is_tensor(value) and value.ndim >= 2:
            axis = 0 if value.shape[0] == 1 else 1  # positions of several kinds have an axis before that of the rows
            if value.shape[axis] == 1 and length in value.shape:
                inputs[name] = value.repeat_interleave(rows, dim=axis)
    return inputs | {"use_cache": False} | dict.fromkeys({*CACHE_NAMES} & {*inputs})


@contextmanager
def _replace_states(
    model: LocalModel, target: RecordedPass, source: RecordedPass, weights: Weights, start: int, rows: int
) -> Iterator[None]:
    """Let passes start behind block `start`, replacing states, inside the context."""

    def replace(site: Site, layer: int, _: Module, __: Any, output: Any) -> Any:
        states = _mix(first_tensor(output), source.states[site, layer], weights[site, layer])
        return (states, *output[1:]) if isinstance(output, tuple) else states

    def skip(layer: int, hidden_states: Tensor, *_: Any, **__: Any) -> Tensor:
        return target.states["residual", layer].expand(rows, -1, -1) if layer == start else hidden_states

    def beside(below: int, block: Module, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
        """Return the next block's arguments, the source's where the stream was patched."""
        own_forward, weight = argument_of(block, PER_LAYER, args, kwargs), _residual_weights(weights, below)
        if own_forward is not None and weight is not None:
            args, kwargs = with_argument(
                block, PER_LAYER, _mix(own_forward, source.per_layer[below], weight), args, kwargs
            )
        shared_keys = argument_of(block, SHARED_KEYS, args, kwargs)  # one mapping, shared by all blocks
        if shared_keys is not None and below == start:
            for name, (maker, *pair) in target.shared.items():
                if maker <= start:
                    shared_keys[name] = tuple(part.expand(rows, *part.shape[1:]) for part in pair)
        if shared_keys and ("residual", below) in weights:
            residual_weight = weights["residual", below]
            for name, pair in [*shared_keys.items()]:
                shared_keys[name] = tuple(
                    _mix(*tensor_pair, residual_weight)
                    for tensor_pair in zip(pair, source.shared[name][1:], strict=True)
                )
        return args, kwargs

    blocks = [*model.blocks]
    with ExitStack() as hooks:
        for site, layer, module in _sites(model):
            if (site, layer) in weights:
                hooks.callback(module.register_forward_hook(partial(replace, site, layer)).remove)
        for below, block in enumerate(blocks[start:], start=start):
            hooks.callback(block.register_forward_pre_hook(partial(beside, below), with_kwargs=True).remove)
        for layer, block in enumerate(blocks[:start], start=1):
            own_forward = vars(block).get("forward")  # set by accelerate on a model that is spread over devices
            block.forward = partial(skip, layer)
            hooks.callback(
                partial(vars(block).pop, "forward")
                if own_forward is None
                else partial(setattr, block, "forward", own_forward)
            )
        yield
