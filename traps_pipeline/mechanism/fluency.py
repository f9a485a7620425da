"""Score steered answers by the unsteered model: their perplexity, beside which an effect is read.

A direction that breaks a model's language also moves its abstention. A text that the unsteered model finds unlikely
after the same prompt is such a break, whatever a judge makes of it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from traps_pipeline.base import progress
from traps_pipeline.mechanism.cost import ROWS_BEHIND
from traps_pipeline.mechanism.mechanism_rows import STEERING, SteeringFluencyRow
from traps_pipeline.mechanism.sentences import answer_tokens, mean_log_probabilities
from traps_pipeline.models.registry.prompts import system_prompt
from traps_pipeline.storage.benchmark_tables import ITEMS
from traps_pipeline.storage.media import pick_frames

if TYPE_CHECKING:
    from traps_pipeline.models.registry.entries import ModelEntry
    from traps_pipeline.protocol.cells import SteeringCell
    from traps_pipeline.storage.workspace import Workspace


def fluency_rows(workspace: Workspace, entry: ModelEntry, cell: SteeringCell) -> list[SteeringFluencyRow]:
    """Return STEERING_FLUENCY rows of a cell: one for each answer with a text."""
    from traps_pipeline.models.local.adapter import load_local_model

    assert entry.media is not None, "local entries have media"
    model, system = load_local_model(entry, inside=True), system_prompt(cell.evaluation.regime)
    answers = workspace.tables.read(STEERING, cell.partition).dropna(subset=["text"])
    items = workspace.tables.read(ITEMS, {"dataset": cell.dataset}).set_index("item_id")
    groups, rows = [*answers.groupby("item_id", sort=True)], list[SteeringFluencyRow]()
    for number, (item_id, group) in enumerate(groups, start=1):
        progress.current().tick("steering_fluency", f"items of {cell.key}", number, len(groups))
        item = items.loc[str(item_id)]
        frames = pick_frames(workspace.resolve(str(item["clip"])), entry.media)
        prompt = model.prompt(system, str(item["question"]), frames.frames, frames.times_s)
        tokens = {text: ids for text in dict.fromkeys(group["text"]) if (ids := answer_tokens(model, text))}
        texts, chances = [*tokens], list[float]()
        with model.caching_clips():
            for start in range(0, len(texts), ROWS_BEHIND):
                part = [tokens[text] for text in texts[start : start + ROWS_BEHIND]]
                chances += mean_log_probabilities(model, prompt, part)
        nats = {text: -chance for text, chance in zip(texts, chances, strict=True)}
        rows += [
            SteeringFluencyRow(
                **cell.partition, item_id=str(item_id), request_key=key, nats=nats[text], tokens=len(tokens[text])
            )
            for key, text in dict(zip(group["request_key"], group["text"], strict=True)).items()
            if text in nats
        ]
    return rows
