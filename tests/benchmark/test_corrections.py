"""Review decisions fold over the real released records; a wrong one is named by file and line."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from tests.build.errors import raises
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.benchmark.corrections import Scenario, apply_corrections, of_study, read_corrections
from traps_pipeline.benchmark.records import load_released
from traps_pipeline.scenes.family_registry import get_family
from traps_pipeline.storage.study import Study

RELEASED = load_released()
ID = "domino_chain-0001"
SPEC = RELEASED[ID]
OTHER_LABEL = next(label for label in SPEC.labels if label != SPEC.ground_truth)


def decide(tmp_path: Path, *lines: dict[str, Any] | str) -> dict[str, Scenario]:
    """The benchmark after decisions, written to a file and read as the pipeline reads them."""
    signed = {"who": "jd", "when": "2026-11-21", "why": "reviewed"}
    texts = [line if isinstance(line, str) else json.dumps(signed | line, ensure_ascii=False) for line in lines]
    (tmp_path / "review.jsonl").write_text("\n".join(texts) + "\n", encoding="utf-8")
    return apply_corrections(RELEASED, read_corrections(tmp_path))


def correct(**changes: Any) -> dict[str, Any]:
    return {"scenario_id": ID, "action": "correct"} | changes


def test_without_decisions_the_benchmark_is_the_release(tmp_path: Path) -> None:
    scenarios = apply_corrections(RELEASED, read_corrections(tmp_path))
    assert scenarios == decide(tmp_path, {"scenario_id": ID, "action": "keep"})
    assert list(scenarios) == sorted(RELEASED)
    assert all(s.changed_words() is RELEASED[id_] for id_, s in scenarios.items())


def test_a_corrected_question_changes_the_words_and_not_the_scene(tmp_path: Path) -> None:
    scenarios = decide(tmp_path, correct(question="Does the last domino fall, yes\u2028or no?"))
    spec = scenarios[ID].changed_words()
    assert spec.question == "Does the last domino fall, yes\u2028or no?"
    assert spec.model_copy(update={"question": SPEC.question}) == SPEC
    assert spec.scene_hash == SPEC.scene_hash
    assert scenarios[ID].params is None
    untouched = apply_corrections(RELEASED, ())
    assert [id_ for id_ in scenarios if scenarios[id_].version != untouched[id_].version] == [ID]


def test_a_corrected_answer_stands_above_the_simulators_and_says_so(tmp_path: Path) -> None:
    spec = decide(tmp_path, correct(answer=OTHER_LABEL))[ID].changed_words()
    assert spec.ground_truth == OTHER_LABEL
    assert spec.evidence == SPEC.evidence | {"answer_from": "correction"}


def test_a_later_decision_adds_to_an_earlier_one_and_wins_where_both_speak(tmp_path: Path) -> None:
    scenarios = decide(
        tmp_path, correct(question="A?", ill_posed_question="B?"), correct(question="C?", answer=OTHER_LABEL)
    )
    spec = scenarios[ID].changed_words()
    assert (spec.question, spec.ill_posed_question, spec.ground_truth) == ("C?", "B?", OTHER_LABEL)


def test_new_labels_come_with_aliases_and_an_answer_among_them(tmp_path: Path) -> None:
    words = {"labels": ["falls", "stands"], "aliases": {"stays upright": "stands"}, "answer": "stands"}
    spec = decide(tmp_path, correct(**words))[ID].changed_words()
    assert (spec.labels, spec.aliases, spec.ground_truth) == (["falls", "stands"], words["aliases"], "stands")


def test_a_corrected_parameter_leaves_the_others_and_calls_for_a_new_scene(tmp_path: Path) -> None:
    scenario = decide(tmp_path, correct(params={"starter_speed_m_s": 0.9}))[ID]
    assert scenario.params == SPEC.params | {"starter_speed_m_s": 0.9}
    both = decide(tmp_path, correct(params={"starter_speed_m_s": 0.9}), correct(params={"height_m": 0.2}))[ID]
    assert both.params == SPEC.params | {"starter_speed_m_s": 0.9, "height_m": 0.2}
    assert both.version != scenario.version


def test_a_discarded_scenario_is_gone(tmp_path: Path) -> None:
    assert set(RELEASED) - set(decide(tmp_path, {"scenario_id": ID, "action": "discard"})) == {ID}


def test_an_added_scenario_is_there_with_its_familys_category(tmp_path: Path) -> None:
    new = {"scenario_id": "domino_chain-9001", "action": "add", "family": "domino_chain", "params": SPEC.params}
    scenario = decide(tmp_path, new | {"question": "Falls it?"})["domino_chain-9001"]
    assert (scenario.released, scenario.category) == (None, get_family("domino_chain").category)
    assert scenario.params == SPEC.params
    assert scenario.words == {"question": "Falls it?"}


ADD = {"scenario_id": "domino_chain-9001", "action": "add", "family": "domino_chain", "params": SPEC.params}
DISCARD = {"scenario_id": ID, "action": "discard"}


@pytest.mark.parametrize(
    ("lines", "place"),
    [
        ([correct(scenario_id="domino_chain-7777", question="Q?")], 1),
        ([correct(answer="sideways")], 1),
        ([correct(labels=["a", "b"])], 1),
        ([correct(aliases={"maybe": "perhaps"})], 1),
        ([DISCARD, DISCARD], 2),
        ([DISCARD, correct(question="Q?")], 2),
        ([ADD | {"scenario_id": ID}], 1),
        ([DISCARD, ADD | {"scenario_id": ID}], 2),
        ([ADD, ADD], 2),
        ([ADD | {"family": "trebuchet"}], 1),
        ([{k: v for k, v in ADD.items() if k != "params"}], 1),
        ([ADD | {"params": {"mass_kg": 3}}], 1),
        ([correct(params={"mass_kg": 3})], 1),
        ([correct()], 1),
        ([{"scenario_id": ID, "action": "keep", "question": "Q?"}], 1),
        ([DISCARD | {"answer": "yes"}], 1),
        ([correct(question="Q?", who="")], 1),
        ([correct(question="Q?", when="yesterday")], 1),
        ([correct(question="Q?", why="")], 1),
        ([correct(qestion="Q?")], 1),
        ([{"scenario_id": ID, "action": "improve"}], 1),
        (["{not json"], 1),
        ([correct(question="Q?"), "", '{"scenario_id": "a-1", "action": "keep"}'], 3),
    ],
)
def test_a_wrong_decision_names_its_file_and_line(
    tmp_path: Path, lines: list[dict[str, Any] | str], place: int
) -> None:
    with raises(TrapsError, "benchmark.corrections", f"review.jsonl:{place}"):
        decide(tmp_path, *lines)


def test_a_study_takes_all_the_first_of_each_family_or_named_scenarios() -> None:
    scenarios = apply_corrections(RELEASED, ())
    assert of_study(scenarios, Study()) == scenarios
    firsts = [f"{family}-0001" for family in sorted({spec.family for spec in RELEASED.values()})]
    assert list(of_study(scenarios, Study(per_family=1))) == firsts
    named = Study(scenarios=["hidden_race-0002", ID])
    assert list(of_study(scenarios, named)) == [ID, "hidden_race-0002"]


def test_a_discarded_scenario_falls_out_of_a_study_that_names_it_and_an_unknown_one_is_an_error(tmp_path: Path) -> None:
    scenarios = decide(tmp_path, DISCARD)
    assert list(of_study(scenarios, Study(scenarios=[ID, "hidden_race-0002"]))) == ["hidden_race-0002"]
    with raises(TrapsError, "benchmark.corrections.of_study", "['domino_chain-7777']"):
        of_study(scenarios, Study(scenarios=["domino_chain-7777"]))
