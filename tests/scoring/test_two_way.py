"""Metrics of two events by hand, and what rules earn that look at one thing alone."""

from __future__ import annotations

import re
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from tests.build.two_events import Rule, lane_verdicts, reader
from tests.build.verdicts import Rows, of_arm, write
from traps_pipeline.pipeline.stages import scoring_stages
from traps_pipeline.protocol.two_events import CLIPS, LANES, lane_items
from traps_pipeline.release.harness.scoring import PanelDecision
from traps_pipeline.release.harness.scoring import run_metrics as harness_metrics
from traps_pipeline.scoring.score_rows import TWO_WAY
from traps_pipeline.scoring.two_way import CELLS, LOWEST, two_way, wrong_rows
from traps_pipeline.storage.study import Study
from traps_pipeline.storage.workspace import Workspace


def only(verdicts: pd.DataFrame) -> Any:
    table = two_way(verdicts, 400)
    assert len(table) == 1 and wrong_rows(table) == 0
    return table.iloc[0]


def metrics(row: Any) -> list[float]:
    return [row[name] for name in LOWEST]


@pytest.mark.parametrize(
    ("rule", "expected", "abstained"),
    [
        (reader, [1, 1, 0, 1], [0, 0, 1, 1]),
        (lambda item: item.clip != "neither", [0, 1, 1, 0], [0, 1, 1, 1]),  # an occluder more means: abstain
        (lambda item: item.clip == "both", [0, 0, 0, 0], [0, 0, 0, 1]),
        (lambda item: item.other_hidden, [0, 0, 1, -1], [0, 1, 0, 1]),
        (lambda item: True, [0, 0, 0, 0], [1, 1, 1, 1]),
        (lambda item: False, [0, 0, 0, 0], [0, 0, 0, 0]),
        # It looks at the left alone: half of the questions are about it.
        (lambda item: item.clip in ("left", "both"), [0, 0.5, 0.5, 0], [0, 0.5, 0.5, 1]),
    ],
)
def test_a_rule_has_the_effects_of_what_it_looks_at(rule: Rule, expected: list[float], abstained: list[float]) -> None:
    row = only(lane_verdicts(rule))
    assert metrics(row) == pytest.approx(expected)
    assert [row[name] for name in CELLS] == pytest.approx(abstained)
    assert (row.n_scenarios, row.n_items, row.n_missing) == (20, 160, 0)


def test_no_rule_of_the_clip_or_of_the_question_alone_is_specific_or_has_a_scenario_right() -> None:
    by_clip = [dict(zip(CLIPS, bits, strict=True)) for bits in product([False, True], repeat=len(CLIPS))]
    by_lane = [dict(zip(LANES, bits, strict=True)) for bits in product([False, True], repeat=len(LANES))]
    alone = [*((lambda item, t=t: t[item.clip]) for t in by_clip), *((lambda item, t=t: t[item.lane]) for t in by_lane)]
    joined = [(lambda item, c=c, q=q: c[item.clip] or q[item.lane]) for c, q in product(by_clip, by_lane)]
    scores = [two_way(lane_verdicts(rule, 1), 2).iloc[0] for rule in (*alone, *joined)]
    assert not any(row.conjunction for row in scores)
    assert not any(row.specificity for row in scores[: len(alone)])
    assert max(row.specificity for row in scores) == 1 / 2  # one lane always abstained on, the other by the clip


def test_the_interval_is_one_over_scenarios() -> None:
    # All of 20 right: Clopper and Pearson's lower end is .025 ** (1 / 20). Eight times the items are no more scenarios.
    row = only(lane_verdicts(reader))
    assert row.conjunction_ci_low == pytest.approx(0.025 ** (1 / 20), abs=0.03)
    assert (row.conjunction_ci_high, row.specificity_ci_high) == (1, 1)
    # Each of two shares has an unseen scenario of its own, as in J; one for both would reach down to 0.66.
    assert 0.66 < row.own_effect_ci_low < row.conjunction_ci_low - 0.05
    assert row.other_effect_ci_low < 0 < row.other_effect_ci_high


def test_one_wrong_answer_costs_its_scenario_and_no_effect() -> None:
    verdicts = lane_verdicts(reader)
    answered = int(np.flatnonzero(verdicts["side"] == "control")[0])
    verdicts.loc[answered, "correct"] = False
    row = only(verdicts)
    assert metrics(row) == pytest.approx([19 / 20, 1, 0, 1])
    assert row.acc == pytest.approx(79 / 80)
    # A right answer with an abstention is none.
    verdicts.loc[answered, ["correct", "abstained"]] = True
    assert only(verdicts).conjunction == 19 / 20


