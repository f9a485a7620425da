"""Decode a batch with the library's `generate`: steered, sampled and stoppable."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from typing import TYPE_CHECKING, Any, Protocol

from traps_pipeline.models.local.library import load_transformers
from traps_pipeline.models.local.prompt_batches import Prompt, collate_prompts
from traps_pipeline.models.local.sampling import Sampling, SeededNucleus
from traps_pipeline.models.reading.first_token import MAX_ALTERNATIVES

if TYPE_CHECKING:
    from torch import Tensor


class DecodingModel(Protocol):
    """The parts of a `LocalModel` that decoding needs."""

    network: Any

    def placed(self, inputs: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Return inputs on the model's device."""
        ...


class Steers(Protocol):
    """An object that changes hidden states in a pass, such as `mechanism.hook.Steering`."""

    def rows(self, chosen: Sequence[int]) -> Steers:
        """Return the steering of the selected prompts of the batch."""
        ...

    def applied(self, model: Any) -> AbstractContextManager[None]:
        """Steer the model's passes within the block."""
        ...


def steering_context(steering: Steers | None, model: DecodingModel) -> AbstractContextManager[None]:
    """Return a context that steers, or without steering one that does nothing."""
    return nullcontext() if steering is None else steering.applied(model)


def decode(
    model: DecodingModel,
    prompts: Sequence[Prompt],
    max_new_tokens: int,
    sampling: Sampling | None,
    steering: Steers | None,
    stopped: Callable[[], bool],
) -> tuple[list[list[int]], list[dict[int, float]]]:
    """Return answers' tokens (greedy without `sampling`), also those after an end, and first-token log-probs."""
    import torch

    transformers = load_transformers()
    inputs: dict[str, Any] = model.placed(collate_prompts(prompts, model.network.generation_config.pad_token_id))
    first = _FirstToken()
    processors = [first, SeededNucleus(sampling)] if sampling else [first]
    with torch.inference_mode(), steering_context(steering, model):
        sequences = model.network.generate(
            **inputs,
            max_new_tokens=max_new_tokens,
            logits_processor=transformers.LogitsProcessorList(processors),
            stopping_criteria=transformers.StoppingCriteriaList([_Stopping(stopped)]),
        )
    return sequences[:, inputs["input_ids"].shape[1] :].tolist(), first.likeliest


class _FirstToken:
    """A logits processor that only records the likeliest first tokens."""

    def __init__(self) -> None:
        self.likeliest: list[dict[int, float]] = []  # one per prompt: token to log-probability

    def __call__(self, input_ids: Any, scores: Tensor) -> Tensor:
        if not self.likeliest:
            values, tokens = scores.float().log_softmax(dim=-1).topk(min(MAX_ALTERNATIVES, scores.shape[-1]))
            rows = zip(tokens.tolist(), values.tolist(), strict=True)
            self.likeliest = [dict(zip(*row, strict=True)) for row in rows]
        return scores


class _Stopping:
    """A transformers stopping criterion that ends every row on demand."""

    def __init__(self, asked: Callable[[], bool]) -> None:
        self._asked = asked

    def __call__(self, input_ids: Tensor, scores: Any, **_: Any) -> Tensor:
        import torch

        return torch.full((len(input_ids),), self._asked(), dtype=torch.bool, device=input_ids.device)
