"""A record and its trajectory vouch for each other."""

from __future__ import annotations

import hashlib
from pathlib import Path

import numpy as np
import pytest

from tests.build.errors import raises
from traps_pipeline.benchmark.records import load_released
from traps_pipeline.scenes.worlds.spec import load_trajectory, save_trajectory, trajectory_digest

QPOS = np.arange(12, dtype=np.float32).reshape(4, 3) / 8


def test_a_digest_is_over_shape_and_little_endian_values() -> None:
    expected = hashlib.sha256(b"(4, 3)" + QPOS.astype("<f4").tobytes()).hexdigest()
    assert trajectory_digest(QPOS) == expected
    assert trajectory_digest(QPOS.astype(np.float64)) == expected
    assert trajectory_digest(QPOS.astype(">f4")) == expected
    assert trajectory_digest(np.asfortranarray(QPOS)) == expected
    assert trajectory_digest(QPOS.reshape(3, 4)) != expected
    assert trajectory_digest(np.nextafter(QPOS, np.float32(9))) != expected


def test_a_trajectory_comes_back_bit_for_bit(tmp_path: Path) -> None:
    save_trajectory(tmp_path / "new", "plinko-0001", {"qpos": QPOS, "twin": QPOS + 1})
    digest = trajectory_digest(QPOS)
    read = load_trajectory(tmp_path / "new" / "plinko-0001.npz", digest)
    assert read.dtype == np.float32
    assert np.array_equal(read, QPOS)


@pytest.mark.parametrize("damage", ["altered", "cut off", "empty", "no archive", "missing", "a pickle"])
def test_what_is_not_the_trajectory_that_was_written_is_named(tmp_path: Path, damage: str) -> None:
    save_trajectory(tmp_path, "plinko-0001", {"qpos": QPOS, "twin": QPOS})
    path, other = tmp_path / "plinko-0001.npz", QPOS.copy()
    other[2, 1] += 1e-6
    match damage:
        case "altered":
            save_trajectory(tmp_path, "plinko-0001", {"qpos": other, "twin": QPOS})
        case "cut off":
            path.write_bytes(path.read_bytes()[:-30])
        case "missing":
            path.unlink()
        case "a pickle":  # is never opened
            np.savez(path, qpos=np.array([{"any": "object"}], dtype=object))
        case text:
            path.write_text("" if text == "empty" else text)
    with raises(ValueError, "scenes.worlds.spec.load_trajectory", "plinko-0001.npz"):
        load_trajectory(path, trajectory_digest(QPOS))


def test_the_scene_hash_covers_what_the_clips_show_and_nothing_else() -> None:
    spec = load_released()["domino_chain-0001"]
    words = {
        "question": "Q?",
        "ill_posed_question": "Q?",
        "aliases": {},
        "seed": 99,
        "evidence": {},
        "sub_scenario": "x",
    }
    for name, value in words.items():
        changed = spec.model_copy(update={name: value})
        assert (changed.scene_hash, changed.spec_hash != spec.spec_hash) == (spec.scene_hash, True), name
    shown = {
        "params": spec.params | {"height_m": 9.0},
        "physics": spec.physics | {"fps": 5},
        "camera": spec.camera | {"fovy_deg": 36.0},
        "void": spec.void | {"hidden_from_frame": 7},
        "control": {"closes_frame": 44},
        "trajectory_sha256": "0" * 64,
    }
    for name, value in shown.items():
        assert spec.model_copy(update={name: value}).scene_hash != spec.scene_hash, name
