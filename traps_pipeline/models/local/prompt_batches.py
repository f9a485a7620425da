"""Hold processed prompts, and batch them by form, length and memory."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from torch import Tensor


@dataclass(frozen=True, eq=False)
class Prompt:
    """The text of a prompt, rendered by the chat template, and the processor's inputs.

    text: before the clip is expanded. inputs: on the CPU, each with a first axis of one prompt (or of its patches or
    frames).
    """

    text: str
    inputs: Mapping[str, Tensor] = field(repr=False)

    @property
    def n_tokens(self) -> int:
        """The number of tokens, those of the clip included."""
        return self.inputs["input_ids"].shape[1]

    @property
    def sequences(self) -> list[str]:
        """The names of the inputs with one value per token."""
        return [name for name, value in self.inputs.items() if value.shape == self.inputs["input_ids"].shape]

    def followed_by(self, tokens: Sequence[int]) -> Prompt:
        """Return the prompt continued by tokens of an answer."""
        import torch

        inputs = dict(self.inputs)
        suffixes = {"input_ids": list(tokens), "attention_mask": [1] * len(tokens)}  # else: of no modality
        for name in self.sequences:
            row = inputs[name].new_tensor(suffixes.get(name, [0] * len(tokens)))
            inputs[name] = torch.cat([inputs[name], row[None]], dim=1)
        return Prompt(self.text, inputs)

    @property
    def form(self) -> tuple[tuple[str, tuple[int, ...]], ...]:
        """The shapes that prompts of a batch share: those of clips' tensors without the first axis."""
        clip = sorted(self.inputs.keys() - set(self.sequences))
        return tuple((name, tuple(self.inputs[name].shape[1:])) for name in clip)


def collate_prompts(prompts: Sequence[Prompt], pad_token: int) -> dict[str, Tensor]:
    """Return one batch: pad sequences on the left, and concatenate other inputs."""
    import torch

    width = max(prompt.n_tokens for prompt in prompts)
    batch: dict[str, Tensor] = {}
    for name in prompts[0].inputs:
        parts = [prompt.inputs[name] for prompt in prompts]
        if name in prompts[0].sequences:
            fill = pad_token if name == "input_ids" else 0
            parts = [torch.nn.functional.pad(part, (width - part.shape[1], 0), value=fill) for part in parts]
        batch[name] = torch.cat(parts)
    return batch


def prompt_batches(prompts: Sequence[Prompt], row_bytes: Sequence[float], room: float) -> Iterator[list[int]]:
    """Yield batches of prompt indices: same form, like length, within `room` (bytes)."""
    rows_by_form: defaultdict[Any, list[int]] = defaultdict(list)
    for i in sorted(range(len(prompts)), key=lambda i: prompts[i].n_tokens):
        rows_by_form[prompts[i].form].append(i)
    for rows in rows_by_form.values():
        max_rows = max(1, int(room / row_bytes[rows[-1]]))
        yield from (rows[k : k + max_rows] for k in range(0, len(rows), max_rows))
