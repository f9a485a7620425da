"""Activation patching: what a model answers when a part of one pass is replaced by that part of another.

A pass over a target prompt (say, a control) is made again with the states of a source prompt (its void) at some
positions of one site: the residual stream as it leaves block l (0: the embeddings), or the output of a block's
attention or MLP. The outcome is the log-odds that the answer begins by abstaining (`margin`), and the indirect effect
is the share of the way from the target's outcome to the source's: 0 if nothing changed, 1 if it is the source's.

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

from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from functools import partial
from itertools import product
from typing import TYPE_CHECKING, Any

import numpy as np

from traps_pipeline.base.errors import TrapsError
from traps_pipeline.mechanism.margin import first_token_margins
from traps_pipeline.mechanism.sites import Site
from traps_pipeline.models.local.capture import first_tensor
from traps_pipeline.models.local.sidepaths import PER_LAYER, SHARED, given, giving, unknown_path
from traps_pipeline.models.local.spans import visual_tokens

if TYPE_CHECKING:
    from torch import Tensor
    from torch.nn import Module

    from traps_pipeline.models.local.adapter import LocalModel, Prompt

SITES: tuple[Site, ...] = ("residual", "attention", "mlp")
ROWS = 64  # patches in one pass


@dataclass(frozen=True, eq=False)
class Patch:
    """One patch. positions: (T,) bool, the tokens whose states are replaced."""

    site: Site
    layer: int
    positions: np.ndarray


@dataclass(frozen=True, eq=False)
class Recorded:
    """The decoder's part of a pass. inputs: what the decoder was called with, after the vision tower. states: by site
    and layer, (T, d). margin: the outcome. pictures: which tokens are visual, (T,) bool. per_layer: what each block was
    given of the token's own, (T, width), empty for a model without that. shared: by name, the keys and values (heads,
    T, width) that blocks read of an earlier one."""

    inputs: Mapping[str, Any]
    states: Mapping[tuple[Site, int], Tensor]
    margin: float
    pictures: np.ndarray
    per_layer: Sequence[Tensor] = ()
    shared: Mapping[str, tuple[Tensor, Tensor]] = field(default_factory=dict)

    @property
    def length(self) -> int:
        """Tokens."""
        return int(self.inputs["inputs_embeds"].shape[1])

    @property
    def visual(self) -> np.ndarray | None:
        """Where deepstack features are added, (T,) bool; None for a model that has none."""
        mask = self.inputs.get("visual_pos_masks")
        return None if mask is None else mask[0].cpu().numpy()


def require_patchable(model: LocalModel) -> None:
    """Raises TrapsError for a model whose later blocks read more of earlier ones than is replaced here."""
    unknown = unknown_path(model.network.config.get_text_config(), model.blocks[0])
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


def record(model: LocalModel, prompt: Prompt, tokens: Sequence[int]) -> Recorded:
    """One pass with everything that a patch may take from it. tokens: those that begin an abstention."""
    import torch

    inputs: dict[str, Any] = {}
    states: dict[tuple[Site, int], Tensor] = {}
    per_layer: list[Tensor] = []
    shared: dict[str, tuple[Tensor, Tensor]] = {}

    def keep_inputs(_: Module, __: Any, kwargs: dict[str, Any]) -> None:
        inputs.update(kwargs)

    def keep(site: Site, layer: int, _: Module, __: Any, output: Any) -> None:
        states[site, layer] = first_tensor(output)[0].clone()

    def keep_own(block: Module, args: tuple[Any, ...], kwargs: dict[str, Any]) -> None:
        own = given(block, PER_LAYER, args, kwargs)
        if own is not None:
            per_layer.append(own[0])

    def keep_shared(block: Module, args: tuple[Any, ...], kwargs: dict[str, Any], _: Any) -> None:
        for name, (keys, values) in (given(block, SHARED, args, kwargs) or {}).items():
            shared[name] = keys[0], values[0]

    with ExitStack() as hooks, torch.inference_mode():
        decoder = model.network.get_decoder()
        hooks.callback(decoder.register_forward_pre_hook(keep_inputs, with_kwargs=True).remove)
        for site, layer, module in _sites(model):
            hooks.callback(module.register_forward_hook(partial(keep, site, layer)).remove)
        for block in model.blocks:
            hooks.callback(block.register_forward_pre_hook(keep_own, with_kwargs=True).remove)
        hooks.callback(model.blocks[-1].register_forward_hook(keep_shared, with_kwargs=True).remove)
        hooks.enter_context(model.remembering_clips())
        last = model.forward(prompt).last_hidden_state[:, -1]
        states["residual", 0] = inputs["inputs_embeds"][0].clone()
        margin = float(first_token_margins(model, last, tokens)[0])
        return Recorded(inputs, states, margin, visual_tokens(model, prompt), tuple(per_layer), shared)


def patched_changes(
    model: LocalModel, target: Recorded, source: Recorded, patches: Sequence[Patch], tokens: Sequence[int]
) -> np.ndarray:
    """The change of the target's outcome by each patch from the source, (patches,). The vision tower is not run again.

    Every pass has one row without a patch, and changes are against that row: a patch that replaces states by equal ones
    changes nothing, bit for bit, whatever the size of the batch does to rounding. Raises TrapsError when the two
    prompts have another number of tokens, or other visual positions.
    """
    if not np.array_equal(target.pictures, source.pictures):
        raise TrapsError(
            f"a prompt of {source.length} tokens cannot be patched into one of {target.length}, or their visual tokens "
            "stand at other places; patch between prompts of one form"
        )
    changes = [_one_pass(model, target, source, patches[k : k + ROWS], tokens) for k in range(0, len(patches), ROWS)]
    return np.concatenate(changes) if changes else np.empty(0)


def _one_pass(
    model: LocalModel, target: Recorded, source: Recorded, patches: Sequence[Patch], tokens: Sequence[int]
) -> np.ndarray:
    import torch

    patches = [Patch("residual", 0, np.zeros(target.length, bool)), *patches]
    with torch.inference_mode(), _patching(model, source, patches):
        inputs = _repeated(target, len(patches))
        _patch_inputs(inputs, target, source, patches)
        last = model.network.get_decoder()(**inputs).last_hidden_state[:, -1]
        margins = first_token_margins(model, last, tokens).double().numpy()
    return margins[1:] - margins[0]


def _repeated(target: Recorded, rows: int) -> dict[str, Any]:
    """The decoder's inputs for so many rows of one prompt."""
    import torch

    length, inputs = target.length, dict(target.inputs)
    for name, value in target.inputs.items():
        if name == "deepstack_visual_embeds" and value is not None:
            inputs[name] = [features.repeat(rows, 1) for features in value]
        elif torch.is_tensor(value) and value.ndim >= 2:
            axis = 0 if value.shape[0] == 1 else 1  # positions of several kinds have an axis before that of the rows
            if value.shape[axis] == 1 and length in value.shape:
                inputs[name] = value.repeat_interleave(rows, dim=axis)
    return inputs | {"use_cache": False, "past_key_values": None}


