"""Steer: add alpha times a direction to a block's output (docs/spec.md 8.1).

    with Steering(direction, layer=20, alphas=(5.0, -5.0)).applied(model): ...

The state at that layer becomes state + alpha v at every position of the prompt and of the generated answer.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Literal, get_args

import numpy as np

from traps_pipeline.base.errors import TrapsError
from traps_pipeline.models.local.capture import first_tensor

if TYPE_CHECKING:
    from torch import Tensor
    from torch.nn import Module
    from torch.utils.hooks import RemovableHandle

    from traps_pipeline.models.local.adapter import LocalModel

# Where in a block: the residual stream as it leaves the block, or the output of its attention or MLP.
Site = Literal["residual", "attention", "mlp"]
_PARTS: dict[Site, str] = {"attention": "self_attn", "mlp": "mlp"}


def register_change(block: Module, site: Site, change: Callable[[Tensor], Tensor]) -> RemovableHandle:
    """Register a hook that replaces a site's states (rows, T, d) by `change` of them.

    It runs before all others, so that hooks that record states record the changed ones. Raises TrapsError for a block
    without such a part.
    """

    if site != "residual" and site not in _PARTS:
        raise TrapsError(f"no site {site!r}; states can be changed at {', '.join(get_args(Site))}")

    def hook(_: Module, __: Any, output: Any) -> Any:
        new_states = change(first_tensor(output))
        return (new_states, *output[1:]) if isinstance(output, tuple) else new_states

    part = block if site == "residual" else getattr(block, _PARTS[site], None)
    if part is None:
        raise TrapsError(f"this model's blocks have no `{_PARTS[site]}`, so nothing can be changed at its {site}")
    return part.register_forward_hook(hook, prepend=True)


@dataclass(frozen=True, eq=False)
class Steering:
    """A direction to be added to a layer's output, and its strength for each row of a batch.

    direction: (d_model,) float32 for all rows, or (rows, d_model) with one per row; used without scaling (void
    directions are unit vectors). layer: counted as in hidden_states, 1 to n_layers. alphas: one per row, signed.
    """

    direction: np.ndarray
    layer: int
    alphas: tuple[float, ...]

    def rows(self, chosen: Sequence[int]) -> Steering:
        """Return the steering of the selected rows of the batch."""
        direction = self.direction if self.direction.ndim == 1 else self.direction[list(chosen)]
        return replace(self, direction=direction, alphas=tuple(self.alphas[i] for i in chosen))

    @contextmanager
    def applied(self, model: LocalModel) -> Iterator[None]:
        """Steer the model's passes within the block.

        If every alpha is 0 there is no hook, and outputs equal the unsteered model's bit for bit. Raises TrapsError for
        a layer that the model lacks, and for a direction of another width or with values that are not finite.
        """
        import torch

        block = model.block(self.layer)
        shapes = ((model.d_model,), (len(self.alphas), model.d_model))
        if self.direction.shape not in shapes or not np.isfinite(self.direction).all():
            raise TrapsError(
                f"the direction has shape {self.direction.shape} {'and' if self.direction.shape else ''} for "
                f"{model.checkpoint.name}, whose states are {model.d_model} finite numbers: extract it from this model"
            )
        if not any(self.alphas):
            yield
            return
        direction = torch.from_numpy(np.ascontiguousarray(self.direction, dtype=np.float32))
        shift = torch.tensor(self.alphas, dtype=torch.float32)[:, None] * direction  # (rows, d), in float32 until here
        shift = shift[:, None, :].to(model.inputs_device, model.network.dtype)

        def add(states: Tensor) -> Tensor:
            if len(states) != len(shift):
                raise ValueError(f"the pass has {len(states)} rows, but {len(shift)} alphas were given")
            return states + shift.to(states.device)

        handle = register_change(block, "residual", add)
        try:
            yield
        finally:
            handle.remove()
