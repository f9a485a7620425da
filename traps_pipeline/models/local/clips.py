"""What the vision tower makes of a clip, kept: looking inside a model shows it the same clip under several prompts, and
steering shows it again for every direction and dose.

Only classes whose features come clip by clip are remembered (Qwen3-VL); others run as they are. A clip is known by the
bytes of its pixels and its grid, so that a re-rendered clip is another one. Whoever changes the weights of a vision
tower in memory must give the model a new `ClipMemory`.
"""

from __future__ import annotations

import hashlib
from collections import OrderedDict
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from torch import Tensor

MOST_BYTES = 2 * 2**30  # of features that are kept, on the model's device


@dataclass(frozen=True, eq=False)
class _Features:
    """Of one clip: what enters the decoder as tokens, and what is added behind its first blocks, by place."""

    tokens: Tensor
    deepstack: tuple[Tensor, ...]

    @property
    def size(self) -> int:
        return sum(part.numel() * part.element_size() for part in (self.tokens, *self.deepstack))


@dataclass(eq=False)
class ClipMemory:
    """Features by clip, the latest ones. passes: clips that went through the vision tower; used: clips that did not
    have to."""

    most_bytes: int = MOST_BYTES
    passes: int = 0
    used: int = 0
    _kept: OrderedDict[str, _Features] = field(default_factory=OrderedDict)
    _size: int = 0
    _make: Any = None  # the library's class of outputs

    @contextmanager
    def remembering(self, network: Any) -> Iterator[None]:
        """Inside, a network's vision tower sees each clip once. What it returns is what it returned then. Inside
        another such context nothing changes."""
        owner = network.base_model
        original = getattr(owner, "get_video_features", None)
        if (
            original is None
            or "get_video_features" in vars(owner)
            or not hasattr(getattr(owner, "visual", None), "deepstack_merger_list")
        ):
            yield
            return

        def features(pixel_values_videos: Tensor, video_grid_thw: Tensor | None = None, **kwargs: Any) -> Any:
            if video_grid_thw is None:
                return original(pixel_values_videos, video_grid_thw, **kwargs)
            parts = pixel_values_videos.split(video_grid_thw.prod(-1).tolist())
            keys = [_key(part, grid) for part, grid in zip(parts, video_grid_thw, strict=True)]
            found = {key: self._kept[key] for key in keys if key in self._kept}
            missing = [n for n, key in enumerate(keys) if key not in found and keys.index(key) == n]
            if missing:
                found |= self._pass(original, [(keys[n], parts[n], video_grid_thw[n]) for n in missing], kwargs)
            self.used += len(keys) - len(missing)
            rows = [found[key] for key in keys]
            deepstack = [tuple(layer) for layer in zip(*(row.deepstack for row in rows), strict=True)]
            return self._make(pooler_output=tuple(row.tokens for row in rows), deepstack_features=deepstack)

        owner.get_video_features = features
        try:
            yield
        finally:
            del owner.get_video_features  # the class's own method is found again

    def _pass(
        self, original: Any, clips: list[tuple[str, Tensor, Tensor]], kwargs: dict[str, Any]
    ) -> dict[str, _Features]:
        import torch

        pixels, grids = torch.cat([part for _, part, _ in clips]), torch.stack([grid for _, _, grid in clips])
        made = original(pixels, grids, **kwargs)
        self._make = type(made)
        self.passes += len(clips)
        found: dict[str, _Features] = {}
        for number, (key, _, _) in enumerate(clips):
            deepstack = tuple(layer[number].clone() for layer in made.deepstack_features)
            found[key] = _Features(made.pooler_output[number].clone(), deepstack)
            self._keep(key, found[key])
        return found

    def _keep(self, key: str, features: _Features) -> None:
        self._kept[key] = features
        self._size += features.size
        while self._size > self.most_bytes and len(self._kept) > 1:
            _, oldest = self._kept.popitem(last=False)
            self._size -= oldest.size


def _key(pixels: Tensor, grid: Tensor) -> str:
    content = pixels.detach().cpu().contiguous().view(-1).float().numpy().tobytes()
    return hashlib.sha256(content + repr(grid.tolist()).encode()).hexdigest()