def _patch_inputs(inputs: dict[str, Any], target: Recorded, source: Recorded, patches: Sequence[Patch]) -> None:
    """Embeddings and deepstack features of the rows with a residual patch."""
    import torch

    features, theirs = (of.inputs.get("deepstack_visual_embeds") for of in (target, source))
    for row, patch in enumerate(patches):
        if patch.site != "residual":
            continue
        chosen = torch.from_numpy(patch.positions).to(inputs["inputs_embeds"].device)
        if patch.layer == 0:
            inputs["inputs_embeds"][row, chosen] = source.states["residual", 0][chosen]
        if features is None or theirs is None or target.visual is None:
            continue
        visual = torch.from_numpy(np.flatnonzero(patch.positions[target.visual])).to(chosen.device)
        # Features number k are added to what block k + 1 puts out: behind the site where that is block l or later.
        for number in range(max(0, patch.layer - 1), len(features)):
            start = row * len(features[number])
            inputs["deepstack_visual_embeds"][number][start + visual] = theirs[number][visual]


@contextmanager
def _patching(model: LocalModel, source: Recorded, patches: Sequence[Patch]) -> Iterator[None]:
    """Hooks that replace the outputs of sites; they are removed at the end, whatever happens."""
    import torch

    by_site: dict[tuple[Site, int], list[tuple[int, Any]]] = {}
    for row, patch in enumerate(patches):
        if not 0 <= patch.layer <= model.n_layers or (patch.layer == 0 and patch.site != "residual"):
            raise TrapsError(f"no {patch.site} at layer {patch.layer}; there are blocks 1 to {model.n_layers}")
        if patch.layer:
            by_site.setdefault((patch.site, patch.layer), []).append((row, torch.from_numpy(patch.positions)))

    def replace(site: Site, layer: int, _: Module, __: Any, output: Any) -> Any:
        states = first_tensor(output).clone()
        for row, chosen in by_site[site, layer]:
            states[row, chosen.to(states.device)] = source.states[site, layer][chosen.to(states.device)]
        return (states, *output[1:]) if isinstance(output, tuple) else states

    residual = [(row, patch) for row, patch in enumerate(patches) if patch.site == "residual"]
    with ExitStack() as hooks:
        for site, layer, module in _sites(model):
            if (site, layer) in by_site:
                hooks.callback(module.register_forward_hook(partial(replace, site, layer)).remove)
        for below, block in enumerate(model.blocks):
            beside = partial(_patch_arguments, source, residual, below)
            hooks.callback(block.register_forward_pre_hook(beside, with_kwargs=True).remove)
        yield


def _patch_arguments(
    source: Recorded,
    residual: Sequence[tuple[int, Patch]],
    below: int,
    block: Module,
    args: tuple[Any, ...],
    kwargs: dict[str, Any],
) -> tuple[tuple[Any, ...], dict[str, Any]]:
    """The arguments of the block above `below` others, with the source's own where the residual stream was patched."""
    own = given(block, PER_LAYER, args, kwargs)
    if own is not None:
        own = own.clone()
        for row, patch in residual:
            if patch.layer <= below:
                _put(own[row], source.per_layer[below], patch)
        args, kwargs = giving(block, PER_LAYER, own, args, kwargs)
    # What is shared so far was made by the blocks below, and this block is the first one behind these patches. All that
    # follow are given the same mapping.
    shared = given(block, SHARED, args, kwargs)
    here = [(row, patch) for row, patch in residual if patch.layer == below]
    for name, pair in [*shared.items()] if shared and here else ():
        made = tuple(part.clone() for part in pair)
        for (row, patch), (part, theirs) in product(here, zip(made, source.shared[name], strict=True)):
            _put(part[row].transpose(0, 1), theirs.transpose(0, 1), patch)
        shared[name] = made
    return args, kwargs


def _put(states: Tensor, theirs: Tensor, patch: Patch) -> None:
    """Replace (T, ...) by theirs where a patch says."""
    import torch

    chosen = torch.from_numpy(patch.positions).to(states.device)
    states[chosen] = theirs[chosen]
