"""Doses of a hypothesis: metrics by hand, changes on shared scenarios, rules beside them, no part of the pairs'."""

from __future__ import annotations

import re
from collections.abc import Callable

import pandas as pd
import pytest

from traps_pipeline.protocol.datasets import ARMS, DATASETS, GRADED, TWO_EVENTS, UNPAIRED, VARIATIONS, sides_of
from traps_pipeline.report.result_frames import Results
from traps_pipeline.report.tables.hypothesis_tables import hypotheses as printed
from traps_pipeline.scoring.doses import DATASETS_READ, HYPOTHESES, hypotheses, wrong_rows

Rows = Callable[..., pd.DataFrame]


def of(rows: Rows, dataset: str, pairs: list[tuple[bool, bool, bool]], first: int = 0, **cell: object) -> pd.DataFrame:
    """VERDICTS rows of a dataset's own sides; its scenarios are numbered from `first`, as those of other datasets."""
    made = rows(pairs, dataset=dataset, **cell)
    number = made["scenario_id"].str[-4:].astype(int) + first
    made = made.assign(scenario_id=[f"scene-{n:04d}" for n in number])
    return made.loc[made["side"].isin(sides_of(dataset))].reset_index(drop=True)


def table(*parts: pd.DataFrame, offered: int = 2) -> pd.DataFrame:
    verdicts = pd.concat(parts, ignore_index=True)
    return hypotheses(verdicts, dict.fromkeys(verdicts["item_id"], offered), resamples=200)


def test_every_variation_is_a_dose_of_one_hypothesis_and_none_is_an_arm():
    doses = [name for one in HYPOTHESES for dose in one.doses for name in dose.datasets]
    assert {*VARIATIONS} == {*doses} - {*DATASETS} - {*ARMS}
    assert all(doses.count(name) == 1 for name in VARIATIONS)
    assert set(UNPAIRED) == {*ARMS, *VARIATIONS, GRADED, TWO_EVENTS} and not {*ARMS} & {*VARIATIONS}


def test_a_dose_is_compared_with_its_reference_on_the_scenarios_that_both_have(rows: Rows):
    yes, no = (True, False, True), (True, False, False)  # the void is abstained on, or not
    made = table(
        of(rows, "occlusion", [yes, yes, no, no]),
        of(rows, "occluder_grey", [yes, no], first=0),
        of(rows, "occlusion", [yes] * 4, model="occluder-rule"),
        of(rows, "occluder_grey", [no, no], first=0, model="occluder-rule"),
        of(rows, "occlusion", [no] * 4, model="wording-rule"),
        of(rows, "occluder_grey", [no, no], first=0, model="wording-rule"),
    ).set_index(["model", "dose"])
    navy, grey = made.loc[("m", "as in the pairs")], made.loc[("m", "grey")]
    assert (navy["abs_rec"], navy["n_scenarios"]) == (0.5, 4) and pd.isna(navy["change"]) and pd.isna(navy["acc"])
    # On the two scenarios that have a grey panel the model abstains on both navy ones and on one grey one.
    assert (grey["value"], grey["at_reference"], grey["change"]) == (0.5, 1.0, -0.5)
    assert -1.0 < grey["change_ci_low"] < -0.5 < 0.0 < grey["change_ci_high"]  # of two scenarios nothing is certain
    # The rule that reads the navy occluder changes by all there is: such a change shows no understanding.
    assert (grey["rule_changing"], grey["rule_change"]) == ("occluder-rule", -1.0)
    assert (navy["rule"], navy["rule_value"], grey["rule_value"]) == ("occluder-rule", 1.0, 0.0)
    assert wrong_rows(made.reset_index()) == 0
    for column, value in (("change", -0.5), ("value", 0.25), ("abs_rec", 1.5)):
        assert wrong_rows(made.reset_index().assign(**{column: value})) > 0, column


def test_what_shows_the_outcome_through_its_panel_counts_as_no_void(rows: Rows):
    made = table(
        of(rows, "occlusion", [(True, False, True)] * 2),
        of(rows, "occluder_alpha_50", [(True, False, True), (False, True, True)]),
    ).set_index("dose")
    sheer = made.loc["alpha 0.5"]
    assert sheer["counts_as"].startswith("no void") and pd.isna(sheer["abs_rec"]) and pd.isna(sheer["j"])
    assert (sheer["acc"], sheer["false_abs"], sheer["value"], sheer["change"]) == (0.5, 0.5, 0.5, -0.5)


def test_j_accuracy_and_chance_of_numbers_of_answers(rows: Rows):
    two = of(rows, "labels_two", [(True, False, True), (True, False, False)])
    six = of(rows, "labels_six", [(True, True, True), (False, False, True)])
    verdicts = pd.concat([two, six], ignore_index=True)
    offered = {id_: 2 if id_.startswith("labels_two") else 6 for id_ in verdicts["item_id"]}
    made = hypotheses(verdicts, offered, resamples=50).set_index("dose")
    first, last = made.loc["2 answers"], made.loc["6 answers"]
    assert (first["acc"], first["abs_rec"], first["false_abs"], first["j"], first["chance"]) == (1, 0.5, 0, 0.5, 0.5)
    assert (last["acc"], last["abs_rec"], last["false_abs"], last["j"]) == (0.5, 1, 0.5, 0.5)
    assert last["chance"] == pytest.approx(1 / 6) and last["change"] == 0
    assert first["rule"] is None and last["rule_change"] is None  # no rule was asked


def test_doses_of_two_campaigns_are_not_compared(rows: Rows):
    pair = [(True, False, True)]
    made = table(of(rows, "labels_two", pair), of(rows, "labels_six", pair, epoch="e2")).set_index("dose")
    assert re.findall(r"\be\d\b", made.loc["6 answers", "refused"]) == ["e2", "e1"]
    assert pd.isna(made.loc["6 answers", "change"]) and made.loc["6 answers", "j"] == 1


def test_pairs_alone_have_no_doses_and_the_report_says_not_run(rows: Rows):
    made = table(of(rows, "occlusion", [(True, False, True)]), of(rows, "chaotic", [(True, False, True)]))
    assert made.empty and {*DATASETS_READ}.isdisjoint({"occlusion_ill_posed", "chaotic_ill_posed"})

    class Study(Results):
        is_study = True

    for one in printed(Study()):
        assert one.cells == [] and "traps run hypotheses" in one.why


def test_the_report_has_an_interval_and_a_rule_beside_each_number(rows: Rows):
    yes, no = (True, False, True), (True, False, False)
    made = table(of(rows, "labels_two", [yes, no]), of(rows, "labels_six", [yes, yes]))

    class Study(Results):
        is_study = True

    study = Study()
    study.hypotheses = made
    answers = next(one for one in printed(study) if one.name == "hypothesis_answer_space")
    cells = dict(zip([column.heading for column in answers.columns], answers.cells[1], strict=True))
    assert cells["AbsRec %"].startswith("100.0 [") and cells["AbsRec %"].endswith(", 100.0]")
    assert cells["AbsRec %"] != "100.0 [100.0, 100.0]" and cells["Change of J"].startswith("50.0 [")
    assert cells["Best rule’s J %"] == cells["Largest change of a rule"] == "not run"
