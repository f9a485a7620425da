"""Drawing scenarios: quotas keep answers balanced, and what is written is what is read."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from traps_pipeline.benchmark.records import load_released
from traps_pipeline.errors import TrapsError
from traps_pipeline.paths import RELEASED
from traps_pipeline.scenes.registry import family_names, get_family
from traps_pipeline.scenes.sample import Sample, answer_quota, sample_family, write_released
from traps_pipeline.scenes.spec import load_trajectory


@pytest.mark.parametrize(
    ("count", "labels", "quota"),
    [
        (8, 2, 4),  # two labels: the even split, no slack
        (9, 2, 5),
        (1, 2, 1),
        (9, 3, 4),  # three labels or more: one more than the even split rounded up
        (8, 3, 4),
        (8, 6, 3),
        (125, 7, 19),
    ],
)
def test_the_quota_of_an_answer(count: int, labels: int, quota: int) -> None:
    assert answer_quota(count, labels) == quota
    assert answer_quota(count, labels) * labels >= count  # the quotas can be filled


def test_released_answers_keep_their_quota() -> None:
    by_family: dict[str, list[str]] = {}
    labels: dict[str, int] = {}
    for spec in load_released().values():
        by_family.setdefault(spec.family, []).append(spec.ground_truth)
        labels[spec.family] = max(labels.get(spec.family, 0), len(spec.labels))
    for family, answers in by_family.items():
        for answer in set(answers):
            assert answers.count(answer) <= answer_quota(len(answers), labels[family]), (family, answer)


def test_too_few_draws_are_an_error_that_says_what_was_rejected() -> None:
    with pytest.raises(RuntimeError, match=r"domino_chain: 0 of 3 after 0 draws; rejected: "):
        sample_family(get_family("domino_chain"), 3, 1, max_draws=0)


def test_written_records_are_read_back_equal_with_their_trajectories(tmp_path: Path) -> None:
    spec = load_released()["hidden_race-0001"]
    qpos = load_trajectory(RELEASED / "trajectories" / "hidden_race-0001.npz", spec.trajectory_sha256)
    write_released(tmp_path, get_family("hidden_race"), Sample([(spec, qpos)]))
    try:
        assert load_released(tmp_path) == {"hidden_race-0001": spec}
    finally:
        load_released.cache_clear()
    read = load_trajectory(tmp_path / "trajectories" / "hidden_race-0001.npz", spec.trajectory_sha256)
    assert np.array_equal(read, qpos)
    (line,) = (tmp_path / "hidden_race.jsonl").read_text(encoding="utf-8").splitlines()
    assert json.loads(line) == spec.model_dump(mode="json")


def test_families_are_found_by_file_and_an_unknown_one_is_answered_with_the_known() -> None:
    assert {"domino_chain", "hidden_race", "plinko", "tumbling_dice"} <= set(family_names())
    assert all(get_family(name).name == name for name in family_names())
    with pytest.raises((KeyError, TrapsError), match=r"unknown family 'trebuchet'; known: .*domino_chain"):
        get_family("trebuchet")
