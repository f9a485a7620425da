"""Frames are picked by time stamp, and what is sent is encoded once, is the same everywhere, and is never damaged."""

from __future__ import annotations

import base64
import errno
import hashlib
import os
import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from pydantic import ValidationError

from tests.build.errors import raises
from tests.build.frames import frames
from traps_pipeline.base.digests import file_digest
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.models.registry.entries import load_models
from traps_pipeline.storage import media
from traps_pipeline.storage.media import MediaSpec, MediaStore, data_uris, payload, pick, pick_frames, profile_digest
from traps_pipeline.video.encode import DamagedClip, decode, decode_sampled, encode
from traps_pipeline.video.policies import POLICIES, FramePolicy

VIDEO = MediaSpec(profile="video", fps=5)
IMAGES = MediaSpec(profile="images", fps=5)
QWEN = MediaSpec(profile="frames", uniform=16)
GRID = MediaSpec(profile="frames", fps=2, most=32)


def write_clip(path: Path, count: int = 50, fps: int = 10) -> tuple[Path, str]:
    encode(frames(count, step=2), path, fps)
    return path, file_digest(path)


def shown(frame: np.ndarray) -> int:
    """Which of the drawn frames it is, by where the square is."""
    red = (frame[60, :, 0] > 160) & (frame[60, :, 1] < 110)
    return round(int(np.flatnonzero(red).min()) / 2)


@pytest.fixture
def clip(tmp_path: Path) -> tuple[Path, str]:
    """A control of full length: 50 frames, 10 a second."""
    return write_clip(tmp_path / "clips" / "control.mp4")


@pytest.fixture
def store(tmp_path: Path) -> MediaStore:
    return MediaStore(tmp_path / "media")


@pytest.fixture
def encoded(monkeypatch: pytest.MonkeyPatch) -> list[Path]:
    """Grows by one with each video that is encoded."""
    calls: list[Path] = []

    def counting(frames: list[np.ndarray], path: Path, fps: int) -> None:
        calls.append(path)
        encode(frames, path, fps)

    monkeypatch.setattr(media, "encode", counting)
    return calls


def at(count: int, fps: float, spec: MediaSpec) -> list[int]:
    """Which of a clip's frames are picked."""
    return pick(np.arange(count) / fps, spec).tolist()


# --- specs ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "fields",
    [
        {"profile": "video"},
        {"profile": "frames", "fps": 2, "uniform": 16},
        {"profile": "frames", "uniform": 16, "most": 32},
        {"profile": "video", "uniform": 16},
        {"profile": "video", "fps": 2.5},
        {"profile": "video", "fps": 5, "size": [335, 336]},
        {"profile": "frames", "fps": 5, "size": [336, 0]},
        {"profile": "frames", "fps": 0},
        {"profile": "frames", "fps": float("nan")},
        {"profile": "frames", "fps": 5, "most": 0},
        {"profile": "frames", "uniform": 0},
        {"profile": "film", "fps": 5},
        {"profile": "frames", "fps": 5, "sise": [336, 336]},
    ],
)
def test_a_wrong_spec_is_named(fields: dict[str, Any]) -> None:
    with raises(ValidationError, "MediaSpec"):
        MediaSpec.model_validate(fields)


# --- frames -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("count", "fps", "spec", "picked"),
    [
        (50, 10, VIDEO, range(0, 50, 2)),  # 0, 0.2, ..., 4.8 s
        (51, 10, VIDEO, range(0, 50, 2)),  # a frame at 5.0 s would be the 26th
        (49, 10, VIDEO, range(0, 49, 2)),  # the last one, 4.8 s, is on the grid
        (48, 10, VIDEO, range(0, 48, 2)),  # ... and here it is not
        (11, 10, VIDEO, range(0, 11, 2)),  # a short clip gives what it has
        (5, 1, VIDEO, range(5)),  # a slower clip gives each of its frames once
        (40, 1, VIDEO, range(25)),
        # 49 / 15 = 3.267 frames apart: 0, 3.27, 6.53, 9.8, 13.07, 16.33, 19.6, 22.87, 26.13, 29.4, 32.67, 35.93, 39.2
        (50, 10, QWEN, [0, 3, 7, 10, 13, 16, 20, 23, 26, 29, 33, 36, 39, 42, 46, 49]),
        (17, 10, QWEN, [0, 1, 2, 3, 4, 5, 6, 7, 9, 10, 11, 12, 13, 14, 15, 16]),  # 16 / 15 frames apart
        (16, 10, QWEN, range(16)),
        (11, 10, QWEN, range(11)),
        (50, 10, GRID, range(0, 50, 5)),
        (1000, 10, GRID, range(0, 160, 5)),  # at most 32
        (11, 10, MediaSpec(profile="frames", fps=4), [0, 2, 5, 7, 10]),  # 0.25 and 0.75 s lie between two: the earlier
        (4, 10, MediaSpec(profile="frames", uniform=3), [0, 1, 3]),
        *((1, 10, spec, [0]) for spec in (VIDEO, QWEN, GRID)),
    ],
)
def test_frames_are_picked_as_worked_out_by_hand(count: int, fps: int, spec: MediaSpec, picked: Sequence[int]) -> None:
    assert at(count, fps, spec) == [*picked]


