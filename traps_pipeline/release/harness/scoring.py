"""Score answers with the standard library: read texts, apply rules, compute PECS."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from traps_pipeline.judging.rules import read_statement
from traps_pipeline.models.reading.interpret import read_answer
from traps_pipeline.models.reading.judged_answers import UNREAD, is_correct
from traps_pipeline.models.request import JUDGED_OUTCOMES
from traps_pipeline.protocol.datasets import TWO_EVENTS
from traps_pipeline.protocol.two_events import lane_item, lane_items

DATASETS = ("chaotic", "chaotic_ill_posed", "occlusion", "occlusion_ill_posed")  # means are summed in this order
RUN_METRICS = ("pecs", "acc", "abs_rec", "false_abs", "j")
TWO_WAY_METRICS = ("conjunction", "own_effect", "other_effect", "specificity")


@dataclass(frozen=True)
class PanelDecision:
    """The panel's decision about an answer.

    outcome: the kind of text, UNREAD if the rules cannot read it; abstained, correct: None if undecided; correct is
    None on every void.
    """

    item_id: str
    dataset: str
    side: str
    outcome: str
    abstained: bool | None = None
    correct: bool | None = None

    @property
    def is_right(self) -> bool:
        """Whether a control was answered correctly, or a void was abstained on."""
        return bool(self.correct if self.side == "control" else self.abstained)

    @staticmethod
    def of(record: Mapping[str, Any]) -> PanelDecision:
        """Return the decision from its fields (the inverse of `vars`)."""
        return PanelDecision(**{name: record[name] for name in PanelDecision.__dataclass_fields__})


def judge(item: Mapping[str, Any], outcome: str, text: str | None, regime: str) -> PanelDecision:
    """Return the panel's decision about an answer.

    outcome: answer, truncated, empty, refused or error. All three judges of the panel `rules` read by the same rules,
    so one reading is their majority.
    """
    row = {"outcome": outcome if (text or "").strip() or outcome not in ("answer", "truncated") else "empty"}
    reading = read_answer({**row, "text": text}, None, regime)
    names = {name: item[name] for name in ("item_id", "dataset", "side")}
    if reading.outcome not in JUDGED_OUTCOMES or reading.text is None:
        return PanelDecision(**names, outcome=reading.outcome)
    statement = read_statement(reading.text, item["question"])
    if statement is None:
        return PanelDecision(**names, outcome=UNREAD)
    abstained = statement.value is None
    if item["side"] != "control":
        return PanelDecision(**names, outcome=reading.outcome, abstained=abstained)
    labels, aliases = list(item["labels"]), json.loads(item["aliases"])
    correct = is_correct(statement.value, item["ground_truth"], item["answer_type"], labels, aliases)
    return PanelDecision(**names, outcome=reading.outcome, abstained=abstained, correct=correct)


def run_metrics(judged: Iterable[PanelDecision]) -> dict[str, float | None]:
    """Return Acc, AbsRec, FalseAbs, J and PECS of one run.

    Keys: `DATASET_METRIC` for each dataset, and METRIC overall, the equal-weight mean over the four datasets, None
    unless all four are present; TWO_WAY_METRICS if two events were asked; `missing`, the number of undecided items, and
    `unread`, those among them that the rules could not read.
    """
    rows = list(judged)
    results: dict[str, float | None] = {}
    by_dataset = {name: _dataset_metrics([row for row in rows if row.dataset == name]) for name in DATASETS}
    for name, dataset_metrics in by_dataset.items():
        if any(row.dataset == name for row in rows):
            results |= {f"{name}_{metric}": dataset_metrics[metric] for metric in RUN_METRICS}
    for metric in RUN_METRICS:
        values = [dataset_metrics[metric] for dataset_metrics in by_dataset.values()]
        values_present = [value for value in values if value is not None]
        results[metric] = sum(values_present) / len(DATASETS) if len(values_present) == len(DATASETS) else None
    results |= _two_way_metrics([row for row in rows if row.dataset == TWO_EVENTS])
    undecided_rows = [row for row in rows if row.abstained is None or (row.side == "control" and row.correct is None)]
    return results | {
        "missing": float(len(undecided_rows)),
        "unread": float(sum(row.outcome == UNREAD for row in rows)),
    }


def _two_way_metrics(rows: list[PanelDecision]) -> dict[str, float | None]:
    """Return TWO_WAY_METRICS (`scoring.two_way`); none without rows."""
    if not rows:
        return {}
    cells: dict[tuple[bool, bool], list[bool | None]] = {}  # by whether the asked and the other event is hidden
    scenarios: dict[str, list[bool | None]] = {}
    for row in rows:
        item = lane_item(row.item_id)
        cells.setdefault((item.asked_hidden, item.other_hidden), []).append(row.abstained)
        answered = None if row.abstained is None or row.correct is None else row.correct and not row.abstained
        scenarios.setdefault(item.scenario_id, []).append(row.abstained if row.side == "void" else answered)
    whole = [rights for rights in scenarios.values() if len(rights) == len(lane_items(""))]
    conjunctions = [False if False in rights else None if None in rights else True for rights in whole]
    neither, other, asked = (_share(cells.get(cell, [])) for cell in ((False, False), (False, True), (True, False)))
    pairs = ((asked, neither), (other, neither), (asked, other))
    effects = [None if high is None or low is None else high - low for high, low in pairs]
    return dict(zip(TWO_WAY_METRICS, (_share(conjunctions), *effects), strict=True))


def _dataset_metrics(rows: list[PanelDecision]) -> dict[str, float | None]:
    acc = _share([row.correct for row in rows if row.side == "control"])
    false_abs = _share([row.abstained for row in rows if row.side == "control"])
    abs_rec = _share([row.abstained for row in rows if row.side == "void"])
    j = None if abs_rec is None or false_abs is None else abs_rec - false_abs
    pecs = None if acc is None or j is None else acc * max(0.0, j)
    return {"pecs": pecs, "acc": acc, "abs_rec": abs_rec, "false_abs": false_abs, "j": j}


def _share(decisions: list[bool | None]) -> float | None:
    decided_values = [decision for decision in decisions if decision is not None]
    return sum(decided_values) / len(decided_values) if decided_values else None
