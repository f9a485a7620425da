"""Conjunction, robust figure and inference against figures worked out by hand, and against rules that cannot pass."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from tests.build.errors import raises
from tests.build.verdicts import of_arm, write
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.pipeline.stages import scoring_stages
from traps_pipeline.protocol.datasets import DATASETS
from traps_pipeline.scoring.metrics import decision_counts
from traps_pipeline.scoring.robust import conjunction_of, robust, wrong_rows
from traps_pipeline.scoring.score_rows import ROBUST
from traps_pipeline.storage.parquet import TableStore
from traps_pipeline.storage.study import Study
from traps_pipeline.storage.workspace import Workspace

Rows = Callable[..., pd.DataFrame]
Pairs = list[tuple[Any, ...]]
RIGHT, SHY, BOLD = (True, False, True), (False, True, True), (True, False, False)  # BOLD never abstains


def cells(rows: Rows, dataset: str, pairs: Pairs, **cell: Any) -> pd.DataFrame:
    """VERDICTS rows of a dataset or arm. Categories and scenarios are as the benchmark has them; those of an arm are
    occlusion's."""
    chaotic = dataset.startswith("chaotic")
    made = of_arm(rows, dataset, pairs, categories=("plinko",) if chaotic else ("hidden",), **cell)
    numbers = made["scenario_id"].str.rpartition("-")[2]
    return made.assign(scenario_id=("plinko-" if chaotic else "hidden_drop-") + numbers)


def study(rows: Rows, pairs: Pairs, arms: dict[str, Pairs], **cell: Any) -> pd.DataFrame:
    """All four datasets with the same pairs, and arms."""
    parts = {**dict.fromkeys(DATASETS, pairs), **arms}
    return pd.concat([cells(rows, name, of, **cell) for name, of in parts.items()], ignore_index=True)


def only(table: pd.DataFrame) -> Any:
    assert len(table) == 1
    assert wrong_rows(table) == 0
    return table.iloc[0]


# --- conjunction ------------------------------------------------------------------------------------------------------

CLIPS, QUESTIONS = ("control", "twin", "void"), ("own", "aside", "foreign")
ASKED = {  # dataset and side of a decision: the clip and the question that it is on
    ("occlusion", "control"): ("control", "own"),
    ("occlusion", "void"): ("void", "own"),
    ("twin_control", "control"): ("twin", "own"),
    ("crossed", "control"): ("void", "aside"),
    ("crossed", "void"): ("control", "foreign"),
}


def conjunction(abstains: Mapping[tuple[str, str], np.ndarray]) -> np.ndarray:
    """Return whether all is right (n,), for n models of one scenario: whether each abstains on a clip and question
    (n,). They answer rightly."""
    parts = [
        pd.DataFrame({"dataset": dataset, "side": side, "abstained": abstains[asked]}).rename_axis("scenario_id")
        for (dataset, side), asked in ASKED.items()
    ]
    verdicts = pd.concat(parts).reset_index()
    verdicts["correct"] = (~verdicts["abstained"]).where(verdicts["side"] == "control")
    about = verdicts[["scenario_id", "dataset", "side"]]
    return conjunction_of(pd.concat([about, decision_counts(verdicts)], axis=1)).to_numpy(float)


def test_two_classifiers_that_never_meet_pass_no_scenario_however_they_are_joined() -> None:
    # All of 2^3 decisions by the clip with all of 2^3 by the question; a rule of both that only rises with either.
    bits = np.array(list(product([False, True], repeat=6)))
    clip, question = dict(zip(CLIPS, bits.T[:3], strict=True)), dict(zip(QUESTIONS, bits.T[3:], strict=True))
    joined = {"or": np.logical_or, "and": np.logical_and, "clip": lambda f, g: f, "question": lambda f, g: g}
    for name, join in joined.items():
        decisions = {(c, q): join(clip[c], question[q]) for c, q in ASKED.values()}
        assert not conjunction(decisions).any(), name
    related = {(c, q): np.logical_xor(clip[c], question[q]) for c, q in ASKED.values()}
    assert conjunction(related).any()  # what relates clip and question can pass


def test_added_evidence_passes_one_of_two_partners_at_most() -> None:
    # The foreign question of each is the own question of the other: evidence of one text serves both.
    rng = np.random.default_rng(0)
    clips = {(s, c): rng.normal(size=20_000) for s in range(2) for c in CLIPS}
    own = {(s, q): rng.normal(size=20_000) for s in range(2) for q in ("own", "aside")}
    passed = []
    for s in range(2):
        questions = {"own": own[s, "own"], "aside": own[s, "aside"], "foreign": own[1 - s, "own"]}
        passed.append(conjunction({(c, q): clips[s, c] + questions[q] > 0 for c, q in ASKED.values()}) == 1)
    assert passed[0].any() and passed[1].any()
    assert not (passed[0] & passed[1]).any()