def test_what_is_certified_for_every_frame_policy_is_certified_for_those_of_all_registered_models() -> None:
    others = [entry for entry in load_models().values() if entry.groups.family != "pocket"]
    shown = [entry.media for entry in others if entry.media is not None]
    policies = {FramePolicy(each.fps, each.uniform, each.most) for each in shown}
    assert policies == set(POLICIES)  # the pocket models see eight frames alone


def test_frames_are_picked_by_time_stamp_not_by_number() -> None:
    times = np.array([0.0, 0.05, 0.19, 0.21, 0.5, 0.61])
    assert pick(times, VIDEO).tolist() == [0, 2, 4, 5]  # wanted: 0, 0.2 (0.19 and 0.21 equally near), 0.4, 0.6


@pytest.mark.slow
def test_a_sample_is_the_decoded_frames_with_their_times(clip: tuple[Path, str]) -> None:
    whole, times = decode(clip[0])
    for spec in (VIDEO, IMAGES):
        sampled = pick_frames(clip[0], spec)
        assert sampled.frames.dtype == np.uint8 and sampled.frames.shape == (25, 120, 160, 3)
        assert np.array_equal(sampled.frames, whole[::2]) and sampled.times_s.tolist() == times[::2].tolist()
        assert sampled.times_s.dtype == np.float64 and sampled.clip_fps == 10.0
        assert np.array_equal(sampled.frames, decode_sampled(clip[0]))  # what the observer sees
    assert [shown(frame) for frame in pick_frames(clip[0], GRID).frames] == list(range(0, 50, 5))


def test_a_sample_is_resized_to_width_and_height(clip: tuple[Path, str]) -> None:
    wide = pick_frames(clip[0], MediaSpec(profile="frames", fps=2, size=(80, 60))).frames
    assert wide.shape == (10, 60, 80, 3) and wide.dtype == np.uint8
    averaged = pick_frames(clip[0], GRID).frames.reshape(10, 60, 2, 80, 2, 3).mean(axis=(2, 4))  # half: a mean of 2 x 2
    assert np.abs(wide - averaged).max() <= 1
    same = pick_frames(clip[0], MediaSpec(profile="frames", fps=2, size=(160, 120))).frames
    assert np.array_equal(same, pick_frames(clip[0], MediaSpec(profile="frames", fps=2)).frames)


def test_a_broken_clip_is_named(tmp_path: Path, store: MediaStore, clip: tuple[Path, str]) -> None:
    path, digest = clip
    path.write_bytes(path.read_bytes()[:-100])
    with raises(DamagedClip, "video.encode.decode", "control.mp4"):
        pick_frames(path, VIDEO)
    with raises(DamagedClip, "storage.media._require", "control.mp4"):
        store.prepare(path, digest, VIDEO)
    with raises(DamagedClip, "storage.media._require", "none.mp4"):
        store.prepare(tmp_path / "none.mp4", digest, VIDEO)
    assert store.known(digest, VIDEO) is None


# --- video ------------------------------------------------------------------------------------------------------------


def test_the_sent_video_has_the_picked_frames_and_looks_like_the_source(
    clip: tuple[Path, str], store: MediaStore
) -> None:
    made = store.prepare(*clip, VIDEO)
    assert made.path is not None
    sent, times = decode(made.path)
    assert len(sent) == made.n_frames == 25 and made.fps == 5
    assert times == pytest.approx([i / 5 for i in range(25)], abs=1e-9)
    assert made.times_s == pytest.approx([i / 5 for i in range(25)], abs=1e-9)
    assert [shown(frame) for frame in sent] == list(range(0, 50, 2))
    drawn = np.stack(frames(50, step=2)[::2])
    for source in (pick_frames(clip[0], VIDEO).frames, drawn):
        error = ((sent.astype(float) - source) ** 2).mean(axis=(1, 2, 3))
        assert (10 * np.log10(255**2 / error) > 30).all()  # dB
    assert made.sha256 == file_digest(made.path) and made.size_bytes == made.path.stat().st_size
    assert payload(made) == [made.path.read_bytes()]


