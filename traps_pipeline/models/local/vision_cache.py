"""Cache the vision tower's output per clip, which many prompts and doses share.

The three families say in their own ways which pixels belong to which clip (`_clips_of`); other classes run uncached. A
clip is identified by the bytes of its pixels and its grid, so that a re-rendered clip is another one. Code that changes
the weights of a vision tower in memory must give the model a new `ClipMemory`.
"""

from __future__ import annotations

import functools
import hashlib
import inspect
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any

from traps_pipeline.base.bounded_cache import BoundedCache

if TYPE_CHECKING:
    from torch import Tensor

MAX_BYTES = 2 * 2**30  # maximum bytes of cached features, on the model's device


@dataclass(frozen=True, eq=False)
class _Features:
    """A clip's features: decoder tokens, and additions after first blocks, by place."""

    tokens: Tensor
    deepstack: tuple[Tensor, ...]

    @property
    def size(self) -> int:
        return sum(part.numel() * part.element_size() for part in (self.tokens, *self.deepstack))


class ClipMemory:
    """The vision tower's features of the latest clips; `passes` counts those that it encoded."""

    def __init__(self) -> None:
        self.passes = 0
        self.features = BoundedCache[str, _Features](MAX_BYTES, lambda features: features.size)
        self._form: Any = None  # the library's class of outputs, and whether its tokens come as a tuple

    @contextmanager
    def remembering(self, network: Any) -> Iterator[None]:
        """Encode each clip once within the block; a nested block changes nothing."""
        owner = network.base_model
        original = getattr(owner, "get_video_features", None)
        if original is None or "get_video_features" in vars(owner):
            yield
            return
        names = inspect.signature(original)

        @functools.wraps(original)  # the library inspects the names of its arguments
        def features(*given: Any, **named: Any) -> Any:
            arguments = dict(names.bind(*given, **named).arguments)
            keyword_arguments = arguments.pop("kwargs", {})
            clips = _clips_of(arguments)
            if clips is None:
                return original(*given, **named)
            keys = _keys(clips)
            rows: dict[str, _Features] = {}
            for key, clip in zip(keys, clips, strict=True):
                if key not in rows:
                    pass_arguments = {**arguments, **clip, **keyword_arguments}
                    rows[key] = self.features.get(key, partial(self._pass, original, pass_arguments))
            return self._join_features([rows[key] for key in keys])

        owner.get_video_features = features
        try:
            yield
        finally:
            del owner.get_video_features  # restore the class's own method

    def _pass(self, original: Any, arguments: dict[str, Any]) -> _Features:
        output = original(**arguments)
        self._form = type(output), isinstance(output.pooler_output, tuple | list)
        self.passes += 1
        tokens = output.pooler_output[0] if self._form[1] else output.pooler_output
        layers = getattr(output, "deepstack_features", None) or ()
        return _Features(tokens.clone(), tuple(layer[0].clone() for layer in layers))

    def _join_features(self, rows: list[_Features]) -> Any:
        """Return these clips' features in the form of the library's output."""
        import torch

        make, is_tuple = self._form
        tokens = [row.tokens for row in rows]
        fields: dict[str, Any] = {"pooler_output": tuple(tokens) if is_tuple else torch.cat(tokens)}
        if rows[0].deepstack:
            fields["deepstack_features"] = [
                tuple(layer) for layer in zip(*(row.deepstack for row in rows), strict=True)
            ]
        return make(**fields)


def _clips_of(arguments: dict[str, Any]) -> list[dict[str, Tensor]] | None:
    """Return each clip's own arguments; None if the class does not separate clips."""
    pixels, grids = arguments["pixel_values_videos"], arguments.get("video_grid_thw")
    if grids is not None:  # Qwen3-VL: patches of all clips one after the other, and how many each has
        parts = pixels.split(grids.prod(-1).tolist())
        return [
            {"pixel_values_videos": part, "video_grid_thw": grid[None]} for part, grid in zip(parts, grids, strict=True)
        ]
    counts, places = arguments.get("num_frames_per_video"), arguments.get("video_position_ids")
    if counts is not None and places is not None:  # Gemma 4: frames of all clips one after the other
        clip_parts = zip(pixels.split(counts.tolist()), places.split(counts.tolist()), counts, strict=True)
        names = ("pixel_values_videos", "video_position_ids", "num_frames_per_video")
        return [dict(zip(names, (part, place, count[None]), strict=True)) for part, place, count in clip_parts]
    if pixels.dim() == 5:  # LLaVA-NeXT-Video: a row a clip
        return [{"pixel_values_videos": row[None]} for row in pixels]
    return None


def _keys(clips: list[dict[str, Tensor]]) -> list[str]:
    """Return each clip's digest; one that equals the clip before it is not read again."""
    import torch

    keys: list[str] = []
    for number, clip in enumerate(clips):
        is_repeated = number > 0 and all(torch.equal(part, clips[number - 1][name]) for name, part in clip.items())
        keys.append(keys[-1] if is_repeated else _key(clip))
    return keys


def _key(clip: dict[str, Tensor]) -> str:
    hasher = hashlib.sha256()
    for name, part in clip.items():
        hasher.update(f"{name} {tuple(part.shape)}".encode())
        hasher.update(part.detach().cpu().contiguous().view(-1).float().numpy().tobytes())
    return hasher.hexdigest()
