"""Locate a prompt's parts: system, times, visual tokens, question, last token.

Nothing here depends on a family. Visual tokens are those of the processor's own placeholders. The rest is found by its
text: tokens are decoded one by one, blanks are ignored on both sides (tokenizers write them differently), and a token
belongs to a part if any of its characters does.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np

from traps_pipeline.base.errors import TrapsError

if TYPE_CHECKING:
    from traps_pipeline.models.local.adapter import LocalModel, Prompt

PARTS = ("system", "stamps", "visual", "question", "last")
CHANGED_DIFFERENCE = (
    0.05  # minimum mean absolute difference of a changed visual token's pixels, as the model reads them
)
# `<0.4 seconds>` of Qwen3-VL and `00:01` of Gemma 4; LLaVA-NeXT-Video writes no times.
_STAMP = re.compile(r"<\d+(?:\.\d+)?seconds>|\d\d:\d\d(?!\d)")


def token_spans(model: LocalModel, prompt: Prompt, system: str, question: str) -> dict[str, np.ndarray]:
    """Return by part of the prompt a mask of the tokens that belong to it, (T,) bool.

    No token belongs to two parts; those of the chat template belong to none. Raises TrapsError if a part cannot be
    found.
    """
    ids, visual = prompt.inputs["input_ids"][0].tolist(), visual_tokens(model, prompt)
    texts = [
        "" if is_visual else _plain(model.processor.tokenizer.decode([token]))
        for token, is_visual in zip(ids, visual, strict=True)
    ]
    ends = np.cumsum([len(text) for text in texts])
    starts, full_text = ends - [len(text) for text in texts], "".join(texts)

    def tokens(first: int, last: int) -> np.ndarray:
        return (starts < last) & (ends > first)

    masks = {name: np.zeros(len(ids), bool) for name in PARTS}
    masks["visual"] = visual
    for name, text in (("system", system), ("question", question)):
        plain_text = _plain(text)
        place = full_text.rfind(plain_text) if name == "question" else full_text.find(plain_text)
        if place < 0 or not plain_text:
            raise TrapsError(
                f"{model.checkpoint.name}: the {name} cannot be found among the tokens of its prompt; its tokenizer "
                "changes texts, so positions cannot be chosen by part"
            )
        masks[name] = tokens(place, place + len(plain_text)) & ~visual
    search_span = int(np.flatnonzero(masks["system"])[-1]) + 1, int(np.flatnonzero(masks["question"])[0])
    for first, last in _stamps(full_text, int(starts[search_span[0]]), int(starts[search_span[1]])):
        masks["stamps"] |= tokens(first, last) & ~visual
    masks["last"][-1] = True
    for name in PARTS[:-1]:
        masks[name] &= ~masks["last"]
    return masks


def visual_tokens(model: LocalModel, prompt: Prompt) -> np.ndarray:
    """Return a mask of the prompt's tokens that stand for pictures, (T,) bool."""
    placeholders = {getattr(model.processor, f"{kind}_token_id", None) for kind in ("image", "video")}
    return np.isin(prompt.inputs["input_ids"][0].tolist(), [token for token in placeholders if token is not None])


def changed_tokens(first: Prompt, second: Prompt, visual: np.ndarray) -> np.ndarray | None:
    """Return a mask of the visual tokens whose pixels differ between two prompts, (T,) bool; None if unknown.

    None if the clips have different numbers of pixels, or the processor's pixels do not come token by token. Qwen's do:
    the patches that are merged into one token follow each other.
    """
    pixels, n_visual = [prompt.inputs.get("pixel_values_videos") for prompt in (first, second)], int(visual.sum())
    if pixels[0] is None or pixels[1] is None or pixels[0].shape != pixels[1].shape or pixels[0].ndim != 2:
        return None
    if not n_visual or len(pixels[0]) % n_visual:
        return None
    difference = (pixels[0].float() - pixels[1].float()).abs().mean(dim=1)
    is_changed = np.zeros(len(visual), bool)
    is_changed[visual] = (difference.reshape(n_visual, -1).amax(dim=1) > CHANGED_DIFFERENCE).numpy()
    return is_changed


def _stamps(text: str, first: int, last: int) -> Iterator[tuple[int, int]]:
    for match in _STAMP.finditer(text, first, last):
        yield match.span()


def _plain(text: str) -> str:
    return "".join(text.split())
