"""Decoding of one batch: the library's own `generate`, from which finished rows leave."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from typing import TYPE_CHECKING, Any, Protocol

from traps_pipeline.models.local.library import load_transformers
from traps_pipeline.models.local.prompt_batches import Prompt, collate
from traps_pipeline.models.local.sampling import Sampling, SeededNucleus

if TYPE_CHECKING:
    from torch import Tensor


class Decodes(Protocol):
    """A `LocalModel`, as far as it is used here."""

    network: Any

    def placed(self, inputs: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Inputs on the model's device."""
        ...


class Steers(Protocol):
    """What may change hidden states during a pass: `mechanism.hook.Steering`."""

    def rows(self, chosen: Sequence[int]) -> Steers:
        """That of some of the prompts."""
        ...

    def applied(self, model: Any) -> AbstractContextManager[None]:
        """Steer the passes made inside."""
        ...


def steered(steering: Steers | None, model: Decodes) -> AbstractContextManager[None]:
    """The steering, or nothing."""
    return nullcontext() if steering is None else steering.applied(model)


def decode(
    model: Decodes,
    prompts: Sequence[Prompt],
    max_new_tokens: int,
    sampling: Sampling | None,
    steering: Steers | None,
    use_cache: bool,
    stopped: Callable[[], bool],
) -> list[list[int]]:
    """The tokens of an answer to each prompt, up to the one that ends it; greedy unless sampling is given. Where half
    of the rows have ended, the others go on without them."""
    import torch

    transformers, config = load_transformers(), model.network.generation_config
    nucleus = SeededNucleus(sampling) if sampling else None
    ends = _ends(config.eos_token_id)
    steers = steering
    inputs: dict[str, Any] = model.placed(collate(prompts, config.pad_token_id))
    width, rows = inputs["input_ids"].shape[1], [*range(len(prompts))]
    answers: dict[int, list[int]] = {}
    with torch.inference_mode():
        while True:
            stopping = _Stopping(stopped)
            criteria: list[Any] = [stopping] + ([_HalfEnded(ends, width)] if use_cache else [])
            with steered(steers, model):
                out = model.network.generate(
                    **inputs,
                    max_new_tokens=max_new_tokens + width - inputs["input_ids"].shape[1],
                    use_cache=use_cache,
                    logits_processor=transformers.LogitsProcessorList([nucleus] if nucleus else []),
                    stopping_criteria=transformers.StoppingCriteriaList(criteria),
                    return_dict_in_generate=True,
                )
            made = out.sequences[:, width:]
            ended = _ended(made, ends)
            full = made.shape[1] >= max_new_tokens or stopping.stopped or not use_cache
            for place, row in enumerate(rows):
                if full or ended[place]:
                    answers[row] = made[place].tolist()
            going = [place for place in range(len(rows)) if rows[place] not in answers]
            if not going:
                return [answers[row] for row in range(len(prompts))]
            inputs = _without(model, inputs, out, going)
            rows = [rows[place] for place in going]
            steers = steering.rows(rows) if steering else None
            if nucleus:
                nucleus.keep(going)


def _without(model: Decodes, inputs: dict[str, Any], out: Any, going: Sequence[int]) -> dict[str, Any]:
    """What the rows that go on continue from: their tokens so far, and their part of the cache."""
    import torch

    chosen = torch.tensor(going, device=out.sequences.device)
    ids, cache = out.sequences[chosen], out.past_key_values
    cache.batch_select_indices(chosen)
    mask = inputs["attention_mask"][chosen]
    mask = torch.cat([mask, mask.new_ones(len(mask), ids.shape[1] - mask.shape[1])], dim=1)
    deltas = getattr(model.network.base_model, "rope_deltas", None)
    if deltas is not None:  # Qwen: how far positions lag behind the tokens, by row
        model.network.base_model.rope_deltas = deltas[chosen]
    return {"input_ids": ids, "attention_mask": mask, "past_key_values": cache}


def _ends(eos: int | Sequence[int]) -> Any:
    import torch

    return torch.tensor([eos] if isinstance(eos, int) else [*eos])


def _ended(made: Tensor, ends: Tensor) -> Tensor:
    """(rows,) bool: which answers have a token that ends them."""
    import torch

    return torch.isin(made, ends.to(made.device)).any(dim=1)


class _Stopping:
    """A stopping criterion of transformers that ends every row when told to. stopped: whether it was told."""

    def __init__(self, asked: Callable[[], bool]) -> None:
        self._asked, self.stopped = asked, False

    def __call__(self, input_ids: Tensor, scores: Any, **_: Any) -> Tensor:
        import torch

        self.stopped = self._asked()
        return torch.full((len(input_ids),), self.stopped, dtype=torch.bool, device=input_ids.device)


class _HalfEnded:
    """A stopping criterion that ends every row when half of them have ended, so that the others go on alone: keys and
    values of rows that go on are copied each time, so that going on at every end would copy a batch n / 2 times, while
    going on at halves copies it less than once in all and lets no more than half of the rows idle. width: tokens of the
    prompts, which may hold tokens that end an answer."""

    def __init__(self, ends: Tensor, width: int) -> None:
        self._ends, self._width = ends, width

    def __call__(self, input_ids: Tensor, scores: Any, **_: Any) -> Tensor:
        import torch

        ended = _ended(input_ids[:, self._width :], self._ends)
        enough = bool(2 * ended.sum() >= len(ended))
        return torch.full((len(input_ids),), enough, dtype=torch.bool, device=input_ids.device)
