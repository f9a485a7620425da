"""Decisions of reviewers: appended behind each other, checked before they are written, taken back by further ones."""

from __future__ import annotations

import json
import multiprocessing
import os
import signal
import time
from datetime import date
from pathlib import Path
from typing import Any

import pytest

from tests.build.errors import raises
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.benchmark.corrections import Correction, apply_corrections, read_corrections
from traps_pipeline.benchmark.decisions import (
    FILE,
    DecidedMeanwhile,
    decisions_on,
    is_reviewed,
    save_decision,
    undo_decision,
)
from traps_pipeline.benchmark.records import load_released
from traps_pipeline.scenes.family_registry import get_family

RELEASED = load_released()
ID, OTHER = "domino_chain-0001", "plinko-0003"
BY = {"who": "jd", "when": date(2026, 11, 21), "why": "looked at it"}


def decision(action: str, scenario_id: str = ID, **changes: Any) -> Correction:
    return Correction.model_validate({"scenario_id": scenario_id, "action": action, **changes, **BY})


def benchmark(folder: Path) -> dict[str, Any]:
    """Every scenario's version, and which are there, after the decisions in a folder."""
    return {id_: scenario.version for id_, scenario in apply_corrections(RELEASED, read_corrections(folder)).items()}


def test_a_decision_is_one_line_in_the_format_of_corrections(tmp_path: Path) -> None:
    save_decision(decision("correct", question="Does it fall, yes or no?"), n_seen=0, folder=tmp_path)
    (line,) = (tmp_path / FILE).read_text().splitlines()
    wanted = {"scenario_id": ID, "action": "correct", "question": "Does it fall, yes or no?", "who": "jd"}
    assert json.loads(line) == wanted | {"when": "2026-11-21", "why": "looked at it"}
    assert is_reviewed(decisions_on(ID, tmp_path))


def test_a_decision_that_does_not_fit_is_not_written(tmp_path: Path) -> None:
    with raises(TrapsError, "benchmark.corrections.apply_words", "purple"):
        save_decision(decision("correct", answer="purple"), n_seen=0, folder=tmp_path)
    assert (tmp_path / FILE).read_text() == ""


@pytest.mark.promise
@pytest.mark.parametrize(
    "steps",
    [
        [("keep", {})],
        [("discard", {})],
        [("correct", {"question": "Does it fall, yes or no?"})],
        [("correct", {"question": "First, yes or no?"}), ("correct", {"ill_posed_question": "How heavy is it?"})],
        [("correct", {"question": "First, yes or no?"}), ("discard", {})],
        [("keep", {}), ("discard", {}), ("restore", {}), ("keep", {})],
        [("discard", {}), ("restore", {}), ("correct", {"params": {}, "question": "Now, yes or no?"})],
    ],
)
def test_undoing_brings_back_what_was_before_step_by_step(tmp_path: Path, steps: list[tuple[str, dict]]) -> None:
    states = [(benchmark(tmp_path), False)]
    for action, changes in steps:
        save_decision(decision(action, **changes), n_seen=len(decisions_on(ID, tmp_path)), folder=tmp_path)
        states.append((benchmark(tmp_path), is_reviewed(decisions_on(ID, tmp_path))))
    before = (tmp_path / FILE).read_bytes()
    content, was_reviewed = states[-2]
    undo_decision(ID, len(decisions_on(ID, tmp_path)), who="jd", why="too hasty", folder=tmp_path)
    assert benchmark(tmp_path) == content
    assert is_reviewed(decisions_on(ID, tmp_path)) == was_reviewed
    assert (tmp_path / FILE).read_bytes().startswith(before)  # nothing is rewritten


def test_an_added_scenario_is_taken_back_by_discarding_it(tmp_path: Path) -> None:
    params = dict(RELEASED[ID].params)
    add = decision("add", "domino_chain-9001", family=get_family("domino_chain").name, params=params)
    save_decision(add, n_seen=0, folder=tmp_path)
    assert "domino_chain-9001" in benchmark(tmp_path)
    undo_decision("domino_chain-9001", 1, who="jd", why="not needed", folder=tmp_path)
    assert "domino_chain-9001" not in benchmark(tmp_path)
    with raises(TrapsError, "benchmark.corrections._restore"):
        save_decision(decision("restore", "domino_chain-9001"), n_seen=2, folder=tmp_path)


def test_who_decides_on_what_somebody_else_decided_is_told(tmp_path: Path) -> None:
    save_decision(decision("discard"), n_seen=0, folder=tmp_path)
    with raises(DecidedMeanwhile, "benchmark.decisions._require_known"):
        save_decision(decision("keep"), n_seen=0, folder=tmp_path)
    with pytest.raises(DecidedMeanwhile):
        undo_decision(ID, 0, who="ab", why="no", folder=tmp_path)
    with raises(TrapsError, "benchmark.decisions.undo_decision"):
        undo_decision(OTHER, 0, who="ab", why="no", folder=tmp_path)


def test_a_file_that_would_overrule_reviews_is_named(tmp_path: Path) -> None:
    (tmp_path / "zz.jsonl").write_text("")
    with raises(TrapsError, "benchmark.decisions._open_for_append", "zz.jsonl", "review.jsonl"):
        save_decision(decision("keep"), n_seen=0, folder=tmp_path)


def test_a_torn_line_goes_and_whole_ones_stay(tmp_path: Path) -> None:
    save_decision(decision("keep"), n_seen=0, folder=tmp_path)
    with (tmp_path / FILE).open("ab") as stream:
        stream.write(b'{"scenario_id": "plin')
    save_decision(decision("keep", OTHER), n_seen=0, folder=tmp_path)
    assert [each.scenario_id for _, each in read_corrections(tmp_path)] == [ID, OTHER]


def review_many(folder: Path, who: str, confirmed: Path) -> None:
    """A reviewer who keeps one scenario after another and notes what was confirmed."""
    for scenario_id in sorted(RELEASED)[:400]:
        seen = len(decisions_on(scenario_id, folder))
        kept = decision("keep", scenario_id).model_copy(update={"who": who})
        try:
            save_decision(kept, seen, folder)
        except DecidedMeanwhile:
            continue
        with confirmed.open("a") as stream:
            stream.write(f"{scenario_id} {who}\n")


def test_two_reviewers_at_once_of_whom_one_is_killed_lose_nothing_confirmed(tmp_path: Path) -> None:
    folder, confirmed = tmp_path / "corrections", [tmp_path / "a", tmp_path / "b"]
    context = multiprocessing.get_context("fork")
    reviewers = [context.Process(target=review_many, args=(folder, f.name, f)) for f in confirmed]
    for each in reviewers:
        each.start()
    until = time.monotonic() + 180
    while not all(f.exists() and f.read_text().count("\n") >= 5 for f in confirmed) and time.monotonic() < until:
        time.sleep(0.01)
    for each in reviewers:
        assert each.pid is not None
        os.kill(each.pid, signal.SIGKILL)
        each.join()
    kept = [f"{each.scenario_id} {each.who}" for _, each in read_corrections(folder)]
    told = [line for f in confirmed for line in f.read_text().splitlines()]
    assert len(told) >= 10
    assert set(told) <= set(kept)
    assert len(kept) <= len(told) + 2  # a reviewer who was killed may have had one more on the disk
