"""A benchmark as a whole: counts, balance, repeated texts and scenes; and certifying a folder of records."""

from __future__ import annotations

import json
import re
import shutil
from collections import Counter
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import pytest
import yaml

from bench.lite import chosen
from tests.conftest import ROOT, Checkout
from traps_pipeline.base.paths import ASSETS, RELEASED
from traps_pipeline.benchmark.certify_all import foreseeable
from traps_pipeline.benchmark.composition import composition_problems, load_composition, prior_accuracy
from traps_pipeline.benchmark.records import load_released
from traps_pipeline.benchmark.stored_evidence import failed_certificates
from traps_pipeline.scenes.certification.certify_record import Verdict, state_at_cut
from traps_pipeline.scenes.family_registry import family_names, get_family
from traps_pipeline.scenes.worlds.spec import SceneSpec, load_trajectory

PAPER = {  # counts of the paper's composition table (docs/spec.md 2.1)
    "ramps_rolling": 39,
    "pendulums_levers": 32,
    "trajectories_drops": 29,
    "hidden": 28,
    "collisions": 23,
    "dominoes": 20,
    "stacks": 8,
    "other": 23,
    "pachinko_waterfall": 50,
    "plinko": 50,
    "seesaw_sorter": 200,
    "tumbling_dice": 200,
}


def test_the_composition_is_the_papers() -> None:
    counts = load_composition()
    assert set(counts) <= set(family_names())
    categories = Counter[str]()
    for name, count in counts.items():
        categories[get_family(name).category] += count
    assert categories == PAPER
    assert sum(PAPER.values()) == 702


def race(answers: str) -> list[SceneSpec]:
    """Records of one family with the given answers, otherwise fine."""
    spec = load_released()["domino_chain-0001"]
    return [
        spec.model_copy(
            update={
                "scenario_id": f"domino_chain-{i:04d}",
                "ground_truth": "yes" if answer == "y" else "no",
                "ill_posed_question": f"How many grams does domino {i} weigh?",
                "trajectory_sha256": f"{i:064d}",
                "evidence": spec.evidence | {"margin_m": 0.05 + i / 1000},
            }
        )
        for i, answer in enumerate(answers)
    ]


def is_one(problems: Iterable[str], *names: str) -> bool:
    """Whether there is one problem, which names these."""
    (problem,) = problems
    return all(name in problem for name in names)


def test_an_answer_may_come_once_more_than_the_even_split() -> None:
    assert composition_problems(race("yyyyynnn")) == []
    assert is_one(composition_problems(race("yyyyyynn")), "domino_chain", "'yes'", "6", "5")


def test_of_ten_or_more_an_answer_of_two_may_be_60_percent() -> None:
    assert composition_problems(race("y" * 12 + "n" * 8)) == []
    assert is_one(composition_problems(race("y" * 13 + "n" * 7)), "domino_chain", "'yes'", "13", "12")


def test_a_text_or_a_scene_that_occurs_twice_is_named() -> None:
    specs = race("ynyn")
    twice = [*specs[:3], specs[3].model_copy(update={"ill_posed_question": specs[0].ill_posed_question})]
    assert is_one(composition_problems(twice), "domino_chain", "'How many grams does domino 0 weigh?'", "2", "1")
    copied = [*specs[:3], specs[0].model_copy(update={"scenario_id": "domino_chain-0099", "ill_posed_question": "?"})]
    assert is_one(composition_problems(copied), "domino_chain-0000, domino_chain-0099")


def test_a_family_whose_margin_is_a_constant_is_named() -> None:
    constant = [spec.model_copy(update={"evidence": spec.evidence | {"margin_m": 1.0}}) for spec in race("ynyn")]
    assert is_one(composition_problems(constant), "domino_chain", "1.0 m")
    assert composition_problems(constant[:1]) == []
    assert composition_problems([*constant[:3], race("ynyn")[3]]) == []


def test_missing_scenarios_are_counted() -> None:
    assert is_one(composition_problems(race("yn"), {"domino_chain": 2, "plinko": 1}), "plinko", "0", "1")


def test_the_prior_knows_only_the_commonest_answer_of_a_sub_scenario() -> None:
    assert prior_accuracy(race("yyyn")) == 0.75


@pytest.mark.slow
@pytest.mark.promise
def test_released_records_carry_evidence_that_holds() -> None:
    specs = list(load_released().values())
    assert failed_certificates(specs, "control") == []
    assert failed_certificates(specs, "void", "twin", "worlds") == []
    assert failed_certificates(specs, "words") == []


def test_no_released_family_has_an_answer_or_a_text_too_often() -> None:
    counts = load_composition()
    for name, wanted in counts.items():
        members = [spec for spec in load_released().values() if spec.family == name]
        if len(members) == wanted:  # quotas are those of the whole family
            assert composition_problems(members) == []


