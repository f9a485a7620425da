"""kill -9, two runs at once, Ctrl-C: a call is paid for once, and nothing that was answered is lost."""

from __future__ import annotations

import os
import random
import re
import signal
import sqlite3
import subprocess
import sys
import time
from contextlib import closing

import pytest

from tests.build.studies import ONE_REGIME, assert_same_tables
from tests.conftest import EXPERIMENT, Checkout
from traps_pipeline.base.databases import NO_SPACE

pytestmark = pytest.mark.slow
ANSWERS, VOTES = 192, 864  # 4 models x 1 regime x 48 items; 4.5 votes an item


def rows_written(study: Checkout, kind: str) -> int:
    return len(study.ledger_values(kind, "id"))


def start(study: Checkout) -> subprocess.Popen[str]:
    return study.start(sys.executable, "-m", "traps_pipeline.cli", "run", ONE_REGIME, "--until", "leaderboard")


def wait_for_rows(study: Checkout, process: subprocess.Popen[str], kind: str, count: int) -> None:
    while (written := rows_written(study, kind)) < count:
        assert process.poll() is None, process.communicate()
        time.sleep(0.002 if written else 0.02)  # it takes seconds to begin, and then moments


@pytest.mark.promise
def test_kills_while_answering_and_voting_leave_the_same_tables_and_no_call_is_made_twice(
    unasked: Checkout, one_regime: Checkout
) -> None:
    first, second = sorted(random.Random(20261121).sample(range(10, ANSWERS - 60), 2))
    for kind, moment, all_of_them in (("answers", first, ANSWERS), ("answers", second, ANSWERS), ("votes", 300, VOTES)):
        process = start(unasked)
        wait_for_rows(unasked, process, kind, moment)
        os.killpg(process.pid, signal.SIGKILL)
        process.communicate()
        assert rows_written(unasked, kind) < all_of_them  # killed in the middle, not after the end
    unasked.score(ONE_REGIME).ok()
    for kind, wanted in (("answers", ANSWERS), ("votes", VOTES)):
        keys = [row["key"] for row in unasked.ledger_rows(kind)]
        assert len(keys) == len(set(keys)) == wanted
    assert_same_tables(unasked.workspace, one_regime.workspace)


@pytest.mark.promise
def test_a_history_that_cannot_be_written_in_mid_evaluation_ends_the_run_and_loses_nothing(
    unasked: Checkout, one_regime: Checkout
) -> None:
    """Dagster drops a step whose event it cannot store, in the middle of its calls."""
    (history,) = (unasked.workspace / "dagster").rglob("runs/index.db")
    of_answers = """WHEN NEW.dagster_event_type = 'ASSET_MATERIALIZATION' AND NEW.asset_key = '["responses"]'"""
    with closing(sqlite3.connect(history)) as database:
        database.execute(
            f"CREATE TRIGGER full BEFORE INSERT ON event_logs {of_answers} "
            "BEGIN SELECT RAISE(ABORT, 'database or disk is full'); END"
        )
        database.commit()
        stopped = unasked.score(ONE_REGIME)
        assert stopped.code == 1 and str(history) in stopped.err and NO_SPACE in stopped.err, stopped.err
        assert not re.search("sqlalche|sqlite3|SQL", stopped.out + stopped.err), stopped.err
        database.execute("DROP TRIGGER full")
        database.commit()
    assert rows_written(unasked, "answers") > 0  # cells are asked ahead of their events: of these few all may be
    assert rows_written(unasked, "votes") == 0  # the run ended in the stage whose event was lost
    unasked.score(ONE_REGIME).ok()
    keys = [row["key"] for row in unasked.ledger_rows("answers")]
    assert len(keys) == len(set(keys)) == ANSWERS
    assert_same_tables(unasked.workspace, one_regime.workspace)


def test_two_runs_that_want_the_same_keys_ask_each_once(unasked: Checkout) -> None:
    by_dagster = unasked.start(
        *(sys.executable, "-m", "dagster", "asset", "materialize", "-m", "traps_pipeline.definitions"),
        *("--select", "responses", "--partition-range"),
        "occlusion|oracle__standard__run1...chaotic_ill_posed|prior__json__run1",
    )
    wait_for_rows(unasked, by_dagster, "answers", 1)
    by_traps = start(unasked)
    out, err = by_traps.communicate()
    assert by_traps.returncode == 0, err
    asked, cached = map(int, re.search(r"(\d+) answers? asked \((\d+) ", out).groups())  # type: ignore[union-attr]
    assert asked + cached <= ANSWERS  # cells that the other run had finished by then are fresh, and not looked into
    assert asked < ANSWERS  # the other run's answers were used
    _, err = by_dagster.communicate()
    assert by_dagster.returncode == 0, err[-3000:]
    keys = [row["key"] for row in unasked.ledger_rows("answers")]
    assert len(keys) == len(set(keys)) > ANSWERS


def test_a_kill_while_rendering_leaves_whole_clips_that_are_not_drawn_again(study: Checkout) -> None:
    clips = list((study.workspace / "clips").glob("domino_chain-000[123]/*"))
    for path in clips:
        path.unlink()
    process = study.start(sys.executable, "-m", "traps_pipeline.cli", "run", EXPERIMENT)
    while not list((study.workspace / "clips").glob("domino_chain-000[123]/*.json")):
        assert process.poll() is None, process.communicate()
        time.sleep(0.01)
    os.killpg(process.pid, signal.SIGKILL)
    process.communicate()
    time.sleep(1.5)  # a worker looks for its parent every second
    done = len(list((study.workspace / "clips").glob("domino_chain-000[123]/*.json")))
    assert 0 < done < 9
    finished = study.score(EXPERIMENT).ok()
    assert finished.counts()["frames"] == 50 * (9 - done)
    assert sorted(
        path for path in (study.workspace / "clips").glob("domino_chain-000[123]/*") if "part" not in path.name
    ) == sorted(clips)


def test_ctrl_c_drains_and_the_same_command_goes_on(unasked: Checkout, one_regime: Checkout) -> None:
    process = start(unasked)
    wait_for_rows(unasked, process, "answers", 100)
    os.kill(process.pid, signal.SIGINT)
    _, err = process.communicate()
    assert process.returncode == 130, err
    assert "traps: " in err and "Traceback" not in err
    assert 100 <= rows_written(unasked, "answers") < ANSWERS
    unasked.score(ONE_REGIME).ok()
    assert len(unasked.ledger_rows("answers")) == ANSWERS
    assert_same_tables(unasked.workspace, one_regime.workspace)
