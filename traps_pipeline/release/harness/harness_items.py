"""Read the items, prompts and frames beside this file."""

from __future__ import annotations

import json
from functools import cache
from pathlib import Path
from typing import Any

FOLDER = Path(__file__).parent
ITEMS, ABOUT, MEDIA = "items.jsonl", "about.json", "media"


@cache
def about() -> dict[str, Any]:
    """Return the benchmark's name, version, canary, prompts by regime, and parameters."""
    return json.loads((FOLDER / ABOUT).read_text(encoding="utf-8"))


@cache
def items() -> list[dict[str, Any]]:
    """Return every item in order: question, labels, truth, and the paths of its media."""
    lines = (FOLDER / ITEMS).read_text(encoding="utf-8").split("\n")
    return [json.loads(line) for line in lines if line]


def media_of(item: dict[str, Any]) -> list[Path]:
    """Return the paths of an item's media: the mp4, or the JPEGs in order."""
    return [FOLDER / name for name in item["media"]]


def harness_prompt(regime: str) -> str:
    """Return a regime's system prompt. Raises ValueError with the known regimes."""
    prompts: dict[str, str] = about()["prompts"]
    if regime not in prompts:
        raise ValueError(f"regime {regime!r} is unknown; known: {', '.join(prompts)}")
    return prompts[regime]
