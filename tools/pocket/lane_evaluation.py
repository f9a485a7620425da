"""A pocket model on held-out two-lane scenes: what it answers, and whether its states hold the interaction."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from tools.pocket.lanes import LaneScenes
from tools.pocket.seeds import SeedRow
from tools.pocket.words import prompt_text
from traps_pipeline.judging.rules import ABSTENTION, read_statement
from traps_pipeline.mechanism.interaction import LaneDesign, lane_metrics
from traps_pipeline.models.local.adapter import load_local_model
from traps_pipeline.models.registry.entries import ModelEntry
from traps_pipeline.protocol.two_events import CLIPS, LANES, LaneItem, lane_items

FOLDS, RESAMPLES = 5, 1000
RANDOM = (0, 1)  # seeds of random weights that are measured beside a model
MAX_BATCH = 64
PROMPT = "vqa_guided"
FIGURES = ("within", "within_low", "auroc", "own_effect", "other_effect", "n_clips")
SHARES = ("right", "abstained", "false_abs")


@dataclass(frozen=True)
class LaneFigures(SeedRow):
    """Figures of one training seed on held-out scenes, at one layer.

    weights: `model`, or `random_N`. within: share of clips with one hidden event whose hidden question is scored above
    the other; the rest as in the table `interaction`. right: share of questions answered right that can be answered;
    abstained: of those that cannot; false_abs: abstentions among the first. Random weights are not asked (nan).
    """

    COMMAND = "evaluate"
    weights: str
    held_out: str
    layer: int
    within: float
    within_low: float
    auroc: float
    own_effect: float
    other_effect: float
    n_clips: int
    right: float
    abstained: float
    false_abs: float


def evaluate(
    entry: ModelEntry,
    scenes: LaneScenes,
    seed: int,
    weights: Sequence[int | None] = (None, *RANDOM),
    report: Callable[[str], None] = lambda _: None,
) -> list[LaneFigures]:
    """Return the figures of a model on scenes, and those of its class with random weights (seeds; None: its own)."""
    rows = []
    for random in weights:
        name = "model" if random is None else f"random_{random}"
        model = load_local_model(entry, seed=random)
        states, answers, asked = _asked(model, scenes, answered=random is None)
        shares: dict[str, Any] = _shares(answers, asked, scenes) if answers else dict.fromkeys(SHARES, math.nan)
        design = LaneDesign.of([item.item_id for item, _ in asked])
        for layer in range(states.shape[1]):
            for held_out, figures in lane_metrics(states[:, layer], design, FOLDS, RESAMPLES, seed).items():
                rounded: dict[str, Any] = {key: round(figures[key], 6) for key in FIGURES}
                rows.append(LaneFigures(seed, name, held_out, layer, **rounded, **shares))
        report(f"{name}: within {max(row.within for row in rows if row.weights == name):.2f} at its best layer")
    return rows


def _asked(
    model: Any, scenes: LaneScenes, *, answered: bool
) -> tuple[np.ndarray, list[str], list[tuple[LaneItem, int]]]:
    """Return states (items, layers, d) at the last token, answers (none of random weights), and the items."""
    system, states, answers, asked = prompt_text(PROMPT), [], [], []
    for scene, record in enumerate(scenes.records):
        items = lane_items(f"{record.family}-{scene:04d}")
        prompts = [
            model.prompt(
                system,
                record.questions[LANES.index(item.lane)],
                scenes.frames(scene, [*CLIPS].index(item.clip)),
                scenes.times(scene, 0),
            )
            for item in items
        ]
        states += [model.forward_states(prompt).raw for prompt in prompts]
        answers += [each.text for each in model.generate(prompts, 8)] if answered else []
        asked += [(item, scene) for item in items]
    return np.stack(states), answers, asked


def _shares(answers: Sequence[str], asked: Sequence[tuple[LaneItem, int]], scenes: LaneScenes) -> dict[str, Any]:
    """Return the shares of right answers and of abstentions."""
    hidden = np.array([item.asked_hidden for item, _ in asked])
    said, right = [], []
    for text, (item, scene) in zip(answers, asked, strict=True):
        record, lane = scenes.records[scene], LANES.index(item.lane)
        statement = read_statement(text, record.questions[lane])
        said.append(statement == ABSTENTION)
        right.append(statement is not None and statement.value == record.answers[lane])
    parts = (np.array(right)[~hidden], np.array(said)[hidden], np.array(said)[~hidden])
    return {name: round(float(part.mean()), 4) for name, part in zip(SHARES, parts, strict=True)}


def markdown(rows: Sequence[LaneFigures]) -> str:
    """Return the figures as a table, one row a layer."""
    names = [field.name for field in fields(LaneFigures)]
    lines = [f"| {' | '.join(names)} |", "|" + " --- |" * len(names)]
    for row in rows:
        values = (getattr(row, name) for name in names)
        lines.append("| " + " | ".join(f"{v:.2f}" if isinstance(v, float) else str(v) for v in values) + " |")
    return "\n".join(lines)
