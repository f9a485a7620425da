"""What errors about records, corrections and reviews say to do lets the same call succeed."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from tests.build.frames import frames
from tests.remedies.remedied import remedied
from traps_pipeline.benchmark.corrections import fold, read_corrections
from traps_pipeline.benchmark.records import RELEASED, load_released
from traps_pipeline.scenes.worlds.spec import load_trajectory
from traps_pipeline.video.encode import DamagedClip, decode, encode

ID, OTHER = "domino_chain-0001", "plinko-0003"
RECORDS = load_released()
SIGNED = {"who": "jd", "when": "2026-11-21", "why": "reviewed"}


def write(path: Path, *lines: dict[str, Any] | str) -> Callable[[], int]:
    return lambda: path.write_text("".join(f"{x if isinstance(x, str) else json.dumps(x)}\n" for x in lines))


def correction(action: str = "correct", scenario_id: str = ID, **changes: Any) -> dict[str, Any]:
    return SIGNED | {"scenario_id": scenario_id, "action": action} | changes


OTHER_LABEL = next(label for label in RECORDS[ID].labels if label != RECORDS[ID].ground_truth)


@pytest.mark.parametrize(
    ("wrong", "by", "right"),
    [
        (correction(answer="maybe"), "benchmark.corrections.apply_words", correction(answer=OTHER_LABEL)),
        (correction("mend"), "benchmark.corrections.read_corrections", correction("keep")),
        ("{", "benchmark.corrections.read_corrections", correction("keep")),
        (
            correction("add", family="domino_chain", params=RECORDS[ID].params),
            "benchmark.corrections.fold",
            correction("add", "domino_chain-9001", family="domino_chain", params=RECORDS[ID].params),
        ),
        (
            correction("keep", answer=OTHER_LABEL),
            "benchmark.corrections.fold",
            correction("correct", answer=OTHER_LABEL),
        ),
        (
            correction("keep", "domino_chain-0777"),
            "benchmark.corrections.fold",
            correction("keep", "domino_chain-0001"),
        ),
        (correction(), "benchmark.corrections", correction(params={"azimuth_deg": 5.0})),
        (correction(), "benchmark.corrections", correction("keep")),
    ],
)
def test_a_decision_that_is_corrected_as_told_is_folded(
    tmp_path: Path, wrong: dict[str, Any] | str, by: str, right: dict[str, Any]
) -> None:
    path = tmp_path / "review.jsonl"
    write(path, correction("keep", OTHER), wrong)()
    scenarios = remedied(
        lambda: fold(RECORDS, read_corrections(tmp_path)), by, write(path, correction("keep", OTHER), right)
    )
    assert set(RECORDS) <= set(scenarios)


def record(number: int) -> dict[str, Any]:
    return json.loads((RELEASED / "plinko.jsonl").read_text().splitlines()[number])


@pytest.mark.parametrize(
    ("lines", "by", "remedy"),
    [
        ([record(0), record(1), record(0)], "benchmark.records.load_released", [record(0), record(1)]),
        ([record(0), record(1) | {"labels": 3}], "benchmark.records.parse_record", None),
        ([record(0), "{"], "benchmark.records.parse_record", None),
        ([], "benchmark.records.load_released", None),
    ],
)
def test_records_are_read_once_they_are_what_they_were(
    tmp_path: Path, lines: list[Any], by: str, remedy: list[Any] | None
) -> None:
    path = tmp_path / "plinko.jsonl"
    write(path, *lines)()
    restored = write(path, *remedy) if remedy else lambda: shutil.copy(RELEASED / "plinko.jsonl", path)
    assert "plinko-0001" in remedied(lambda: load_released(tmp_path), by, restored)


def restore(path: Path) -> Path:
    return Path(shutil.copy(RELEASED / "trajectories" / "plinko-0001.npz", path))


@pytest.mark.parametrize(
    ("damage", "by"),
    [
        (lambda path: path.unlink(), "scenes.worlds.spec.load_trajectory"),
        (lambda path: path.write_bytes(b"PK"), "scenes.worlds.spec.load_trajectory"),
        (
            lambda path: shutil.copy(RELEASED / "trajectories" / "plinko-0002.npz", path),
            "scenes.worlds.spec.load_trajectory",
        ),
    ],
)
def test_a_trajectory_is_read_once_it_is_restored(tmp_path: Path, damage: Callable[[Path], object], by: str) -> None:
    path = restore(tmp_path / "plinko-0001.npz")
    damage(path)
    digest = RECORDS["plinko-0001"].trajectory_sha256
    qpos = remedied(lambda: load_trajectory(path, digest), by, lambda: restore(path), error=ValueError)
    assert len(qpos) > 1


# --- clips and items --------------------------------------------------------------------------------------------------


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
    decoded, _ = remedied(lambda: decode(clip), "video.encode.decode", made_again, error=DamagedClip)
    assert len(decoded) == 3
