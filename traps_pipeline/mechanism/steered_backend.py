"""A local model that answers with a direction added to one block: the backend of steered requests.

Requests of one layer are generated together, resumed at that layer; what another process of the machine has made of
them is taken from it (`made_answers`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np

from traps_pipeline.base.errors import TrapsError
from traps_pipeline.mechanism.deciding import Gate
from traps_pipeline.mechanism.made_answers import MadeAnswers
from traps_pipeline.models.local.backend import LocalBackend, outcome
from traps_pipeline.models.local.spans import spans
from traps_pipeline.models.registry import Entry
from traps_pipeline.models.request import Outcome, Request
from traps_pipeline.storage.media import sample

if TYPE_CHECKING:
    from traps_pipeline.models.local.adapter import Prompt
    from traps_pipeline.models.local.backend import _Batch

PROMPTS_KEPT = 128  # processed prompts in memory: each one is used for every direction and strength


class SteeredBackend(LocalBackend):
    """A local model that answers with a direction added to one block, each row with a direction and an alpha of its
    own. gates: by what they are made of, those that decide which requests are steered at all."""

    def __init__(
        self, entry: Entry, vectors: Mapping[str, np.ndarray], made: MadeAnswers, gates: Mapping[str, Gate]
    ) -> None:
        super().__init__(entry)
        self._vectors, self._made, self._gates = vectors, made, gates
        self._prompt = lru_cache(PROMPTS_KEPT)(self._make_prompt)
        self._mask = lru_cache(PROMPTS_KEPT)(self._make_mask)
        self._gated = lru_cache(PROMPTS_KEPT * len(gates))(self._decide)

    def _answers(self, batch: _Batch) -> list[Outcome]:
        """Answer a batch, in the worker thread, but for what another process has made of it."""
        return self._made.outcomes(batch.requests, self.generate, batch.abandoned.is_set)

    def generate(self, wanted: Sequence[Request], stopped: Callable[[], bool]) -> list[Outcome]:
        """Answer requests; all rows of one layer are generated together, resumed at that layer, and unsteered rows
        apart. stopped: asked at every token, ends early."""
        from traps_pipeline.mechanism.hook import Steering

        groups: dict[int | None, list[int]] = {}
        for number, request in enumerate(wanted):
            steering = request.params["steering"]
            groups.setdefault(steering["layer"] if steering else None, []).append(number)
        outcomes: dict[int, Outcome] = {}
        model = self._model()
        for group, numbers in groups.items():
            requests = [wanted[number] for number in numbers]
            prompts = [self._prompt(*_asked(request)) for request in requests]
            hook = None
            if group is not None:
                along = [request.params["steering"] for request in requests]
                vectors = np.stack([self._vectors[steering["direction"]] for steering in along])
                acts = [self._acts(request) for request in requests]  # where not, the model answers as it is
                alphas = tuple(float(s["alpha"]) if acting else 0.0 for s, acting in zip(along, acts, strict=True))
                removed = tuple(
                    float(s.get("removed", 0.0)) if acting else 0.0 for s, acting in zip(along, acts, strict=True)
                )
                site, head, part = (
                    along[0].get(n, d) for n, d in (("site", "residual"), ("head", None), ("positions", ""))
                )
                masks = tuple(self._mask(part, *_asked(request)) for request in requests) if part else ()
                hook = Steering(vectors, group, alphas, removed, site, head, masks)
            most = requests[0].params["max_new_tokens"]
            with model.remembering_clips(), model.resuming():
                made = model.generate(prompts, most, None, hook, stopped=stopped)
            for number, one in zip(numbers, made, strict=True):
                counts = (one.prompt_tokens, one.completion_tokens)
                outcomes[number] = outcome(one.text, one.finish_reason, *counts, model.served_model)
        return [outcomes[number] for number in range(len(wanted))]

    def _model(self) -> Any:
        from traps_pipeline.models.local.adapter import load_local_model

        return load_local_model(self._entry, inside=True)

    def _acts(self, request: Request) -> bool:
        """Whether a request is steered: where the gate that it names abstains, or all the time."""
        gate = request.params["steering"].get("gate")
        return gate is None or self._gated(gate, *_asked(request))

    def _decide(self, gate: str, *asked: Any) -> bool:
        return self._gates[gate].abstains(self._model(), self._prompt(*asked))

    def _make_mask(self, part: str, *asked: Any) -> np.ndarray:
        """Whether each token of a prompt is steered, (T,). Raises TrapsError for a part that it does not have."""
        model, (_, _, system, user) = self._model(), asked
        mask = spans(model, self._prompt(*asked), system, user)[part]
        if not mask.any():
            raise TrapsError(f"{model.checkpoint.name}: its prompts have no {part}; choose other steering.positions")
        return mask

    def _make_prompt(self, clip: Any, digest: str, system: str, user: str) -> Prompt:
        """A processed prompt, kept in memory; `digest` identifies the frames, so a re-rendered clip is a new prompt."""
        shown = sample(clip, self._spec)
        return self._model().prompt(system, user, shown.frames, shown.times_s.tolist())


def _asked(request: Request) -> tuple[Any, str | None, str, str]:
    """What a request's prompt depends on."""
    return request.media, request.media_digest, request.system, request.user
