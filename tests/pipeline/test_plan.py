"""`traps plan` on a study that has changed: the calls that it announces are those that the next run makes."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Mapping

import pytest

from tests.conftest import EXPERIMENT, Checkout

pytestmark = pytest.mark.slow


@pytest.fixture
def study(own_study: Checkout) -> Checkout:
    """A study whose records the tests correct."""
    return own_study


def new(calls: Mapping[str, int]) -> int:
    return calls["wanted"] - calls["known"]


def announced(study: Checkout, experiment: str = EXPERIMENT) -> tuple[int, int]:
    """New answers and votes of all models, by `traps plan`, which knows every item."""
    plan = json.loads(study.traps("plan", experiment, "--json").ok().out)["plan"]
    assert plan["uncertain"] == []
    answers, votes = zip(*plan["calls"].values(), strict=True)
    return sum(map(new, answers)), sum(map(new, votes))


def asked(study: Checkout, experiment: str = EXPERIMENT) -> tuple[int, int]:
    """Answers and votes that the next run asks."""
    finished = study.traps("run", experiment, "--until", "votes").ok()
    counts = finished.counts()
    return counts["answers"], counts["votes"]


def correct_one_void(study: Checkout) -> None:
    study.correct("plinko-0003", ill_posed_question="Why is the little triangle beside the board singing?")


def edit_prompt(study: Checkout, name: str) -> None:
    path = study.root / "assets" / "prompts" / f"{name}.txt"
    path.write_text(path.read_text() + "\nTake your time.\n")


@pytest.mark.parametrize(
    ("change", "answers"),
    [
        (correct_one_void, 3 * 2),  # one item, of each model under each regime
        (lambda study: edit_prompt(study, "judge_abstention"), 0),
    ],
    ids=["one question", "a judge's prompt"],
)
def test_a_plan_after_a_change_announces_what_the_next_run_asks(
    study: Checkout, change: Callable[[Checkout], None], answers: int
) -> None:
    assert announced(study) == (0, 0)
    change(study)
    plan = announced(study)
    assert plan[1] > 0 and answers == plan[0]
    assert asked(study) == plan
    assert announced(study) == (0, 0)


def test_votes_on_answers_that_are_asked_again_are_announced_as_if_all_texts_were_new(study: Checkout) -> None:
    edit_prompt(study, "json_suffix")
    answers, votes = announced(study)
    made = asked(study)
    assert made[0] == answers and 0 < made[1] <= votes  # reference models say again what they said before
    assert votes == answers * 3 // 2 * 3  # three judges; two tasks for a control, one for a void


def test_a_plan_of_a_further_run_announces_what_it_asks(study: Checkout) -> None:
    experiment = study.root / "further.yaml"
    text = (study.root / EXPERIMENT).read_text().replace("name: small", "name: further")
    experiment.write_text(text.replace("regimes: [standard, json]", "regimes: [standard]\nruns: [1, 2]"))
    plan = announced(study, "further.yaml")
    assert min(plan) > 0
    assert asked(study, "further.yaml") == plan


def test_a_scene_that_must_be_drawn_anew_counts_as_new_and_no_other_does(study: Checkout) -> None:
    records = map(json.loads, (study.root / "scene_specs" / "released" / "domino_chain.jsonl").read_text().splitlines())
    azimuth = next(r["params"]["azimuth_deg"] for r in records if r["scenario_id"] == "domino_chain-0002")
    study.correct("domino_chain-0002", params={"azimuth_deg": azimuth + 2.0})
    printed = study.traps("plan", EXPERIMENT).out
    assert "occlusion, occlusion_ill_posed" in printed  # their items are not made yet
    # Two items of two datasets, of three models under two regimes; three tasks a pair, three judges.
    assert re.search(rf"^all +[\d,]+ +[\d,]+ +{4 * 6} +[\d,]+ +[\d,]+ +{2 * 3 * 3 * 6}$", printed, re.MULTILINE), (
        printed
    )
    assert asked(study)[0] == 4 * 6
    correct_one_void(study)  # with the other scene simulated once, the plan is exact
    assert announced(study)[0] == 3 * 2


@pytest.mark.parametrize("table", ["scene_specs", "videos", "items", "responses", "votes", "verdicts", "leaderboard"])
def test_a_damaged_table_is_one_to_make_and_its_calls_are_those_of_the_next_run(study: Checkout, table: str) -> None:
    path = sorted((study.workspace / "tables" / table).rglob("*.parquet"))[0]
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)
    plan = json.loads(study.traps("plan", EXPERIMENT, "--json").ok().out)
    assert table in {status["stage"] for status in plan["stages"]}
    calls = [count for counts in plan["plan"]["calls"].values() for count in counts]
    # What the ledger holds is known; of items that are to be made the plan cannot know that, and says so.
    assert bool(sum(map(new, calls))) == bool(plan["plan"]["uncertain"])
    assert asked(study) == (0, 0)