def test_the_conjunction_is_the_share_of_scenarios_with_all_right(rows: Rows) -> None:
    # Scenarios 1 to 5 of occlusion: all right; the void answered; the crossed void answered; the twin undecided, all
    # else right (not decided); the twin undecided and the control wrong. The sixth has no crossed questions.
    pairs = [RIGHT, BOLD, RIGHT, RIGHT, (False, False, True), RIGHT]
    twins = [RIGHT, RIGHT, RIGHT, (None, None, None), (None, None, None), RIGHT]
    crossed = [RIGHT, RIGHT, BOLD, RIGHT, RIGHT]
    row = only(robust(study(rows, pairs, {"twin_control": twins, "crossed": crossed}), 200))
    assert (row.conjunction, row.n_conjunction) == (1 / 4, 4)
    assert row.conjunction_ci_low < 0.02 < 1 / 4 < row.conjunction_ci_high
    # One right of four; nobody is seen who is like the unseen: the interval of Clopper and Pearson is [0.006, 0.806].
    assert (row.conjunction_ci_low, row.conjunction_ci_high) == pytest.approx((0.006, 0.806), abs=0.09)
    without = only(robust(study(rows, pairs, {"crossed": crossed}), 20))
    assert np.isnan(without.conjunction) and without.n_conjunction == 0


# --- robust and inference ---------------------------------------------------------------------------------------------


def test_a_kind_weighs_as_the_pairs_from_thirty_scenarios_on(rows: Rows) -> None:
    # Pairs: Acc 1, FalseAbs 0, AbsRec 1. Decoys, abstained on: Acc 0, FalseAbs 1, of weight 1.
    # Acc = (1 + 0) / 2, FalseAbs = (0 + 1) / 2, AbsRec = 1: 1/2 x (1 - 1/2) = 1/4.
    row = only(robust(study(rows, [RIGHT] * 40, {"decoy": [SHY] * 30}), 20))
    assert row.robust == pytest.approx(1 / 4)
    assert (row.arms, row.n_runs, row.n_items, row.n_missing) == (["decoy"], 1, 2 * 80 + 30, 0)


def test_what_words_alone_give_away_enters_no_figure_but_pecs(rows: Rows) -> None:
    # Abstaining on each ill-posed question and on nothing else: PECS 1/2, as half of the datasets have J 1 and Acc 1.
    datasets = {name: [RIGHT if name.endswith("ill_posed") else BOLD] * 30 for name in DATASETS}
    by_words = [cells(rows, name, of) for name, of in (datasets | {"crossed": [BOLD] * 30}).items()]
    row = only(robust(pd.concat(by_words, ignore_index=True), 20))
    assert (row.robust, row.n_items) == (0.0, 3 * 60)


def test_a_kind_of_few_scenarios_weighs_less(rows: Rows) -> None:
    # Three decoys weigh 1/10, five crossed scenarios 1/6: their controls are right, two of their five voids answered.
    # Acc = (1 + 0 + 1/6) / (1 + 1/10 + 1/6) = 35/38, FalseAbs = (1/10) / (38/30) = 3/38,
    # AbsRec = (1 + 1/6 x 3/5) / (1 + 1/6) = 33/35.
    arms = {"decoy": [SHY] * 3, "crossed": [RIGHT] * 3 + [BOLD] * 2}
    row = only(robust(study(rows, [RIGHT] * 8, arms), 20))
    assert row.robust == pytest.approx(35 / 38 * (33 / 35 - 3 / 38))


def test_a_run_whose_j_is_negative_counts_as_nothing(rows: Rows) -> None:
    # Run 1: J = 1 - 1/2, Acc 1/2, as above: 1/4. Run 2: controls abstained on, voids answered: J < 0, so 0, not less.
    wrong = (False, True, False)
    runs = [
        study(rows, [RIGHT] * 30, {"decoy": [SHY] * 30}, run=1),
        study(rows, [wrong] * 30, {"decoy": [SHY] * 30}, run=2),
    ]
    row = only(robust(pd.concat(runs, ignore_index=True), 20))
    assert row.robust == pytest.approx(1 / 8)


