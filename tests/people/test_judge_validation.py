"""The confabulation judge against two annotators: hand-worked metrics, scikit-learn, and files with mistakes."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from sklearn.metrics import accuracy_score, cohen_kappa_score, precision_recall_fscore_support
from statsmodels.stats.inter_rater import cohens_kappa

from tests.build.errors import raises
from tests.build.labels import GOOD, HEAD, MODEL, labelled_study, written
from tests.conftest import ROOT, Checkout
from tests.judging.conftest import answered_study
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.judging.judging_rows import CONFABULATION, JUDGE_VALIDATION
from traps_pipeline.models.asking.answer_rows import RESPONSES
from traps_pipeline.people.judge_validation import (
    HumanLabels,
    annotation_sheet,
    compare,
    is_degenerate,
    read_labels,
    validation_rows,
)
from traps_pipeline.protocol.cells import Cell, Evaluation
from traps_pipeline.protocol.ratings import AXES
from traps_pipeline.storage.benchmark_tables import ITEMS


def flags(text: str) -> np.ndarray:
    return np.array([letter == "y" for letter in text])


def human(a: Sequence[str], b: Sequence[str]) -> HumanLabels:
    """Labels of two annotators, a string of y and n an axis each."""
    labels = np.array([[flags(axis) for axis in mine] for mine in (a, b)]).transpose(0, 2, 1)
    return HumanLabels(("ann", "bob"), tuple(f"s{k}" for k in range(labels.shape[1])), labels)


def test_every_metric_of_a_fixture_worked_out_by_hand() -> None:
    judge = np.array([flags(axis) for axis in ("yyyyyyyyyy", "yyyyyynnnn", "nnnnnnnnnn", "ynynynynyn")]).T
    rows = compare(
        judge,
        human(
            ("yyyyyyyyyy", "yyyyynnnnn", "ynnnnnnnnn", "ynynynynyn"),
            ("yyyyyyyyyn", "yyyyyyynnn", "nnnnnnnnnn", "ynynynynyn"),
        ),
    ).set_index("axis")
    inference = rows.loc["invalid_inference"]
    # The judge errs once against each. Of its 2 x 6 yes 5 + 6 are confirmed; the annotators say yes 5 + 7 times.
    assert (inference.n_failures, inference.n_labels) == (10, 20)
    assert (inference.accuracy, inference.accuracy_a, inference.accuracy_b) == pytest.approx((0.9, 0.9, 0.9))
    assert (inference.precision, inference.recall, inference.f1) == pytest.approx((11 / 12, 11 / 12, 11 / 12))
    # They agree on 8 of 10; chance 0.5 x 0.7 + 0.5 x 0.3 = 0.5.
    assert (inference.human_agreement, inference.human_kappa) == pytest.approx((0.8, 0.6))
    assert inference.human_kappa_low < 0.6 < inference.human_kappa_high
    surrender = rows.loc["epistemic_surrender"]  # never said by the judge, once by ann, never by bob
    assert np.isnan([surrender.precision, surrender.f1, surrender.human_kappa]).all()
    assert (surrender.recall, surrender.accuracy, surrender.kappa_note) == (0, pytest.approx(19 / 20), "degenerate")
    premise = rows.loc["hallucinated_premise"]
    assert (premise.precision, premise.recall, premise.kappa_note) == (pytest.approx(19 / 20), 1, "degenerate")
    doubt = rows.loc["doubt_in_reasoning"]
    assert (doubt.accuracy, doubt.f1, doubt.human_kappa) == (1, 1, 1)
    assert doubt.human_kappa_low < 0.95 and doubt.human_kappa_high == 1  # ten failures are not all
    assert rows["kappa_note"].notna().sum() == 2
    pooled = rows.loc["pooled"]
    # 80 labels: wrong are 1 on the premise, 2 on the inference, 1 on surrender. The annotators differ on as many of 40.
    assert (pooled.n_labels, pooled.accuracy, pooled.human_agreement) == (80, pytest.approx(76 / 80), 36 / 40)
    assert (pooled.accuracy_a, pooled.accuracy_b) == pytest.approx((38 / 40, 38 / 40))
    assert np.isnan([pooled.precision, pooled.recall, pooled.f1, pooled.human_kappa]).all()


def test_random_labels_give_what_scikit_learn_and_statsmodels_give() -> None:
    rng = np.random.default_rng(8)
    truth = rng.random((100, 4)) < (0.9, 0.7, 0.3, 0.5)
    judge, a, b = (np.where(rng.random((100, 4)) < error, ~truth, truth) for error in (0.1, 0.05, 0.1))
    rows = compare(judge, HumanLabels(("a", "b"), tuple(map(str, range(100))), np.array([a, b]))).set_index("axis")
    for k, axis in enumerate(AXES):
        said, labelled = np.tile(judge[:, k], 2), np.concatenate([a[:, k], b[:, k]])
        precision, recall, f1, _ = precision_recall_fscore_support(labelled, said, average="binary")
        row = rows.loc[axis]
        assert row.accuracy == pytest.approx(accuracy_score(labelled, said))
        assert (row.precision, row.recall, row.f1) == pytest.approx((precision, recall, f1))
        assert row.human_kappa == pytest.approx(cohen_kappa_score(a[:, k], b[:, k]))
        table = np.array([[np.sum((a[:, k] == i) & (b[:, k] == j)) for j in (0, 1)] for i in (0, 1)])
        reference: Any = cohens_kappa(table)
        bounds = (row.human_kappa_low, row.human_kappa_high)
        assert bounds == pytest.approx((reference.kappa_low, reference.kappa_upp), abs=0.06)


@pytest.mark.parametrize(
    ("rare", "degenerate"), [(0, True), (2, True), (3, False), (50, False), (97, False), (98, True)]
)
def test_kappa_is_degenerate_where_a_class_has_two_percent_or_less_of_either_annotators_labels(
    rare: int, degenerate: bool
) -> None:
    one, balanced = np.arange(100) < rare, np.arange(100) % 2 == 0
    assert is_degenerate(one, balanced) is degenerate
    assert is_degenerate(balanced, one) is degenerate


# --- files ------------------------------------------------------------------------------------------------------------


def test_labels_are_read_whatever_their_words_their_order_and_the_other_columns(tmp_path: Path) -> None:
    lines = [f"note,{HEAD}", *(f"x,{line}" for line in reversed(GOOD))]
    found = read_labels(written(tmp_path, *lines), ["s1", "s2", "s3"])
    assert (found.annotators, found.sample_ids) == (("ann", "bob"), ("s1", "s2"))
    assert found.labels.tolist() == [[[True, False, False, True]] * 2] * 2


@pytest.mark.parametrize(
    ("lines", "by", "names"),
    [
        ([HEAD.replace("invalid_inference,", "")], "_lines", ["labels.csv:1: ", " invalid_inference "]),
        ([HEAD, *GOOD[:3], "bob,s2,1,0,2,1"], "_refuse", ["labels.csv:5: epistemic_surrender ", "'2'"]),
        ([HEAD, *GOOD[:3], "bob,s2,1,0,1"], "_refuse", ["labels.csv:5: doubt_in_reasoning ", "''"]),
        ([HEAD, *GOOD[:3], "bob,s9,1,0,1,1"], "_refuse", ["labels.csv:5: sample_id 's9'"]),
        ([HEAD, *GOOD[:3], ",s2,1,0,1,1"], "_refuse", ["labels.csv:5: annotator "]),
        ([HEAD, *GOOD, "bob,s2,0,0,0,0"], "_refuse", ["labels.csv:6: bob ", " s2 ", " 5"]),
        ([HEAD, *GOOD[:3]], "_refuse", ["labels.csv:3: ", " ann ", " s2"]),
        ([HEAD, *GOOD[:2]], "_pair_labels", ["labels.csv: ", " 1 ", "(ann)"]),
        ([HEAD, *GOOD, "cy,s1,1,1,1,1"], "_pair_labels", ["labels.csv: ", " 3 ", "(ann, bob, cy)"]),
        ([HEAD], "_pair_labels", ["labels.csv: ", " 0 "]),
    ],
)
def test_a_wrong_label_file_is_answered_with_line_and_column(
    tmp_path: Path, lines: list[str], by: str, names: list[str]
) -> None:
    with raises(TrapsError, f"people.judge_validation.{by}", *names) as raised:
        read_labels(written(tmp_path, *lines), ["s1", "s2"])
    assert "\n" not in str(raised.value)


def test_a_sheet_is_written_filled_in_and_compared_by_the_commands(tmp_path: Path) -> None:
    texts = ["It goes left.", "=HYPERLINK(1)", 'He said "left",\nthen stopped.', "Hm.<think>Left."]
    workspace = labelled_study(tmp_path / "study", texts)
    sheet, filled, study = tmp_path / "sheet.csv", tmp_path / "filled.csv", Checkout(ROOT, workspace.root)
    assert str(sheet) in study.traps("people", "sheet", sheet).ok().out
    rows = list(csv.DictReader(sheet.open(newline="")))
    assert len(rows) == 4
    assert MODEL not in sheet.read_text() and "chaotic" not in sheet.read_text()
    assert {row["response"] for row in rows} == {"It goes left.", "'=HYPERLINK(1)", texts[2], "Left."}
    assert {row["reasoning_trace"] for row in rows} == {""}  # the judge saw none
    refused = study.traps("people", "sheet", sheet)  # it may hold labels by now
    assert (refused.code, refused.raised) == (1, "people.judge_validation.write_sheet") and str(sheet) in refused.err
    with filled.open("w", newline="") as stream:
        writer = csv.DictWriter(stream, list(rows[0]))
        writer.writeheader()
        for who in ("ann", "bob"):
            said = dict.fromkeys(AXES, "no") | {"hallucinated_premise": "yes", "annotator": who}
            writer.writerows([row | said for row in rows])
    out = study.traps("people", "validate", filled).ok().out
    assert "ann (A)" in out and "bob (B)" in out
    (line,) = (line for line in out.splitlines() if line.startswith("hallucinated_premise"))
    assert line.split() == ["hallucinated_premise", "8", *["1.000"] * 7, "degenerate"]
    kept = workspace.tables.read(JUDGE_VALIDATION, {}).set_index("axis")
    assert kept["accuracy"].tolist() == [1.0] * 5


@pytest.mark.parametrize("gone", ["the answer", "the item"])
def test_labels_of_an_earlier_answer_are_not_put_before_people(tmp_path: Path, gone: str) -> None:
    workspace = labelled_study(tmp_path / "study", ["It goes left."])
    cell = Cell("chaotic", Evaluation(MODEL, "standard", 1))
    table, partition = (RESPONSES, cell.partition) if gone == "the answer" else (ITEMS, {"dataset": "chaotic"})
    rows = workspace.tables.read(table, partition)
    workspace.tables.write(table, partition, rows.assign(text="Right.") if gone == "the answer" else rows[:0], {})
    with raises(TrapsError, "people.judge_validation._sheet_row", "chaotic:s-0000:void"):
        annotation_sheet(workspace)


def test_without_a_labelled_failure_there_is_nothing_to_compare(tmp_path: Path) -> None:
    workspace, labels = answered_study(tmp_path / "study", {}), written(tmp_path, HEAD, *GOOD)
    with raises(TrapsError, "storage.parquet.TableStore._load", "confabulation"):
        validation_rows(workspace, labels)
    workspace.tables.write(CONFABULATION, {}, [], {})
    with raises(TrapsError, "people.judge_validation.validation_rows", str(workspace.root)):
        validation_rows(workspace, labels)
