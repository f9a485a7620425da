"""Bad input ends in a sentence that names the file and the remedy; no table is half-written, no answer is lost."""

from __future__ import annotations

import re
import sqlite3
from contextlib import closing
from pathlib import Path

import pytest

from tests.conftest import EXPERIMENT, Checkout
from traps_pipeline.models.asking.answer_rows import RESPONSES
from traps_pipeline.scoring.score_rows import METRICS
from traps_pipeline.storage.workspace import Workspace

pytestmark = pytest.mark.slow


def test_a_damaged_row_of_the_ledger_is_named_and_its_answer_alone_asked_again(study: Checkout) -> None:
    path = study.workspace / "ledger" / "ledger.sqlite"
    with closing(sqlite3.connect(path)) as opened:
        name = "oracle__json__run1"
        sql = "select min(r.id) from traps_rows r join traps_evaluations e on r.evaluation = e.id where e.name = ?"
        (row,) = opened.execute(sql, [name]).fetchone()
        opened.execute("update traps_rows set content = replace(content, 'answer', 'answes') where id = ?", [row])
        opened.commit()
    for table in (study.workspace / "tables" / "responses").glob("*/oracle/json/*.parquet"):
        table.unlink()
    finished = study.score(EXPERIMENT).ok()
    (note,) = (line for line in finished.err.splitlines() if str(path) in line)
    assert re.search(rf"\b{row}\b", note.partition(str(path))[2])
    assert finished.counts()["answers"] == 1


def test_failed_calls_are_told_counted_as_missing_and_asked_again(study: Checkout, tmp_path: Path) -> None:
    text = (study.root / EXPERIMENT).read_text().replace("[oracle, random-50, prior]", "[flaky]")
    (tmp_path / "flaky.yaml").write_text(text)
    run = study.score(tmp_path / "flaky.yaml")
    assert run.code == 1
    assert re.search(r"responses/\S+\|flaky__\w+__run1: [1-9]", run.err), run.err
    rows = Workspace.open(study.workspace).tables.read_all(RESPONSES, model="flaky")
    outcomes = rows["outcome"].value_counts().to_dict()
    assert set(outcomes) == {"answer", "empty", "refused", "error"}
    assert rows.loc[rows["outcome"] != "answer", "text"].isna().all()  # no failure is a text
    cells = Workspace.open(study.workspace).tables.read_all(METRICS).query("model == 'flaky' and scope == 'all'")
    assert cells["n_missing"].sum() == outcomes["empty"] + outcomes["refused"] + outcomes["error"]
    assert cells["n_refused"].sum() == outcomes["refused"]
    assert (cells["acc"] == 1.0).all()  # an oracle behind a bad provider: what is missing is not wrong
    again = study.score(tmp_path / "flaky.yaml")
    assert again.code == 1
    assert again.counts()["answers"] == outcomes["error"]  # those that failed, and no other
