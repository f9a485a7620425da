"""Answer steered requests on a local model.

Requests of one layer are generated together.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np

from traps_pipeline.models.local.backend import LocalBackend, local_outcome
from traps_pipeline.models.registry.entries import Entry
from traps_pipeline.models.request import Outcome, Request
from traps_pipeline.storage.media import pick_frames

if TYPE_CHECKING:
    from traps_pipeline.models.local.adapter import Prompt
    from traps_pipeline.models.local.backend import _Batch

PROMPTS_KEPT = 128  # processed prompts in memory: each one is used for every direction and strength


class SteeredBackend(LocalBackend):
    """A backend that answers with a local model while a direction is added to a block, one for each row."""

    def __init__(self, entry: Entry, vectors: Mapping[str, np.ndarray]) -> None:
        super().__init__(entry)
        self._vectors = vectors
        self._prompt = lru_cache(PROMPTS_KEPT)(self._make_prompt)

    def _answer_batch(self, batch: _Batch) -> list[Outcome]:
        """Answer a batch, in the worker thread."""
        return self.generate(batch.requests, batch.abandoned.is_set)

    def generate(self, batch: Sequence[Request], stopped: Callable[[], bool]) -> list[Outcome]:
        """Return answers to requests, made in groups by layer. stopped: called at every token, ends them early."""
        from traps_pipeline.mechanism.hook import Steering

        groups: dict[int | None, list[int]] = {}
        for number, request in enumerate(batch):
            steering = request.params["steering"]
            groups.setdefault(steering["layer"] if steering else None, []).append(number)
        outcomes: dict[int, Outcome] = {}
        model = self._model()
        for group, numbers in groups.items():
            requests = [batch[number] for number in numbers]
            prompts = [self._prompt(*_prompt_parts(request)) for request in requests]
            hook = None
            if group is not None:
                along = [request.params["steering"] for request in requests]
                vectors = np.stack([self._vectors[steering["direction"]] for steering in along])
                hook = Steering(vectors, group, tuple(float(steering["alpha"]) for steering in along))
            max_tokens = requests[0].params["max_new_tokens"]
            with model.caching_clips():
                answers = model.generate(prompts, max_tokens, None, hook, stopped=stopped)
            for number, answer in zip(numbers, answers, strict=True):
                counts = (answer.prompt_tokens, answer.completion_tokens)
                outcomes[number] = local_outcome(answer.text, answer.finish_reason, *counts, model.served_model)
        return [outcomes[number] for number in range(len(batch))]

    def _model(self) -> Any:
        from traps_pipeline.models.local.adapter import load_local_model

        return load_local_model(self._entry, inside=True)

    def _make_prompt(self, clip: Any, digest: str, system: str, user: str) -> Prompt:
        """Return a processed prompt, cached in memory; `digest` identifies the frames."""
        frames = pick_frames(clip, self._spec)
        return self._model().prompt(system, user, frames.frames, frames.times_s.tolist())


def _prompt_parts(request: Request) -> tuple[Any, str | None, str, str]:
    """Return the part of a request that its prompt depends on."""
    return request.media, request.media_digest, request.system, request.user
