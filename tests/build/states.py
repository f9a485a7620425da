"""Items of the extraction of hidden states."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from tests.local_models import SIX_FRAMES, SYSTEM, clip
from traps_pipeline.base.digests import file_digest
from traps_pipeline.mechanism.hidden_states import Item, clip_item
from traps_pipeline.models.local.adapter import LocalModel, Prompt


def work(of: LocalModel, n: int = 5, opened: Callable[[int], None] = lambda i: None, **changed: str) -> list[Item]:
    """Items with different questions; `opened` is called whenever a prompt is made. changed: questions by item id."""

    def item(i: int) -> Item:
        question = changed.get(f"item{i}", f"Does it stop after {i} s?")
        row = {"item_id": f"item{i}", "side": ("control", "void")[i % 2], "question": question}
        made = clip_item(of, SIX_FRAMES, row | {"media_digest": file_digest(clip())}, clip(), SYSTEM)

        def prompt() -> Prompt:
            opened(i)
            return made.prompt()

        return replace(made, prompt=prompt)

    return [item(i) for i in range(n)]