def test_a_short_clip_is_a_short_video(tmp_path: Path, store: MediaStore) -> None:
    made = store.prepare(*write_clip(tmp_path / "void.mp4", 11), VIDEO)
    assert made.path is not None
    assert made.n_frames == 6 and decode(made.path)[1] == pytest.approx([0, 0.2, 0.4, 0.6, 0.8, 1.0], abs=1e-9)
    single = store.prepare(*write_clip(tmp_path / "one.mp4", 1), VIDEO)
    assert (single.n_frames, single.times_s, single.fps) == (1, (0.0,), 5)


def test_a_clip_slower_than_asked_is_not_sped_up(tmp_path: Path, store: MediaStore) -> None:
    made = store.prepare(*write_clip(tmp_path / "slow.mp4", 4, fps=1), VIDEO)
    assert made.path is not None
    assert (made.n_frames, made.fps, made.times_s) == (4, 1, (0, 1, 2, 3))
    assert decode(made.path)[1].tolist() == [0, 1, 2, 3]


def test_a_clip_whose_frame_rate_no_video_can_have_is_named(
    tmp_path: Path, store: MediaStore, clip: tuple[Path, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(media, "decode", lambda *_: (np.stack(frames(4)), np.arange(4) / 2.5))
    with raises(TrapsError, "storage.media._rate", "control.mp4", "2.5"):
        store.prepare(*clip, VIDEO)
    assert store.prepare(*clip, IMAGES).n_frames == 4


# --- images and frames ------------------------------------------------------------------------------------------------


def test_images_are_jpegs_of_the_same_frames(clip: tuple[Path, str], store: MediaStore) -> None:
    made = store.prepare(*clip, IMAGES)
    jpegs = payload(made)
    assert len(jpegs) == made.n_frames == 25 and made.fps is None
    assert made.times_s == store.prepare(*clip, VIDEO).times_s
    assert made.sha256 == hashlib.sha256(b"".join(jpegs)).hexdigest()
    for jpeg, frame in zip(jpegs, pick_frames(clip[0], IMAGES).frames, strict=True):
        seen = cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR)
        assert seen is not None
        error = ((seen[..., ::-1].astype(float) - frame) ** 2).mean()  # OpenCV has BGR
        assert 10 * np.log10(255**2 / error) > 30


def test_frames_have_a_digest_and_no_file(clip: tuple[Path, str], store: MediaStore) -> None:
    made = store.prepare(*clip, QWEN)
    assert made.path is None and made.fps is None and made.n_frames == 16 and made.size_bytes == 16 * 120 * 160 * 3
    assert made.times_s == pytest.approx([i / 10 for i in at(50, 10, QWEN)])
    assert [path.suffix for path in store.folder.rglob("*") if path.is_file() and path.suffix] == [".json"]
    assert store.prepare(*clip, QWEN) == MediaStore(store.folder).prepare(*clip, QWEN) == made
    for ask in (payload, data_uris):
        with raises(TrapsError, "storage.media.payload"):
            ask(made)


# --- the store --------------------------------------------------------------------------------------------------------


def test_what_is_prepared_is_not_encoded_again(clip: tuple[Path, str], store: MediaStore, encoded: list[Path]) -> None:
    assert store.known(clip[1], VIDEO) is None
    made = store.prepare(*clip, VIDEO)
    assert made.path is not None
    before = made.path.stat().st_mtime_ns
    assert store.known(clip[1], VIDEO) == store.prepare(*clip, VIDEO) == made
    later = MediaStore(store.folder)  # as another process has it
    assert later.known(clip[1], VIDEO) == later.prepare(*clip, VIDEO) == made
    assert len(encoded) == 1 and made.path.stat().st_mtime_ns == before


@pytest.mark.parametrize("spec", [VIDEO, IMAGES, QWEN])
def test_the_same_clip_elsewhere_has_the_same_digest(clip: tuple[Path, str], tmp_path: Path, spec: MediaSpec) -> None:
    elsewhere = tmp_path / "elsewhere" / "other-name.mp4"
    elsewhere.parent.mkdir()
    elsewhere.write_bytes(clip[0].read_bytes())
    one = MediaStore(tmp_path / "a").prepare(*clip, spec)
    other = MediaStore(tmp_path / "b").prepare(elsewhere, clip[1], spec)
    assert one.sha256 == other.sha256 and one.times_s == other.times_s


def test_the_digest_changes_with_frames_size_and_profile(clip: tuple[Path, str], store: MediaStore) -> None:
    changes: list[dict[str, Any]] = [{}, {"fps": 2}, {"most": 10}, {"size": (80, 60)}]
    specs = [
        MediaSpec.model_validate({"profile": profile, "fps": 5} | change)
        for profile in ("video", "images", "frames")
        for change in changes
    ]
    assert len({store.prepare(*clip, spec).sha256 for spec in specs}) == len(specs)
    assert len({profile_digest(spec) for spec in specs}) == len(specs)


def test_the_profile_covers_the_settings_of_its_encoder(monkeypatch: pytest.MonkeyPatch) -> None:
    before = [profile_digest(spec) for spec in (VIDEO, IMAGES, QWEN)]
    monkeypatch.setattr(media, "JPEG_QUALITY", 80)
    monkeypatch.setattr(media, "ENCODER", {"crf": "30"})
    changed = [profile_digest(spec) != old for spec, old in zip((VIDEO, IMAGES, QWEN), before, strict=True)]
    assert changed == [True, True, False]


def truncate(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-100])


