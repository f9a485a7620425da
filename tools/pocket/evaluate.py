"""The pocket model on held-out scenes: asked through the same adapter as any local model, judged by the rule judge."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from tools.pocket.data import SceneRecord, read_shards
from tools.pocket.recipe import GAP, Recipe
from tools.pocket.seeds import SeedRow
from traps_pipeline.judging.rules import ABSTENTION, read_statement
from traps_pipeline.models.reading.judged_answers import is_correct
from traps_pipeline.models.registry.entries import ModelEntry, get_model
from traps_pipeline.models.registry.prompts import system_prompt
from traps_pipeline.protocol.regimes import PAPER_REGIMES
from traps_pipeline.scoring.metrics import wilson
from traps_pipeline.storage.media import MediaSpec, pick_frames

if TYPE_CHECKING:
    from traps_pipeline.models.local.adapter import LocalModel
    from traps_pipeline.models.local.prompt_batches import Prompt

MAX_BATCH = 64  # prompts that are held at once
KINDS = ("control", "visual", "ill_posed", "answerable")


@dataclass(frozen=True)
class Asked:
    """One question about a held-out clip. kind: control, visual (the void clip), ill_posed (the control clip), or
    answerable (the void clip again). truth: None where there is none."""

    scene: SceneRecord
    kind: str
    clip: Path
    question: str
    truth: str | None


@dataclass(frozen=True)
class AnswerCounts(SeedRow):
    """Counts of one training seed, family, regime and kind of question. prior: the number of controls whose truth is
    the commonest answer of the family's held-out scenes, which the reference model `prior` would give; 0 for other
    kinds."""

    COMMAND = "evaluate"
    family: str
    regime: str
    kind: str
    n: int
    correct: int
    abstained: int
    prior: int

    @property
    def accuracy_low(self) -> float:
        """Lower end of the 95 % Wilson interval of the share of correct answers."""
        low, _ = wilson(np.array([self.correct], float), np.array([self.n], float))
        return float(low[0])


def entry_of(checkpoint: Path, media: MediaSpec) -> ModelEntry:
    """Return the registry's entry of the pocket model with the weights of a folder, and the frames that it is shown."""
    entry = get_model(GAP)
    return entry.model_copy(update={"params": entry.params | {"checkpoint": str(checkpoint)}, "media": media})


def held_out(recipe: Recipe, folder: Path, most: int | None = None) -> Iterator[Asked]:
    """Yield the questions about the held-out scenes, family by family: about all, or about the first `most` of each."""
    counts: Counter[str] = Counter()
    for job, records in read_shards(recipe, "held-out", folder):
        for place, scene in enumerate(records):
            if most is not None and counts[scene.family] >= most:
                continue
            counts[scene.family] += 1
            control, void = (job.clip(place, side) for side in ("control", "void"))
            yield Asked(scene, "control", control, scene.asked.question, scene.asked.answer)
            yield Asked(scene, "visual", void, scene.visual.question, None)
            yield Asked(scene, "ill_posed", control, scene.ill_posed.question, None)
            yield Asked(scene, "answerable", void, scene.answerable.question, scene.answerable.answer)


