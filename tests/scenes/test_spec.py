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
    save_trajectory(tmp_path / "new", "plinko-0001", QPOS, QPOS + 1)
    digest = trajectory_digest(QPOS)
    read = load_trajectory(tmp_path / "new" / "plinko-0001.npz", digest)
    assert read.dtype == np.float32
    assert np.array_equal(read, QPOS)


def test_an_altered_trajectory_is_named_with_the_remedy(tmp_path: Path) -> None:
    save_trajectory(tmp_path, "plinko-0001", QPOS, QPOS)
    digest = trajectory_digest(QPOS)
    altered = QPOS.copy()
    altered[2, 1] += 1e-6
    save_trajectory(tmp_path, "plinko-0001", altered, QPOS)
    with raises(ValueError, "scenes.worlds.spec.load_trajectory", "plinko-0001.npz"):
        load_trajectory(tmp_path / "plinko-0001.npz", digest)


@pytest.mark.parametrize("damage", [b"", b"no archive", None])
def test_an_unreadable_trajectory_is_named_with_the_remedy(tmp_path: Path, damage: bytes | None) -> None:
    save_trajectory(tmp_path, "plinko-0001", QPOS, QPOS)
    digest = trajectory_digest(QPOS)
    path = tmp_path / "plinko-0001.npz"
    path.write_bytes(path.read_bytes()[:-30] if damage is None else damage)
    with raises(ValueError, "scenes.worlds.spec.load_trajectory", "plinko-0001.npz"):
        load_trajectory(path, digest)


def test_a_pickle_is_never_opened(tmp_path: Path) -> None:
    np.savez(tmp_path / "evil.npz", qpos=np.array([{"any": "object"}], dtype=object))
    with raises(ValueError, "scenes.worlds.spec.load_trajectory", "evil.npz"):
        load_trajectory(tmp_path / "evil.npz", "0")


def test_a_missing_trajectory_is_named(tmp_path: Path) -> None:
    with raises(ValueError, "scenes.worlds.spec.load_trajectory", "gone.npz"):
        load_trajectory(tmp_path / "gone.npz", "0")


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