def flip(path: Path) -> None:
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)


@pytest.mark.parametrize("damage", [truncate, flip, Path.unlink])
@pytest.mark.parametrize("spec", [VIDEO, IMAGES])
def test_a_damaged_file_is_noticed_and_made_anew(
    clip: tuple[Path, str], store: MediaStore, spec: MediaSpec, damage: Callable[[Path], None]
) -> None:
    made = store.prepare(*clip, spec)
    assert made.path is not None
    good = made.path.read_bytes()
    damage(made.path)
    with raises(DamagedClip, "storage.media.payload"):
        payload(made)
    if damage is not flip:
        assert MediaStore(store.folder).known(clip[1], spec) is None  # by its size alone
    assert MediaStore(store.folder).prepare(*clip, spec) == made
    assert made.path.read_bytes() == good


@pytest.mark.parametrize("note", ["", "{", "[]", "3", "{}", '{"sha256": "x", "times_s": 1}', '{"times_s": [0.0]}'])
def test_a_damaged_note_vouches_for_nothing(clip: tuple[Path, str], store: MediaStore, note: str) -> None:
    made = store.prepare(*clip, VIDEO)
    assert made.path is not None
    made.path.with_suffix(".json").write_text(note)
    later = MediaStore(store.folder)
    assert later.known(clip[1], VIDEO) is None
    assert later.prepare(*clip, VIDEO) == made == MediaStore(store.folder).known(clip[1], VIDEO)


def test_a_full_disk_is_named_and_leaves_no_part(
    clip: tuple[Path, str], store: MediaStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: Any) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    for spec in (VIDEO, IMAGES, QWEN):
        with monkeypatch.context() as disk:
            disk.setattr(Path, "replace", full)
            with raises(TrapsError, "base.files.replace_file"):
                store.prepare(*clip, spec)
        assert [path.name for path in store.folder.rglob("*") if path.is_file()] == [".lock"]


PREPARE = """
import sys
from pathlib import Path
from traps_pipeline.storage import media
encode, count = media.encode, [0]
def counting(*arguments):
    count[0] += 1
    encode(*arguments)
media.encode = counting
print("ready", flush=True)
clip, digest, folder = sys.argv[1:]
made = media.MediaStore(Path(folder)).prepare(Path(clip), digest, media.MediaSpec(profile="video", fps=5))
print(count[0], made.sha256)
"""


@pytest.mark.slow
def test_two_processes_at_once_make_one_good_file(clip: tuple[Path, str], store: MediaStore) -> None:
    command = [sys.executable, "-c", PREPARE, str(clip[0]), clip[1], str(store.folder)]
    with media._lock_folder(store.folder / clip[1][:2]):  # so that both find nothing there, and wait for their turn
        processes = [subprocess.Popen(command, stdout=subprocess.PIPE, text=True) for _ in range(2)]
        for process in processes:
            assert process.stdout is not None and process.stdout.readline() == "ready\n"
    said = [process.communicate(timeout=540)[0].split() for process in processes]
    made = store.known(clip[1], VIDEO)
    assert made is not None and sorted(count for count, _ in said) == ["0", "1"]
    assert {sha256 for _, sha256 in said} == {made.sha256} and len(payload(made)) == 1


# --- as text ----------------------------------------------------------------------------------------------------------


def test_data_uris_hold_what_is_sent(clip: tuple[Path, str], store: MediaStore) -> None:
    for spec, start in ((VIDEO, "data:video/mp4;base64,"), (IMAGES, "data:image/jpeg;base64,")):
        made = store.prepare(*clip, spec)
        uris = data_uris(made)
        assert all(uri.startswith(start) for uri in uris)
        assert [base64.b64decode(uri.removeprefix(start)) for uri in uris] == payload(made)
        assert data_uris(made) is uris