def evaluate(
    entry: ModelEntry,
    asked: Sequence[Asked],
    seed: int,
    regimes: Sequence[str] = PAPER_REGIMES,
    report: Callable[[str], None] = lambda _: None,
) -> list[AnswerCounts]:
    """Ask all questions under every regime; returns the counts by family, regime and kind."""
    from traps_pipeline.models.local.adapter import load_local_model

    assert entry.media is not None
    model, max_new_tokens = load_local_model(entry), entry.local_params().max_new_tokens
    commonest = _commonest(asked)
    n: Counter[tuple[str, str, str]] = Counter()
    correct, abstained, prior = n.copy(), n.copy(), n.copy()
    for start in range(0, len(asked), MAX_BATCH):
        some = asked[start : start + MAX_BATCH]
        frames = {clip: pick_frames(clip, entry.media) for clip in dict.fromkeys(one.clip for one in some)}
        for regime in regimes:
            system = system_prompt(regime)
            prompts: list[Prompt] = [
                model.prompt(system, one.question, frames[one.clip].frames, frames[one.clip].times_s.tolist())
                for one in some
            ]
            for one, answer in zip(some, _answers(model, prompts, max_new_tokens), strict=True):
                cell = (one.scene.family, regime, one.kind)
                n[cell] += 1
                abstained[cell] += read_statement(answer, one.question) == ABSTENTION
                correct[cell] += one.truth is not None and _is_right(one, answer)
                prior[cell] += one.kind == "control" and one.truth == commonest[one.scene.family]
        report(f"seed {seed}: {start + len(some)} of {len(asked)} questions under {len(regimes)} regimes")
    return [AnswerCounts(seed, *cell, n[cell], correct[cell], abstained[cell], prior[cell]) for cell in n]


def _answers(model: LocalModel, prompts: Sequence[Prompt], max_new_tokens: int) -> list[str]:
    return [generated.text for generated in model.generate(prompts, max_new_tokens)]


def _is_right(one: Asked, answer: str) -> bool:
    """Return whether the value that the rule judge reads in an answer is correct (docs/spec.md 4.3)."""
    assert one.truth is not None
    statement = read_statement(answer, one.question)
    value = statement.value if statement else None
    if one.kind == "answerable":
        return is_correct(value, one.truth, "label", [one.truth], {}) is True
    return is_correct(value, one.truth, one.scene.answer_type, one.scene.labels, one.scene.aliases) is True


def _commonest(asked: Sequence[Asked]) -> dict[str, str]:
    """Return the commonest control answer of each family among these scenes; of several, the first in alphabetical
    order."""
    counts: dict[str, Counter[str]] = {}
    for one in asked:
        if one.kind == "control" and one.truth is not None:
            counts.setdefault(one.scene.family, Counter())[one.truth] += 1
    return {family: min(count, key=lambda answer: (-count[answer], answer)) for family, count in counts.items()}


# --- the table that ships ---------------------------------------------------------------------------------------------

COLUMNS = (
    *("family", "regime", "Acc", "lowest 95 % bound", "prior", "FalseAbs"),
    *("AbsRec visual", "AbsRec ill-posed", "Acc answerable"),
)


def markdown(cells: Sequence[AnswerCounts]) -> str:
    """Return the model card's table: one row per family and regime, in percent, as means over training seeds."""
    seeds = sorted({cell.seed for cell in cells})
    lines = [
        f"| {' | '.join(COLUMNS)} |",
        f"|{' --- |' * len(COLUMNS)}",
    ]
    for family, regime in dict.fromkeys((cell.family, cell.regime) for cell in cells):
        of_row = [cell for cell in cells if (cell.family, cell.regime) == (family, regime)]
        by_kind = {kind: [cell for cell in of_row if cell.kind == kind] for kind in KINDS}
        control = by_kind["control"]
        columns = [
            _spread([cell.correct / cell.n for cell in control]),
            f"{100 * min(cell.accuracy_low for cell in control):.1f}",
            f"{100 * control[0].prior / control[0].n:.1f}",
            _spread([cell.abstained / cell.n for cell in control]),
            _spread([cell.abstained / cell.n for cell in by_kind["visual"]]),
            _spread([cell.abstained / cell.n for cell in by_kind["ill_posed"]]),
            _spread([cell.correct / cell.n for cell in by_kind["answerable"]]),
        ]
        lines.append(f"| {family} | {regime} | {' | '.join(columns)} |")
    return "\n".join([*lines, "", f"Training seeds: {', '.join(map(str, seeds))}."])


def _spread(shares: Sequence[float]) -> str:
    """Return the shares in percent: their mean and, where they differ, the lowest and the highest."""
    mean, low, high = (f"{100 * value:.1f}" for value in (np.mean(shares), min(shares), max(shares)))
    return mean if low == high else f"{mean} ({low}-{high})"
