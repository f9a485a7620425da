"""Sample with a random stream per row, so that its batch changes no answer."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from torch import Tensor


@dataclass(frozen=True)
class Sampling:
    """Temperature and nucleus sampling, with one seed per prompt."""

    temperature: float
    top_p: float
    seeds: Sequence[int]

    def rows(self, chosen: Sequence[int]) -> Sampling:
        """Return the sampling of the selected prompts of the batch."""
        return Sampling(self.temperature, self.top_p, [self.seeds[i] for i in chosen])


class SeededNucleus:
    """A logits processor that leaves one token, drawn by each row's own random stream.

    Greedy decoding then picks that token. The nucleus is the smallest set of tokens whose probability reaches top_p.
    """

    def __init__(self, sampling: Sampling) -> None:
        self._sampling = sampling
        self._streams = [np.random.default_rng(seed) for seed in sampling.seeds]

    def __call__(self, input_ids: Any, scores: Tensor) -> Tensor:
        """Mask all logits (rows, vocabulary) except those of the sampled tokens."""
        import torch

        probabilities, order = (scores.float() / self._sampling.temperature).softmax(dim=-1).sort(descending=True)
        preceding = probabilities.cumsum(dim=-1) - probabilities
        nucleus = probabilities.masked_fill(preceding >= self._sampling.top_p, 0.0)
        cumulative = nucleus.cumsum(dim=-1)
        uniform = torch.tensor(
            [[stream.random()] for stream in self._streams], dtype=cumulative.dtype, device=cumulative.device
        )
        place = torch.searchsorted(cumulative, uniform * cumulative[:, -1:], right=True)
        place = place.minimum((nucleus > 0).sum(dim=-1, keepdim=True) - 1)  # rounding must not leave the nucleus
        return torch.full_like(scores, -torch.inf).scatter_(1, order.gather(1, place), 0.0)
