"""What errors about records, corrections and reviews say to do lets the same call succeed."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from datetime import date
from pathlib import Path
from typing import Any

import pytest

from tests.remedies.remedied import remedied
from tests.scenes.test_encode import frames
from traps_pipeline.benchmark import arms, videos
from traps_pipeline.benchmark.corrections import Correction, check_benchmark, fold, read_corrections
from traps_pipeline.benchmark.decisions import FILE, DecidedMeanwhile, decide, decisions_on, undo
from traps_pipeline.benchmark.held_out import held_out_key
from traps_pipeline.benchmark.items import build_items
from traps_pipeline.benchmark.records import RELEASED, load_released
from traps_pipeline.benchmark.specs import build_specs, resolve_scenario
from traps_pipeline.benchmark.tables import ARMS, SCENE_SPECS, VIDEOS
from traps_pipeline.scenes.encode import DamagedClip, decode, encode
from traps_pipeline.scenes.spec import load_trajectory
from traps_pipeline.storage.study import Asked, Study
from traps_pipeline.storage.workspace import Workspace

ID, OTHER = "domino_chain-0001", "plinko-0003"
RECORDS = load_released()
SIGNED = {"who": "jd", "when": "2026-11-21", "why": "reviewed"}


def write(path: Path, *lines: dict[str, Any] | str) -> Callable[[], int]:
    return lambda: path.write_text("".join(f"{x if isinstance(x, str) else json.dumps(x)}\n" for x in lines))


def correction(action: str = "correct", scenario_id: str = ID, **changes: Any) -> dict[str, Any]:
    return SIGNED | {"scenario_id": scenario_id, "action": action} | changes


OTHER_LABEL = next(label for label in RECORDS[ID].labels if label != RECORDS[ID].ground_truth)


@pytest.mark.parametrize(
    ("wrong", "sentence", "right"),
    [
        (correction(answer="maybe"), "{}: {}: {}; correct that line", correction(answer=OTHER_LABEL)),
        (correction("mend"), "not a valid correction ({}); correct that line", correction("keep")),
        ("{", "{}: not JSON ({}); correct that line", correction("keep")),
        (
            correction("add", family="domino_chain", params=RECORDS[ID].params),
            "the id is taken; choose a free number",
            correction("add", "domino_chain-9001", family="domino_chain", params=RECORDS[ID].params),
        ),
        (
            correction("keep", answer=OTHER_LABEL),
            "changes nothing, yet gives {}; use `correct`",
            correction("correct", answer=OTHER_LABEL),
        ),
        (
            correction("keep", "domino_chain-0777"),
            "; name a scenario of the benchmark",
            correction("keep", "domino_chain-0001"),
        ),
        (
            correction(),
            "`correct` gives no change; give words, answer or params",
            correction(params={"azimuth_deg": 5.0}),
        ),
        (correction(), "`correct` gives no change; give words, answer or params, or use `keep`", correction("keep")),
    ],
)
def test_a_decision_that_is_corrected_as_told_is_folded(
    tmp_path: Path, wrong: dict[str, Any] | str, sentence: str, right: dict[str, Any]
) -> None:
    path = tmp_path / "review.jsonl"
    write(path, correction("keep", OTHER), wrong)()
    scenarios = remedied(
        lambda: fold(RECORDS, read_corrections(tmp_path)),
        sentence,
        write(path, correction("keep", OTHER), right),
    )
    assert set(RECORDS) <= set(scenarios)


def record(number: int) -> dict[str, Any]:
    return json.loads((RELEASED / "plinko.jsonl").read_text().splitlines()[number])


@pytest.mark.parametrize(
    ("lines", "sentence", "remedy"),
    [
        ([record(0), record(1), record(0)], "occurs twice; remove one of the lines", [record(0), record(1)]),
        ([record(0), record(1) | {"labels": 3}], "not a valid record ({}); restore the line from git", None),
        ([record(0), "{"], "{}: not JSON ({}); restore the line from git", None),
        ([], "holds no released records; restore it from git or draw some", None),
    ],
)
def test_records_are_read_once_they_are_what_they_were(
    tmp_path: Path, lines: list[Any], sentence: str, remedy: list[Any] | None
) -> None:
    path = tmp_path / "plinko.jsonl"
    write(path, *lines)()
    restored = write(path, *remedy) if remedy else lambda: shutil.copy(RELEASED / "plinko.jsonl", path)
    assert "plinko-0001" in remedied(lambda: load_released(tmp_path), sentence, restored)


def restore(path: Path) -> Path:
    return Path(shutil.copy(RELEASED / "trajectories" / "plinko-0001.npz", path))


@pytest.mark.parametrize(
    ("damage", "sentence"),
    [
        (lambda path: path.unlink(), "no such trajectory; restore it from git or remove its record"),
        (lambda path: path.write_bytes(b"PK"), "not a readable trajectory ({}); restore it from git"),
        (
            lambda path: shutil.copy(RELEASED / "trajectories" / "plinko-0002.npz", path),
            "digest {} is not the record's {}; restore the file from git",
        ),
    ],
)
def test_a_trajectory_is_read_once_it_is_restored(
    tmp_path: Path, damage: Callable[[Path], object], sentence: str
) -> None:
    path = restore(tmp_path / "plinko-0001.npz")
    damage(path)
    digest = RECORDS["plinko-0001"].trajectory_sha256
    qpos = remedied(lambda: load_trajectory(path, digest), sentence, lambda: restore(path), error=ValueError)
    assert len(qpos) > 1


def test_records_of_another_benchmark_are_used_once_the_experiment_names_them(tmp_path: Path) -> None:
    remedied(
        lambda: check_benchmark(Study(benchmark="mine")),
        "{}, or write `benchmark: {}` into the experiment of a new workspace",
        again=lambda: check_benchmark(Study(benchmark="released")),
    )


def decision(action: str, **changes: Any) -> Correction:
    about = {"who": "jd", "when": date(2026, 11, 21), "why": "looked at it"}
    return Correction.model_validate({"scenario_id": ID, "action": action, **changes, **about})


def test_a_pair_that_is_looked_at_again_can_be_decided_on(tmp_path: Path) -> None:
    decide(decision("keep"), seen=0, folder=tmp_path)
    remedied(
        lambda: decide(decision("discard"), seen=0, folder=tmp_path),
        "decided meanwhile; look at the pair again",
        again=lambda: decide(decision("discard"), seen=len(decisions_on(ID, tmp_path)), folder=tmp_path),
        error=DecidedMeanwhile,
    )
    assert ID not in fold(RECORDS, read_corrections(tmp_path))
    undo(ID, 2, who="jd", why="too hasty", folder=tmp_path)


def test_a_file_that_is_renamed_as_told_no_longer_overrules_reviews(tmp_path: Path) -> None:
    later = tmp_path / "zz.jsonl"
    write(later, correction(question="Old, yes or no?"))()
    remedied(
        lambda: decide(decision("correct", question="New, yes or no?"), seen=1, folder=tmp_path),
        "would overrule them; rename it to a name that comes before {}",
        lambda: later.rename(tmp_path / f"a-{FILE}"),
    )
    assert fold(RECORDS, read_corrections(tmp_path))[ID].changed_words().question == "New, yes or no?"


@pytest.mark.parametrize(
    ("content", "sentence"),
    [
        (None, "cannot be read ({}); give the file of the held-out set's key"),
        ("no key", "is no key ({} hexadecimal digits); give the one that the release made"),
    ],
)
def test_the_key_that_the_release_made_is_read(tmp_path: Path, content: str | None, sentence: str) -> None:
    right, wrong = tmp_path / "key", tmp_path / "other"
    made = held_out_key(right, make=True)
    if content is not None:
        wrong.write_text(content)
    assert remedied(lambda: held_out_key(wrong), sentence, again=lambda: held_out_key(right)) == made


@pytest.mark.slow  # resolves scenes
def test_corrected_parameters_are_simulated_once_the_line_is_as_told(tmp_path: Path) -> None:
    azimuth = RECORDS[ID].params["azimuth_deg"] + 2.0
    workspace = Workspace.create(tmp_path / "study", Study())
    path = tmp_path / "review.jsonl"

    def resolved() -> str:
        return resolve_scenario(workspace, fold(RECORDS, read_corrections(tmp_path))[ID]).spec.ground_truth

    write(path, correction(params={"azimuth_deg": azimuth}, answer=OTHER_LABEL))()
    remedied(
        resolved,
        "the simulation {}; leave the answer out or change the parameters",
        write(path, correction(params={"azimuth_deg": azimuth})),
    )
    write(path, correction(params={"azimuth_deg": azimuth, "spacing": 99.0}))()
    remedied(
        resolved,
        "these parameters make no valid pair ({}); change them or discard it",
        write(path, correction(params={"azimuth_deg": azimuth})),
    )


# --- clips and items --------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_clips_arms_and_items_are_made_once_what_they_are_of_is(tmp_path: Path) -> None:
    """One chaotic scenario from its record to the items of an arm, each stage asked too early first."""
    asked = Asked(datasets=("chaotic", "length_matched"), models=("oracle",), regimes=("standard",), runs=(1,))
    study = Study(panel="rules", scenarios=[OTHER], experiments={"one": asked})
    workspace, part = Workspace.create(tmp_path / "study", study), {"category": "plinko"}
    tables = workspace.tables
    tables.write(SCENE_SPECS, part, build_specs(workspace, "plinko")[0], {})
    assert videos.seconds_left(workspace, "plinko") == 3 * videos.SECONDS_A_CLIP
    filmed = remedied(
        lambda: videos.build_videos(workspace, "plinko")[0],
        "benchmark/videos.py | {}: was not rendered; run again",
        lambda: videos.render_videos(workspace, "plinko"),
    )
    assert videos.seconds_left(workspace, "plinko") == 0
    assert [each.side for each in filmed] == ["control", "void", "twin"]

    tables.write(VIDEOS, part, [replace(each, scene_hash="another") for each in filmed], {})
    remedied(
        lambda: build_items(workspace, "chaotic"),
        "items {}: the {} clip of {} is not of its current scene; materialize videos for {}",
        lambda: tables.write(VIDEOS, part, filmed, {}),
    )

    assert arms.seconds_left(workspace, "plinko") == arms.SECONDS_AN_ARM
    made = remedied(
        lambda: arms.build_arms(workspace, "plinko"),
        "benchmark/arms.py | {}: was not filmed; run again",
        lambda: arms.film_arms(workspace, "plinko"),
    )
    assert arms.seconds_left(workspace, "plinko") == 0
    tables.write(ARMS, part, [replace(each, refused="its outcome is settled too late") for each in made], {})
    items = remedied(
        lambda: build_items(workspace, "length_matched"),
        "items {}: no scenario of this study admits it; take more scenarios or leave the arm out",
        lambda: tables.write(ARMS, part, made, {}),
    )
    assert [item.scenario_id for item in items] == [OTHER]


def test_a_clip_that_holds_fewer_frames_than_it_promises_is_made_again(tmp_path: Path) -> None:
    clip = tmp_path / "clip.mp4"
    encode(frames(3), clip, 10)
    data = clip.read_bytes()
    sizes = data.index(b"stsz") + 16  # behind it: the sizes of the frames, four bytes each; the last one ends the file
    last = int.from_bytes(data[sizes + 8 : sizes + 12])

    def made_again() -> None:
        clip.unlink()
        encode(frames(3), clip, 10)

    clip.write_bytes(data[:-last])
    decoded, _ = remedied(
        lambda: decode(clip),
        "{}: holds {} of {} frames; delete the file and materialize videos again",
        made_again,
        error=DamagedClip,
    )
    assert len(decoded) == 3
