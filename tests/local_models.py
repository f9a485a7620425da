"""Tiny random checkpoints of the three families, built once a process, and a clip to ask them about."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from tools.tiny_checkpoints import FAMILIES, Family, build_tiny
from traps_pipeline.models.local.adapter import LocalModel, Prompt, load_local_model
from traps_pipeline.models.registry.entries import ModelEntry
from traps_pipeline.storage.media import MediaSpec, pick_frames
from traps_pipeline.video.encode import encode

__all__ = ["FAMILIES", "Family"]

SYSTEM = "You are a helpful visual question answering assistant."
QUESTIONS = ("Does it stop?", "Does the ball end up left, right, or behind the wall?", "Which?")
SIX_FRAMES = MediaSpec(profile="frames", uniform=6)
# What is too narrow for NF4 on a CPU, and the head, which no library quantises.
NF4_SKIP = ["model.visual", "model.vision_tower", "model.multi_modal_projector", "model.embed_vision", "lm_head"]


@cache
def _folder() -> TemporaryDirectory[str]:
    return TemporaryDirectory(prefix="tiny-models-")


@cache
def checkpoint(family: Family) -> Path:
    """A tiny checkpoint; read only."""
    return build_tiny(family, Path(_folder().name) / family)


@cache
def clip() -> Path:
    """A square that moves for 1.9 s at 10 frames a second."""
    frames = []
    for i in range(20):
        frame = np.full((72, 96, 3), 180, np.uint8)
        frame[20:40, 3 * i : 3 * i + 20] = (220, 40, 40)
        frames.append(frame)
    path = Path(_folder().name) / "clip.mp4"
    encode(frames, path, 10)
    return path


def entry(family: Family, checkpoint_folder: Path | str | None = None, **params: Any) -> ModelEntry:
    """A registry entry for a tiny checkpoint: float32 on the CPU, greedy, six frames."""
    settings = {"dtype": "float32", "quantisation": "none", "do_sample": False, "max_new_tokens": 8, **params}
    settings["checkpoint"] = str(checkpoint_folder or checkpoint(family))
    return ModelEntry(id=family, backend="local", device="cpu", media=SIX_FRAMES, params=settings)


def model(family: Family, **params: Any) -> LocalModel:
    """A tiny model in memory."""
    return load_local_model(entry(family, **params))


def ask(of: LocalModel, question: str = QUESTIONS[0], frames: int = 6) -> Prompt:
    """A prompt about the clip."""
    shown = pick_frames(clip(), MediaSpec(profile="frames", uniform=frames))
    return of.prompt(SYSTEM, question, shown.frames, shown.times_s)


@cache
def three_prompts(family: Family) -> tuple[Prompt, ...]:
    """Prompts of three lengths."""
    of = model(family)
    return tuple(ask(of, question) for question in QUESTIONS)


def direction(of: LocalModel, seed: int = 0) -> np.ndarray:
    """A random unit vector as wide as the model's states."""
    drawn = np.random.default_rng(seed).normal(size=of.d_model)
    return (drawn / np.linalg.norm(drawn)).astype(np.float32)
