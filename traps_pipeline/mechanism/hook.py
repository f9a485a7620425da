"""The steering hook: alpha times a direction, added to the output of one block (docs/spec.md 8.1).

    with Steering(direction, layer=20, alphas=(5.0, -5.0)).applied(model): ...

The state at that layer becomes state + alpha v at every position of the prompt and of the generated answer, or at those
of the prompt that masks choose; and so does the output of attention, of one head or of MLP, where a site is given.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from traps_pipeline.base.errors import TrapsError
from traps_pipeline.mechanism.sites import Site, changing, check_head, into_head

if TYPE_CHECKING:
    from torch import Tensor

    from traps_pipeline.models.local.adapter import LocalModel


@dataclass(frozen=True, eq=False)
class Steering:
    """A direction at a layer, and its strength for each row of a batch.

    direction: (d_model,) float32 for all rows, or (rows, d_model) with one of its own for each; used without scaling
    (void directions are unit vectors). layer: counted as in hidden_states, 1 to n_layers. alphas: one per row, signed.
    removed: one per row, the share of a state's part along the direction that is taken out before alpha times the
    direction is added; empty where nothing is taken out.

    site, head: what of the block is changed (`sites`); at a head the direction is replaced by the head's own unit
    direction that writes the most along it. masks: one per row, (T,) bool, the tokens of its prompt that are changed,
    and then nothing that is generated is; empty where every position is changed.
    """

    direction: np.ndarray
    layer: int
    alphas: tuple[float, ...]
    removed: tuple[float, ...] = ()
    site: Site = "residual"
    head: int | None = None
    masks: tuple[np.ndarray, ...] = ()

    @property
    def resumes_at(self) -> int:
        """The last block up to which passes are as they would be without steering, but for the change of that block's
        own output; 0 if there is none."""
        return self.layer if self.site == "residual" else self.layer - 1

    def rows(self, chosen: Sequence[int]) -> Steering:
        """The steering of some of the rows."""
        direction = self.direction if self.direction.ndim == 1 else self.direction[list(chosen)]
        removed = tuple(self.removed[i] for i in chosen) if self.removed else ()
        masks = tuple(self.masks[i] for i in chosen) if self.masks else ()
        return replace(
            self, direction=direction, alphas=tuple(self.alphas[i] for i in chosen), removed=removed, masks=masks
        )

    def begun(self, chosen: Sequence[int]) -> Steering:
        """The steering of some of the rows behind their prompts, where masks choose nothing."""
        still = self.rows(chosen)
        nothing = (0.0,) * len(chosen)
        return replace(still, alphas=nothing, removed=(), masks=()) if self.masks else still

    @contextmanager
    def applied(self, model: LocalModel) -> Iterator[None]:
        """Steer the passes that are made inside the context; the hook is always removed at its end.

        Where every alpha is 0 and nothing is taken out there is no hook, and outputs equal the unsteered model's bit
        for bit. Raises TrapsError for a layer, site or head that the model lacks, and for a direction of another width
        or with values that are not finite.
        """
        block = model.block(self.layer)
        shapes = ((model.d_model,), (len(self.alphas), model.d_model))
        if self.direction.shape not in shapes or not np.isfinite(self.direction).all():
            raise TrapsError(
                f"the direction has shape {self.direction.shape} {'and' if self.direction.shape else ''} for "
                f"{model.checkpoint.name}, whose states are {model.d_model} finite numbers: extract it from this model"
            )
        check_head(self.site, self.head)
        n_heads = int(model.network.config.get_text_config().num_attention_heads)
        if not any((*self.alphas, *self.removed)):
            yield
            return
        acting = self
        if self.head is not None:
            acting = replace(self, direction=into_head(block, self.head, n_heads, self.direction))
        handle = changing(block, self.site, self.head, n_heads, _Adding(acting, model))
        try:
            yield
        finally:
            handle.remove()


class _Adding:
    """The change of states. The added vector is computed once in float32, then cast to the precision of the states."""

    def __init__(self, steering: Steering, model: LocalModel) -> None:
        import torch

        alphas = torch.tensor(steering.alphas, dtype=torch.float32)
        direction = torch.from_numpy(np.ascontiguousarray(steering.direction, dtype=np.float32))
        added = alphas[:, None] * direction  # (rows, d), for a shared direction too
        self._added = added[:, None, :].to(model.device, model.network.dtype)
        self._along, self._removed = None, None
        if any(steering.removed):
            unit = direction / torch.linalg.vector_norm(direction, dim=-1, keepdim=True)
            self._along = unit.expand(len(alphas), -1).to(model.device)
            self._removed = torch.tensor(steering.removed, dtype=torch.float32, device=model.device)
        self._first = True  # the first pass is that over the prompts
        self._chosen = _padded(steering.masks).to(model.device) if steering.masks else None

    def __call__(self, states: Tensor) -> Tensor:
        import torch

        if len(states) != len(self._added):
            raise ValueError(f"the pass has {len(states)} rows, but {len(self._added)} alphas were given")
        if self._along is None or self._removed is None:
            steered = states + self._added
        else:  # in float32, as the added vector is made
            part = torch.einsum("rtd,rd->rt", states.float(), self._along) * self._removed[:, None]
            taken = (part[..., None] * self._along[:, None, :]).to(states.dtype)
            steered = states - taken + self._added
        if self._chosen is None:
            return steered
        length, first, self._first = states.shape[1], self._first, False
        if length == 1 and not first:  # what is generated
            return states
        # Upper blocks of some models (Gemma 4) read the prompt's last token alone; without a cache, what is generated
        # stands behind the prompt.
        chosen = torch.nn.functional.pad(self._chosen, (0, max(0, length - self._chosen.shape[1])))[:, -length:]
        return torch.where(chosen[..., None], steered, states)


def _padded(masks: Sequence[np.ndarray]) -> Tensor:
    """Masks as one batch (rows, T), padded on the left as prompts are."""
    import torch

    width = max(len(mask) for mask in masks)
    return torch.from_numpy(np.stack([np.pad(mask, (width - len(mask), 0)) for mask in masks]))
