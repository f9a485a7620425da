"""Released records: every one is whole, and a broken one is named by file and line."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.build.errors import raises
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.base.paths import RELEASED
from traps_pipeline.benchmark.records import load_release, load_released, released_lines
from traps_pipeline.benchmark.versions import item_content, spec_record, version_of
from traps_pipeline.scenes.family_registry import get_family
from traps_pipeline.scenes.worlds.spec import load_trajectory

RELEASE = load_release().version


def records() -> list[dict[str, Any]]:
    """Two real records as they stand in the file."""
    lines = (RELEASED / "domino_chain.jsonl").read_text(encoding="utf-8").split("\n")
    return [json.loads(line) for line in lines[:2]]


def write(tmp_path: Path, *lines: dict[str, Any] | str) -> Path:
    texts = [line if isinstance(line, str) else json.dumps(line, ensure_ascii=False) for line in lines]
    (tmp_path / "some.jsonl").write_text("\n".join(texts) + "\n", encoding="utf-8")
    return tmp_path


@pytest.fixture(autouse=True)
def fresh_cache() -> Iterator[None]:
    yield
    load_released.cache_clear()
    released_lines.cache_clear()


def test_records_are_loaded_by_id_and_blank_lines_do_not_matter(tmp_path: Path) -> None:
    one, two = records()
    loaded = load_released(write(tmp_path, one, "", two))
    assert list(loaded) == [one["scenario_id"], two["scenario_id"]]
    assert loaded[one["scenario_id"]].model_dump(mode="json") == one


def test_a_question_may_hold_any_character(tmp_path: Path) -> None:
    one = records()[0] | {"question": "Left\u2028or right – 左?\x85"}
    assert load_released(write(tmp_path, one))[one["scenario_id"]].question == one["question"]


@pytest.mark.parametrize(
    "change",
    [
        {"ground_truth": "perhaps"},
        {"labels": ["yes", "yes"]},
        {"aliases": {"maybe": "perhaps"}},
        {"question": ""},
        {"void_kind": "fog"},
        {"colour": "red"},
        {"scenario_id": "Domino 1"},
        {"family": "trebuchet"},
        {"category": "magic"},
        {"answerable_question": {"question": "q", "labels": ["a", "b"], "answer": "c"}},
    ],
    ids=lambda value: next(iter(value)) if isinstance(value, dict) else "",
)
def test_a_malformed_record_names_its_file_and_line(tmp_path: Path, change: dict[str, Any]) -> None:
    one, two = records()
    with raises(TrapsError, "benchmark.records._parse", "some.jsonl:2"):
        load_released(write(tmp_path, one, two | change))


@pytest.mark.parametrize("line", ["{", "not json", '{"scenario_id": "a-1"}', "[]"])
def test_a_line_that_is_no_record_names_its_file_and_line(tmp_path: Path, line: str) -> None:
    with raises(TrapsError, "benchmark.records._parse", "some.jsonl:3"):
        load_released(write(tmp_path, records()[0], "", line))


def test_an_id_that_occurs_twice_names_the_second_line(tmp_path: Path) -> None:
    one, two = records()
    with raises(TrapsError, "benchmark.records._lines", "some.jsonl"):
        load_released(write(tmp_path, one, two, one))


def test_a_folder_without_records_says_what_to_do(tmp_path: Path) -> None:
    with raises(TrapsError, "benchmark.records.released_lines"):
        load_released(tmp_path)


def test_every_released_record_has_its_trajectory_its_family_and_known_parameters() -> None:
    released = load_released()
    assert len(released) >= 8
    for id_, spec in released.items():
        qpos = load_trajectory(RELEASED / "trajectories" / f"{id_}.npz", spec.trajectory_sha256)
        assert len(qpos) == round(spec.physics["duration_s"] * spec.physics["fps"])
        family = get_family(spec.family)
        family.params_from(spec.params)
        assert (spec.category, spec.sub_scenario, spec.taxonomy) == (
            family.category,
            family.sub_scenario,
            family.taxonomy,
        )
        assert spec.void_kind == ("occluder" if spec.taxonomy == "occlusion" else "truncation")


def test_an_untouched_part_keeps_the_releases_version_in_any_order() -> None:
    specs = list(load_released().values())
    contents = [spec.spec_hash for spec in specs]
    assert version_of(contents, contents[::-1]) == RELEASE
    assert version_of([], []) == RELEASE


def test_a_touched_part_has_a_digest_that_depends_on_content_and_not_on_order() -> None:
    contents = [spec.spec_hash for spec in load_released().values()]
    one, two = (version_of(contents, [*contents[:-1], changed]) for changed in ("x", "y"))
    assert one.startswith(f"{RELEASE}+") and len(one) == len(RELEASE) + 9
    assert one != two
    assert version_of(contents, ["x", *contents[:-1]]) == one
    assert version_of(contents, contents[:-1]) not in (RELEASE, one)  # a discarded scenario


def test_an_ill_posed_question_touches_the_ill_posed_dataset_alone() -> None:
    spec = next(iter(load_released().values()))
    other = spec.model_copy(update={"ill_posed_question": "How heavy is the colour?"})
    visual, ill_posed = spec.taxonomy, f"{spec.taxonomy}_ill_posed"
    assert item_content(visual, spec_record(spec)) == item_content(visual, spec_record(other))
    assert item_content(ill_posed, spec_record(spec)) != item_content(ill_posed, spec_record(other))
    reworded = spec.model_copy(update={"question": "Which one?"})
    for dataset in (visual, ill_posed):
        assert item_content(dataset, spec_record(spec)) != item_content(dataset, spec_record(reworded))
    assert reworded.scene_hash == spec.scene_hash and reworded.spec_hash != spec.spec_hash