def test_what_is_undecided_counts_for_nothing_unless_something_else_is_wrong() -> None:
    verdicts = lane_verdicts(reader, 3)
    first = verdicts["scenario_id"].eq(verdicts["scenario_id"].unique()[0])
    one, other = (verdicts.index[first & verdicts["item_id"].str.endswith(f"{lane}.neither")] for lane in LANES)
    verdicts.loc[one, ["abstained", "correct"]] = None
    row = only(verdicts)
    assert (row.conjunction, row.own_effect, row.n_missing, row.n_scenarios) == (1, 1, 1, 3)  # all right of two
    verdicts.loc[other, ["abstained", "correct"]] = [True, False]
    row = only(verdicts)  # of five questions where neither is hidden, one was abstained on
    assert (row.conjunction, row.own_effect, row.other_effect) == pytest.approx((2 / 3, 4 / 5, -1 / 5))


def test_one_item_of_each_scenario_gives_effects_and_no_conjunction() -> None:
    verdicts = lane_verdicts(reader, 16)
    row = only(verdicts.iloc[[8 * k + k % 8 for k in range(16)]].reset_index(drop=True))
    assert (row.n_scenarios, row.n_items, row.own_effect, row.other_effect) == (16, 16, 1, 0)
    assert np.isnan([row.conjunction, row.conjunction_ci_low]).all()
    alone = only(verdicts.iloc[:1])
    assert np.isnan([*metrics(alone), alone.specificity_ci_low]).all() and (alone.abstains_neither, alone.acc) == (0, 1)


def test_runs_are_averaged() -> None:
    runs = [lane_verdicts(reader, 4, run=1), lane_verdicts(lambda item: True, 4, run=2)]
    row = only(pd.concat(runs, ignore_index=True))
    assert (row.n_runs, *metrics(row)) == (2, 1 / 2, 1 / 2, 0, 1 / 2)
    assert row.acc == 1 / 2


def test_what_must_be_inferred_stands_beside_and_alone(rows: Rows) -> None:
    inferred = of_arm(rows, "late_occluder", [(True, False, False), (False, True, False)], model="a")
    beside = only(pd.concat([lane_verdicts(reader, 2), inferred], ignore_index=True))
    assert (beside.conjunction, beside.inference_acc, beside.inference_abstains) == (1, 1 / 2, 1 / 2)
    alone = only(inferred)
    assert pd.isna(alone.conjunction) and (alone.inference_acc, alone.n_scenarios, alone.n_runs) == (1 / 2, 0, 1)


def test_answers_of_two_campaigns_are_not_joined() -> None:
    parts = [lane_verdicts(reader, 2), lane_verdicts(reader, 2, epoch="e2", run=2)]
    row = only(pd.concat(parts, ignore_index=True))
    assert pd.isna([row.conjunction, row.specificity_ci_low, row.acc]).all() and row.epoch == "e1+e2"
    assert re.findall(r"\be\d\b", row.refused) == ["e1", "e2"]


@pytest.mark.parametrize("asked", [True, False])
def test_the_stage_writes_a_table_of_what_was_asked(rows: Rows, tmp_path: Path, asked: bool) -> None:
    workspace = Workspace.create(tmp_path / "study", Study(scenarios=["plinko-0001"]))
    write(workspace, lane_verdicts(reader, 1) if asked else rows([(True, False, True)], dataset="occlusion"))
    output = scoring_stages.two_way.make(workspace, None)
    assert scoring_stages.two_way.checks[0].wrong(workspace, None, output) == ""
    workspace.tables.write(TWO_WAY, {}, output.frame, {})
    assert len(workspace.tables.read(TWO_WAY, {})) == asked


def test_a_harness_scores_two_events_as_the_table_does() -> None:
    wrong = lane_verdicts(lambda item: reader(item) and not item.scenario_id.endswith("1"), 3)
    wrong.loc[wrong.index[-1], "abstained"] = None
    row = only(wrong)
    fields = PanelDecision.__dataclass_fields__
    found = harness_metrics(
        PanelDecision(**{name: None if pd.isna(value) else value for name, value in each.items() if name in fields})
        for each in wrong.assign(outcome="answer").to_dict("records")
    )
    assert (row.conjunction, row.own_effect) == (1 / 2, 2 / 3)  # right, answered, undecided
    assert [found[name] for name in LOWEST] == pytest.approx(metrics(row))
    assert (found["pecs"], found["missing"]) == (None, 1)


def test_a_metric_beyond_its_limits_is_counted() -> None:
    table = two_way(lane_verdicts(reader, 2), 20)
    assert wrong_rows(table.assign(specificity=1.1)) == wrong_rows(table.assign(abstains_both=-0.1)) == 1
    assert len(lane_items("hidden_drop-e000")) == 8
