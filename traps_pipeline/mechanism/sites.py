"""Where in a block a direction acts: the residual stream as it leaves the block, the output of its attention or MLP, or
one attention head, which is a slice of what the output projection reads."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from traps_pipeline.base.errors import TrapsError
from traps_pipeline.models.local.capture import first_tensor

if TYPE_CHECKING:
    from torch import Tensor
    from torch.nn import Module
    from torch.utils.hooks import RemovableHandle

Site = Literal["residual", "attention", "mlp"]
_PARTS: dict[Site, str] = {"attention": "self_attn", "mlp": "mlp"}


def check_head(site: Site, head: int | None) -> None:
    """Raises TrapsError for a head at a site other than attention."""
    if head is not None and site != "attention":
        raise TrapsError(f"head {head} is one of a block's attention, not of its {site}; give site attention")


def changing(
    block: Module, site: Site, head: int | None, n_heads: int, change: Callable[[Tensor], Tensor]
) -> RemovableHandle:
    """A hook that puts `change` of the states in their place, (rows, T, d), or (rows, T, hd) of one head, counted from
    0. It runs before all others, so that hooks that record states record the changed ones.

    Raises TrapsError for a block without such a part or head.
    """
    check_head(site, head)
    if head is not None:
        projection, mine = _projection(block), head_slice(block, head, n_heads)

        def one_head(_: Module, args: tuple[Any, ...]) -> tuple[Any, ...]:
            changed = args[0].clone()
            changed[..., mine] = change(args[0][..., mine])
            return (changed, *args[1:])

        return projection.register_forward_pre_hook(one_head, prepend=True)

    def whole(_: Module, __: Any, output: Any) -> Any:
        changed = change(first_tensor(output))
        return (changed, *output[1:]) if isinstance(output, tuple) else changed

    part = block if site == "residual" else getattr(block, _PARTS[site], None)
    if part is None:
        raise TrapsError(f"this model's blocks have no `{_PARTS[site]}`, so nothing can be changed at its {site}")
    return part.register_forward_hook(whole, prepend=True)


def head_slice(block: Module, head: int, n_heads: int) -> slice:
    """The columns of the output projection's input that a head wrote. Raises TrapsError for a head out of range."""
    if not 0 <= head < n_heads:
        raise TrapsError(f"no head {head}; the blocks of this model have heads 0 to {n_heads - 1}")
    width = int(_projection(block).in_features) // n_heads
    return slice(head * width, (head + 1) * width)


def into_head(block: Module, head: int, n_heads: int, vectors: np.ndarray) -> np.ndarray:
    """Directions (.., d) of the residual stream as unit directions (.., hd) of a head's own output: those along which
    it writes the most along them, per unit of its own length.

    The projection is asked what it makes of each coordinate of the head, so that quantised weights serve too. Raises
    TrapsError for a head that cannot write along a direction.
    """
    import torch

    projection, mine = _projection(block), head_slice(block, head, n_heads)
    weights = next(projection.parameters())
    dtype = weights.dtype if weights.is_floating_point() else torch.float32
    basis = torch.zeros(mine.stop - mine.start + 1, projection.in_features, dtype=dtype, device=weights.device)
    basis[1:, mine] = torch.eye(mine.stop - mine.start, dtype=dtype, device=weights.device)
    with torch.inference_mode():
        written = projection(basis).float().cpu()
    read = np.asarray(vectors, np.float32) @ (written[1:] - written[0]).numpy().T  # less the bias
    lengths = np.linalg.norm(read, axis=-1, keepdims=True)
    if not lengths.all():
        raise TrapsError(f"head {head} writes nothing along this direction; choose another head")
    return read / lengths


def _projection(block: Module) -> Any:
    projection = getattr(getattr(block, "self_attn", None), "o_proj", None)
    if projection is None:
        raise TrapsError("this model's blocks have no `self_attn.o_proj`, so a head cannot be told from the others")
    return projection