def test_what_must_be_inferred_enters_neither_figure(rows: Rows) -> None:
    arms = {"decoy": [RIGHT] * 30, "late_occluder": [SHY, SHY, RIGHT], "predictable_cut": [(False, False, None)]}
    row = only(robust(study(rows, [RIGHT] * 30, arms), 20))
    assert (row.robust, row.inference_acc, row.inference_abstains) == (1.0, 1 / 4, 1 / 2)
    alone = only(robust(study(rows, [RIGHT] * 3, {"late_occluder": [RIGHT]}), 20))
    assert np.isnan([alone.robust, alone.robust_ci_low, alone.conjunction]).all() and alone.inference_acc == 1.0


def test_an_entry_rests_on_the_runs_that_have_most_arms(rows: Rows) -> None:
    # Run 1 alone has the twins, run 3 no arm, run 4 lacks a dataset.
    one = study(rows, [RIGHT], {"decoy": [RIGHT], "twin_control": [RIGHT]}, run=1)
    others = [study(rows, [BOLD], {"decoy": [SHY]}, run=2), study(rows, [BOLD], {}, run=3)]
    partial = study(rows, [BOLD], {"decoy": [SHY], "twin_control": [BOLD]}, run=4)
    partial = partial.loc[partial["dataset"] != "chaotic"]
    row = only(robust(pd.concat([one, *others, partial], ignore_index=True), 20))
    assert (row.arms, row.n_runs, row.robust) == (["decoy", "twin_control"], 1, 1.0)


def test_a_model_without_arms_or_without_all_datasets_has_no_row(rows: Rows) -> None:
    without = study(rows, [RIGHT], {}, model="none")
    partial = pd.concat([cells(rows, name, [RIGHT], model="partial") for name in (*DATASETS[:3], "decoy")])
    whole = study(rows, [RIGHT], {"decoy": [RIGHT]}, model="whole")
    table = robust(pd.concat([without, partial, whole], ignore_index=True), 20)
    assert list(table["model"]) == ["whole"]
    assert robust(without, 20).empty


def test_a_figure_without_a_decided_item_is_null(rows: Rows, tmp_path: Path) -> None:
    table = robust(study(rows, [RIGHT], {"crossed": [(True, False, None)]}), 20)
    row = only(table)
    assert np.isnan([row.robust, row.robust_ci_low]).all()
    assert row.n_missing == 1
    TableStore(tmp_path).write(ROBUST, {}, table, {})


def test_a_scenarios_items_in_pairs_and_arm_are_drawn_together(rows: Rows) -> None:
    # Decoys are answered rightly where the occlusion controls are not, and the reverse: their mean never varies, so the
    # interval is narrower than with decoys that agree with the pairs.
    even, odd = ([(k % 2 == rest, False, True) for k in range(60)] for rest in (0, 1))
    pairs = [cells(rows, name, even if name == "occlusion" else [RIGHT] * 60) for name in DATASETS]
    against, alike = (only(robust(pd.concat([*pairs, cells(rows, "decoy", of)]), 300)) for of in (odd, even))
    width = {name: row.robust_ci_high - row.robust_ci_low for name, row in (("against", against), ("alike", alike))}
    assert against.robust == alike.robust == pytest.approx(5 / 8)
    assert width["against"] < 0.8 * width["alike"]


def test_pairs_and_arms_of_different_campaigns_are_not_joined(rows: Rows, tmp_path: Path) -> None:
    verdicts = pd.concat([study(rows, [RIGHT], {}), cells(rows, "decoy", [RIGHT], epoch="e2")], ignore_index=True)
    table = robust(verdicts, 20)
    row = only(table)
    assert (row.robust, row.conjunction, row.epoch) == (None, None, "e1+e2")
    assert re.findall(r"\be\d\b", row.refused) == ["e1", "e2"]
    TableStore(tmp_path).write(ROBUST, {}, table, {})


@pytest.mark.parametrize("arms", [{}, {"decoy": [SHY], "twin_control": [RIGHT]}])
def test_the_stage_writes_a_table_with_arms_and_an_empty_one_without(
    rows: Rows, tmp_path: Path, arms: dict[str, Pairs]
) -> None:
    workspace = Workspace.create(tmp_path / "study", Study(scenarios=["plinko-0001"]))
    with raises(TrapsError, "pipeline.stages.scoring_stages.robust"):
        scoring_stages.robust.make(workspace, None)
    write(workspace, study(rows, [RIGHT], arms))
    made = scoring_stages.robust.make(workspace, None)
    assert scoring_stages.robust.checks[0].wrong(workspace, None, made) == ""
    workspace.tables.write(ROBUST, {}, made.frame, {})
    assert [list(row.arms) for row in workspace.tables.read(ROBUST, {}).itertuples()] == ([list(arms)] if arms else [])
