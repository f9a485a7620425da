"""System prompts of the three regimes and of the judges, verbatim from `assets/prompts` (docs/spec.md 3.3)."""

from __future__ import annotations

from functools import cache

from traps_pipeline.digests import digest
from traps_pipeline.errors import TrapsError
from traps_pipeline.paths import ASSETS

PROMPTS = ASSETS / "prompts"
_REGIME_PARTS = {
    "standard": ("standard",),
    "guided": ("standard", "guided_suffix"),
    "json": ("standard", "json_suffix"),
}


@cache
def prompt(name: str) -> str:
    """Text of `assets/prompts/<name>.txt`, stripped."""
    path = PROMPTS / f"{name}.txt"
    try:
        text = path.read_text(encoding="utf-8").strip()
    except OSError as error:
        raise TrapsError(f"{path}: cannot be read ({error.strerror}); restore it from git") from error
    if not text:
        raise TrapsError(f"{path}: is empty; restore it from git")
    return text


@cache
def system_prompt(regime: str) -> str:
    """The regime's system prompt: parts stripped and joined by one blank line."""
    return "\n\n".join(prompt(part) for part in _REGIME_PARTS[regime])


@cache
def vqa_prompt(name: str) -> str:
    """The system prompt under which hidden states are extracted: `standard`, or `guided` (docs/spec.md 7.1)."""
    parts = {"standard": ("vqa_standard",), "guided": ("vqa_standard", "vqa_guided_suffix")}[name]
    return "\n\n".join(prompt(part) for part in parts)


def prompt_version(regime: str) -> str:
    """Version of a regime's system prompt."""
    return digest(system_prompt(regime))[:16]


def states_prompt(system: str, name: str) -> str:
    """The system prompt under which states are read: the VQA prompt of that name, or the benchmark's own (system
    `benchmark`)."""
    return system_prompt(name) if system == "benchmark" else vqa_prompt(name)
