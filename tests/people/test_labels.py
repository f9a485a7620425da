"""What people are given, and what becomes of their labels: samples by stratum, orders, changed answers, agreement."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from tests.build.errors import raises
from traps_pipeline.base.digests import digest
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.judging.agreement import krippendorff_alpha
from traps_pipeline.people.human_label_rows import HUMAN_LABELS, LABELS_FILE, labels_version
from traps_pipeline.people.label_units import annotation_protocol, drawn_units, personal_order
from traps_pipeline.people.labels import confabulation_rows, human_agreement, label_lines, label_matrix, true_labels
from traps_pipeline.storage.lines import line_with_checksum

PROTOCOL = annotation_protocol()


def group(n: int, n_split: int) -> pd.DataFrame:
    return pd.DataFrame({"unit": [f"u{k}" for k in range(n)], "split": [k < n_split for k in range(n)]})


@pytest.mark.parametrize(("n_split", "least_split"), [(0, 0), (3, 3), (60, 10)])
def test_a_sample_is_the_first_units_of_each_stratum_in_a_seeded_order(n_split: int, least_split: int) -> None:
    whole = group(200, n_split)
    chosen = drawn_units(whole, 20, PROTOCOL)
    assert len(chosen) == len(set(chosen["unit"])) == 20
    assert int(chosen["split"].sum()) >= least_split
    for split, stratum in whole.groupby("split"):
        ordered = sorted(stratum["unit"], key=lambda unit: digest([PROTOCOL.seed, unit]))
        own = set(chosen.loc[chosen["split"] == split, "unit"])
        assert own == set(ordered[: len(own)])  # so that labels of a stratum are a random sample of it
    shuffled = drawn_units(whole.sample(frac=1, random_state=1), 20, PROTOCOL)
    assert set(shuffled["unit"]) == set(chosen["unit"])
    assert len(drawn_units(whole.head(7), 20, PROTOCOL)) == 7


def test_each_person_has_an_order_of_their_own_over_the_same_units() -> None:
    sampled = group(30, 0)
    jd, ab = personal_order("jd", sampled), personal_order("ab", sampled)
    assert sorted(jd) == sorted(ab) == sorted(sampled["unit"])
    assert jd != ab and jd == personal_order("jd", sampled.iloc[::-1])


# --- labels -----------------------------------------------------------------------------------------------------------


def line(seq: int, **own: Any) -> bytes:
    row = {"seq": seq, "task": "abstention", "unit": "u1", "who": "jd", "at": "2026-11-22T12:00:00+00:00"}
    return line_with_checksum(row | {"seconds": 3.5, "label": {"abstained": True}} | own)


def test_labels_are_read_as_written_and_damage_is_named(tmp_path: Path) -> None:
    assert (label_lines(tmp_path), labels_version(tmp_path)) == ([], "not run")
    file = tmp_path / LABELS_FILE
    file.write_bytes(line(1) + line(2, who="ab") + line(3, unit="u2")[:40])  # the last one was never confirmed
    assert [(each.seq, each.who) for each in label_lines(tmp_path)] == [(1, "jd"), (2, "ab")]
    file.write_bytes(line(1).replace(b"jd", b"ab") + line(2))
    with raises(TrapsError, "people.labels.label_lines", "labels.jsonl:1: "):
        label_lines(tmp_path)
    file.write_bytes(line(1, label={"correct": True}))
    with raises(TrapsError, "people.labels.label_lines", "labels.jsonl", "abstained"):
        label_lines(tmp_path)


def labels(*rows: tuple[str, str, str, bool | None]) -> pd.DataFrame:
    """HUMAN_LABELS rows of task, unit, annotator and decision."""
    made = [
        {"task": task, "unit": unit, "annotator": who, "seconds": 2.0, "panel": True}
        | {"correct" if task == "correctness" else "abstained": decision}
        for task, unit, who, decision in rows
    ]
    return pd.DataFrame(made, columns=pd.Index(HUMAN_LABELS.names)).astype(object)


def test_agreement_is_over_what_two_people_labelled() -> None:
    given = labels(
        ("abstention", "u1", "jd", True), ("abstention", "u1", "ab", True), ("abstention", "u1", "cy", False),
        ("abstention", "u2", "jd", False), ("abstention", "u2", "ab", False),
        ("abstention", "u3", "jd", True),
        ("correctness", "u9", "jd", True)
    )  # fmt: skip
    table = human_agreement(given).set_index("task")
    row = table.loc["abstention"]
    assert (row["n_labels"], row["n_units"], row["n_shared"], row["annotators"]) == (6, 3, 2, "ab+cy+jd")
    assert row["agreement"] == pytest.approx(2 / 4)  # of u1 one pair of three agrees, of u2 the only one
    assert row["alpha"] == pytest.approx(krippendorff_alpha(np.array([[1, 0, 1], [0, -1, 0], [-1, -1, 1]])))
    given_on_abstention = given.loc[given["task"] == "abstention"]
    assert label_matrix(given_on_abstention, "abstained").tolist() == [[1, 0, 1], [0, -1, 0], [-1, -1, 1]]
    assert (row["decision"], pd.isna(row["undefined"])) == ("abstained", True)
    assert row["seconds"] == given_on_abstention["seconds"].median()
    same = labels(("abstention", "u1", "jd", True), ("abstention", "u1", "ab", True))
    assert human_agreement(same).loc[0, "agreement"] == 1.0
    reasons = {human_agreement(same).loc[0, "undefined"], table.loc["correctness", "undefined"]}
    assert len(reasons - {None}) == 2
    assert human_agreement(given.iloc[:0]).empty


def test_most_people_decide_and_a_tie_decides_nothing() -> None:
    given = labels(
        ("abstention", "u1", "jd", True), ("abstention", "u1", "ab", True), ("abstention", "u1", "cy", False),
        ("abstention", "u2", "jd", False), ("abstention", "u2", "ab", True)
    )  # fmt: skip
    assert true_labels(given, "abstention").set_index("unit")["truth"].to_dict() == {"u1": True, "u2": None}
    with raises(ValueError, "people.labels.true_labels"):
        true_labels(given, "answerability")


def test_labels_of_confabulation_are_written_of_failures_that_everybody_labelled() -> None:
    axes = ("hallucinated_premise", "invalid_inference", "epistemic_surrender", "doubt_in_reasoning")
    given = labels(*(("confabulation", unit, who, None) for unit, who in (("s1", "jd"), ("s1", "ab"), ("s2", "jd"))))
    given[[*axes]] = [[True, False, True, False]] * 3
    rows = confabulation_rows(given)
    assert [(row["annotator"], row["sample_id"]) for row in rows] == [("ab", "s1"), ("jd", "s1")]
    assert [rows[0][axis] for axis in axes] == ["1", "0", "1", "0"]
    with raises(TrapsError, "people.labels.confabulation_rows"):
        confabulation_rows(given.iloc[:0])