def test_a_record_whose_cut_was_moved_is_found_without_a_trajectory() -> None:
    spec = load_released()["plinko-0001"]
    assert list(failed_certificates([spec], "void", "twin", "worlds")) == []
    early = spec.model_copy(update={"void": spec.void | {"cut_frame": 9}})  # its last frame is shown at 0.8 s
    assert is_one(failed_certificates([early], "void", "twin", "worlds"), "plinko-0001: cut", "0.9 s", "1.0 s")


def test_a_record_without_evidence_loses_every_certificate_that_stores_some() -> None:
    bare = load_released()["domino_chain-0001"].model_copy(update={"evidence": {}})
    lost = {
        "outcome": "commit_s",
        "pace": "settles_share",
        "legible": "least_visible_px",
        "order": "order_frames",
        "hidden": "hidden_from_s",
        "ablation": "ablation_px",
        "referents": "referents",
        "twin": "twin_px",
        "closing": "read_s",
        "exchange": "hidden_from_s",
    }
    said = [*failed_certificates([bare], "control"), *failed_certificates([bare], "void", "twin", "worlds")]
    assert [one.split(": ")[1] for one in said] == [*lost]
    assert all(f"'{evidence}'" in one for evidence, one in zip(lost.values(), said, strict=True))


def test_the_lite_set_is_the_one_that_its_rule_chooses_from_the_released_records() -> None:
    assert yaml.safe_load((ASSETS / "lite.yaml").read_text())["scenarios"] == chosen()


@pytest.mark.slow  # fits trees
def test_seesaws_whose_side_the_state_at_the_cut_predicts_are_reported_and_the_released_ones_are_not(
    tmp_path: Path,
) -> None:
    specs = [spec for spec in load_released().values() if spec.family == "seesaw_sorter"]
    states = {}
    for spec in specs:
        qpos = load_trajectory(RELEASED / "trajectories" / f"{spec.scenario_id}.npz", spec.trajectory_sha256)
        states[spec.scenario_id] = state_at_cut(qpos, spec.void["cut_frame"])
    verdicts = [Verdict(id_, "seesaw_sorter", {}, {}, True, at_cut=state.tolist()) for id_, state in states.items()]
    assert foreseeable(specs, verdicts) == []
    place = {id_: float(state[0]) for id_, state in states.items()}
    middle = sorted(place.values())[len(place) // 2]
    sides = [s.model_copy(update={"ground_truth": "left" if place[s.scenario_id] < middle else "right"}) for s in specs]
    (said,) = foreseeable(sides, verdicts)
    assert "seesaw_sorter" in said and max(map(float, re.findall(r"[01]\.\d{3}", said))) >= 0.9
    assert foreseeable(sides[:99], verdicts) == []  # too few to tell


Record = dict[str, Any]


def change_answer(record: Record) -> None:
    record["ground_truth"] = next(label for label in record["labels"] if label != record["ground_truth"])


def start_the_twin_elsewhere(record: Record) -> None:
    record["twin"]["rollout"] += 1


# What each certificate finds is in tests/scenes/test_certificates.py.
ALTERED: dict[str, tuple[Callable[[Record], None], str]] = {
    "head_on-0001": (change_answer, "outcome"),
    "pachinko_waterfall-0001": (start_the_twin_elsewhere, "twin"),
}
UNTOUCHED = "slide-0001"


def copy_record(scenario_id: str, folder: Path, alter: Callable[[Record], None] = lambda _: None) -> None:
    """One released record and its trajectory, altered, into a benchmark folder."""
    family = scenario_id.rpartition("-")[0]
    lines = (RELEASED / f"{family}.jsonl").read_text().splitlines()
    record = next(r for r in map(json.loads, lines) if r["scenario_id"] == scenario_id)
    alter(record)
    (folder / "released" / "trajectories").mkdir(parents=True, exist_ok=True)
    (folder / "released" / f"{family}.jsonl").write_text(json.dumps(record) + "\n")
    shutil.copy(RELEASED / "trajectories" / f"{scenario_id}.npz", folder / "released" / "trajectories")


@pytest.mark.slow
def test_altered_records_are_named_with_the_certificate_that_they_lose_and_an_untouched_one_passes(
    tmp_path: Path,
) -> None:
    for scenario_id, (alter, _) in ALTERED.items():
        copy_record(scenario_id, tmp_path, alter)
    copy_record(UNTOUCHED, tmp_path)
    finished = Checkout(ROOT, tmp_path / "workspace").traps("benchmark", "certify", "--specs", tmp_path)
    assert finished.code == 1 and "Traceback" not in finished.err
    for scenario_id, (_, lost) in ALTERED.items():
        assert f"traps: {scenario_id}: {lost}" in finished.err, finished.err
    assert f"traps: {UNTOUCHED}" not in finished.err and re.search(r"\b1 \w+ 3\b", finished.out)
