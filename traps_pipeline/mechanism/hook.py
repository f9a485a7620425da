"""The steering hook: alpha times a direction, added to the output of one block (docs/spec.md 8.1).

    with Steering(direction, layer=20, alphas=(5.0, -5.0)).applied(model): ...

The state at that layer becomes state + alpha v at every position of the prompt and of the generated answer.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from traps_pipeline.errors import TrapsError

if TYPE_CHECKING:
    from traps_pipeline.models.local.adapter import LocalModel


@dataclass(frozen=True, eq=False)
class Steering:
    """A direction at a layer, and its strength for each row of a batch.

    direction: (d_model,) float32 for all rows, or (rows, d_model) with one of its own for each; used without scaling
    (void directions are unit vectors). layer: counted as in hidden_states, 1 to n_layers. alphas: one per row, signed.
    removed: one per row, the share of a state's part along the direction that is taken out before alpha times the
    direction is added; empty where nothing is taken out.
    """

    direction: np.ndarray
    layer: int
    alphas: tuple[float, ...]
    removed: tuple[float, ...] = ()

    def rows(self, chosen: Sequence[int]) -> Steering:
        """The steering of some of the rows."""
        direction = self.direction if self.direction.ndim == 1 else self.direction[list(chosen)]
        removed = tuple(self.removed[i] for i in chosen) if self.removed else ()
        return Steering(direction, self.layer, tuple(self.alphas[i] for i in chosen), removed)

    @contextmanager
    def applied(self, model: LocalModel) -> Iterator[None]:
        """Steer the passes that are made inside the context; the hook is always removed at its end.

        Where every alpha is 0 and nothing is taken out there is no hook, and outputs equal the unsteered model's bit
        for bit. Raises TrapsError for a layer out of range, and for a direction of another width or with values that
        are not finite.
        """
        block = model.block(self.layer)
        shapes = ((model.d_model,), (len(self.alphas), model.d_model))
        if self.direction.shape not in shapes or not np.isfinite(self.direction).all():
            raise TrapsError(
                f"the direction has shape {self.direction.shape} {'and' if self.direction.shape else ''} for "
                f"{model.checkpoint.name}, whose states are {model.d_model} finite numbers: extract it from this model"
            )
        if not any((*self.alphas, *self.removed)):
            yield
            return
        # This hook runs first, so that hooks that record states (ours, and the library's own) record the steered ones.
        handle = block.register_forward_hook(_Adding(self, model), prepend=True)
        try:
            yield
        finally:
            handle.remove()


class _Adding:
    """The forward hook. The added vector is computed once in float32, then cast to the precision of the states."""

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

    def __call__(self, _: Any, __: Any, output: Any) -> Any:
        import torch

        states = output[0] if isinstance(output, tuple) else output
        if len(states) != len(self._added):
            raise ValueError(f"the pass has {len(states)} rows, but {len(self._added)} alphas were given")
        if self._along is None or self._removed is None:
            steered = states + self._added
        else:  # in float32, as the added vector is made
            part = torch.einsum("rtd,rd->rt", states.float(), self._along) * self._removed[:, None]
            taken = (part[..., None] * self._along[:, None, :]).to(states.dtype)
            steered = states - taken + self._added
        return (steered, *output[1:]) if isinstance(output, tuple) else steered
