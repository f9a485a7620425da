"""Preview a correction's cost: items, calls and dollars to ask again."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

from traps_pipeline.base.errors import TrapsError
from traps_pipeline.base.wording import count_noun
from traps_pipeline.benchmark.corrections import Correction
from traps_pipeline.benchmark.specs import wording_of
from traps_pipeline.judging.panel import tasks_for
from traps_pipeline.models.money.forecast import Experience, forecast
from traps_pipeline.models.registry.entries import NETWORK, load_models
from traps_pipeline.models.registry.judges import load_panel
from traps_pipeline.pipeline.wanted import StudyPartitions
from traps_pipeline.protocol.cells import Cell
from traps_pipeline.protocol.datasets import DATASETS, SIDES, TWO_EVENTS, is_ill_posed, taxonomy_of
from traps_pipeline.protocol.two_events import lane_items
from traps_pipeline.storage.workspace import Workspace


@dataclass
class CorrectionEffect:
    """What a correction of the benchmark changes: scenarios, items, and calls to repeat.

    Items by id, the maximum number of answers and votes to ask again (the ledger may know some), dollars of calls over
    the network (None if a price is unknown), scenarios to render again, removed and new scenarios, and the corrected
    question.
    """

    items: list[str] = field(default_factory=list)
    answers: int = 0
    votes: int = 0
    dollars: float | None = 0.0
    rendered: list[str] = field(default_factory=list)
    gone: list[str] = field(default_factory=list)
    added: list[str] = field(default_factory=list)
    question: str = ""

    def plus(self, other: CorrectionEffect) -> CorrectionEffect:
        """Return the summed counts of two corrections."""
        is_priced = self.dollars is not None and other.dollars is not None
        return CorrectionEffect(
            self.items + other.items, self.answers + other.answers, self.votes + other.votes,
            (self.dollars or 0) + (other.dollars or 0) if is_priced else None,
            self.rendered + other.rendered, self.gone + other.gone, self.added + other.added,
        )  # fmt: skip

    def sentence(self) -> str:
        """Return a sentence with the numbers of items and calls that a correction repeats."""
        money = "an unknown price" if self.dollars is None else f"about {self.dollars:.2f} USD"
        calls = f"at most {count_noun(self.answers, 'answer')} and {count_noun(self.votes, 'vote')}"
        cost_text = f"{count_noun(len(self.items), 'item')} to ask or judge again: {calls}, {money}"
        return cost_text + (f"; clips of {', '.join(self.rendered)} are rendered again" if self.rendered else "")


def correction_effect(workspace: Workspace, spec: Mapping[str, Any], correction: Correction) -> CorrectionEffect:
    """Return a correction's effect on a row. Raises TrapsError for refused parameters."""
    changes = correction.changes()
    question, renders = changes.get("question", spec["question"]), False
    if "params" in changes:
        params = json.loads(spec["params"])
        renders = any(params.get(name) != value for name, value in changes["params"].items())
        question = changes.get("question") or _question(spec, params | changes["params"])
    asked_again = question != spec["question"]
    ill_posed = changes.get("ill_posed_question", spec["ill_posed_question"]) != spec["ill_posed_question"]
    judged_again = changes.get("answer", spec["ground_truth"]) != spec["ground_truth"] or "labels" in changes
    seats = len(load_panel(workspace.study.panel))
    cost = CorrectionEffect(question=question, rendered=[spec["scenario_id"]] if renders else [])
    for model, dataset, evaluations in _evaluation_counts(workspace, spec["taxonomy"]):
        lanes = {item.item_id: item.side for item in lane_items(spec["scenario_id"])} if dataset == TWO_EVENTS else {}
        for item, side in (lanes or {f"{dataset}:{spec['scenario_id']}:{side}": side for side in SIDES}).items():
            is_ill_posed_void = is_ill_posed(dataset) and side == "void"
            is_asked_again = renders or (ill_posed if is_ill_posed_void else asked_again)
            if is_asked_again or (judged_again and side == "control"):
                cost.items += [] if item in cost.items else [item]
                cost.votes += evaluations * seats * (len(tasks_for(side)) if is_asked_again else 1)
            if is_asked_again:
                cost.answers += evaluations
                dollars = _dollars(model, evaluations)
                cost.dollars = None if cost.dollars is None or dollars is None else cost.dollars + dollars
    return cost


def _question(spec: Mapping[str, Any], params: Mapping[str, Any]) -> str:
    try:
        return wording_of(spec["family"], int(spec["seed"]), spec["scenario_id"], params).question
    except (ValueError, TypeError) as error:
        raise TrapsError(f"{spec['scenario_id']}: params: {error}") from error


def _evaluation_counts(workspace: Workspace, taxonomy: str) -> Iterator[tuple[str, str, int]]:
    """Yield model, dataset of the taxonomy, and the number of its evaluations that experiments want."""
    cells = [Cell.parse(key) for key in StudyPartitions(workspace).cells]
    datasets = [TWO_EVENTS] if taxonomy == TWO_EVENTS else [d for d in DATASETS if taxonomy_of(d) == taxonomy]
    counts = Counter((c.evaluation.model, c.dataset) for c in cells if c.dataset in datasets)
    yield from ((*each, count) for each, count in sorted(counts.items()))


def _dollars(model: str, calls: int) -> float | None:
    entry = load_models().get(model)
    if entry is None or entry.backend != NETWORK:
        return 0.0
    dollars = forecast(entry, calls, Experience()).dollars
    return None if dollars is None else dollars[1]
