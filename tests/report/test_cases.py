"""The cases that the paper describes in words are found in a study's verdicts, and nothing else is."""

from __future__ import annotations

import pandas as pd

from traps_pipeline.report.cases import COLUMNS, READ, cases

THINKS, SPEAKS = "qwen3-vl-think", "qwen3-vl-instruct"


def verdict(dataset, side, abstained, model=THINKS, regime="standard", run=1, scenario="plinko-0001"):
    item = f"{dataset}:{scenario}:{side}"
    return dict(zip(READ, (item, scenario, "plinko", side, dataset, model, regime, run, abstained), strict=True))


def found(*rows):
    table = cases(pd.DataFrame(rows))
    assert list(table) == COLUMNS
    return [(r["kind"], r["left_item_id"], r["left_model"], r["left_regime"], r["right_item_id"], r["right_model"],
              r["right_regime"]) for r in table.to_dict("records")]  # fmt: skip


def test_cases_are_the_pairs_that_show_the_papers_findings():
    control, void, textual = (
        "chaotic:plinko-0001:control",
        "chaotic:plinko-0001:void",
        "chaotic_ill_posed:plinko-0001:void",
    )
    std, gui = "standard", "guided"
    inverted = found(verdict("chaotic", "control", True), verdict("chaotic", "void", False))
    assert inverted == [("inverted", control, THINKS, std, void, THINKS, std)]
    flipped = found(verdict("chaotic", "void", False), verdict("chaotic", "void", True, regime="guided"))
    assert flipped == [("flipped", void, THINKS, std, void, THINKS, gui)]
    asked = found(verdict("chaotic", "void", False), verdict("chaotic_ill_posed", "void", True))
    assert asked == [("textual", void, THINKS, std, textual, THINKS, std)]
    members = found(verdict("chaotic", "void", False), verdict("chaotic", "void", True, model=SPEAKS))
    assert members == [("thinking", void, THINKS, std, void, SPEAKS, std)]


def test_answers_of_other_runs_scenes_or_without_a_decision_make_no_case():
    void = verdict("chaotic", "void", False)
    assert found(void, verdict("chaotic", "control", True, run=2)) == []
    assert found(void, verdict("chaotic", "control", True, scenario="plinko-0002")) == []
    assert found(void, verdict("chaotic", "control", None)) == []
    assert found(void, verdict("chaotic", "control", False), verdict("occlusion_ill_posed", "void", True)) == []
    # An abstention under standard that guided loses is no flip of the kind.
    assert found(verdict("chaotic", "void", True), verdict("chaotic", "void", False, regime="guided")) == []
