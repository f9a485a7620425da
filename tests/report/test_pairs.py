"""The figures of pairs: six pairs, and the worked example with both answers."""

from __future__ import annotations

import pandas as pd

from tests.report.test_report import pair_rows
from traps_pipeline.report.contact_sheet import chosen_pairs, six_pairs
from traps_pipeline.report.worked_example import chosen_example, example_figure, reading
from traps_pipeline.report.writing import figure_bytes


def test_six_pairs_are_of_six_sub_scenarios_occlusion_first(tmp_path):
    scenes = {"chaotic": ("plinko-0", "plinko-1", "dice-0", "seesaw-0"), "occlusion": ("race-0", "chain-0", "chain-1")}
    items = pd.concat(
        pd.DataFrame(pair_rows(scene, tmp_path, frames=2, kept=2, dataset=name)).assign(
            taxonomy=name, category=scene[:4]
        )
        for name, of in scenes.items()
        for scene in of
    )
    chosen = chosen_pairs(six_pairs(items), None)
    # Three of the chaotic ones; the second chain is no further family, so occlusion has two.
    assert [pair.at["void", "scenario_id"] for pair in chosen] == [
        "chain-0",
        "race-0",
        "dice-0",
        "plinko-0",
        "seesaw-0",
    ]


def test_the_worked_example_is_a_pair_with_both_answers_and_their_verdicts(tmp_path):
    def verdict(pair, sub_scenario, side, abstained, correct, model="gemini-2.5-pro"):
        ids = {"pair_id": pair, "model": model, "run": 1, "dataset": "chaotic", "side": side}
        return {**ids, "sub_scenario": sub_scenario, "abstained": abstained, "correct": correct}

    rows = [
        *(verdict("a", "plinko", side, side == "void", side == "control") for side in ("control", "void")),
        *(verdict("b", "seesaw_sorter", side, False, side == "control") for side in ("control", "void")),
        verdict("c", "seesaw_sorter", "control", False, True),  # its void has no verdict
        *(verdict("d", "seesaw_sorter", side, False, False) for side in ("control", "void")),  # a wrong control
    ]
    chosen = chosen_example(pd.DataFrame(rows))
    assert (chosen["pair_id"], chosen["side"]) == ("b", "control")
    assert chosen_example(pd.DataFrame(rows[4:5])) is None
    votes = [{"valid": True, "task": "abstention", "abstained": k == 0, "extracted_value": None} for k in range(3)]
    votes += [{"valid": k > 0, "task": "correctness", "abstained": None, "extracted_value": "left"} for k in range(3)]
    words = reading("It goes left.", votes, rows[2])
    assert words[1:] == [
        "Reading: 1 of 3 judges read an abstention; they extract left.", "Verdict: answered, correct.",
    ]  # fmt: skip
    assert reading("Left.", votes[:3], rows[3])[2] == "Verdict: answered, though the outcome cannot be known."
    pair = pd.DataFrame(pair_rows("plinko-0", tmp_path, kept=5)).set_index("side")
    figure = example_figure(pair, {"control": words, "void": words}, tmp_path, "a model")
    assert figure_bytes(figure).startswith(b"\x89PNG")
