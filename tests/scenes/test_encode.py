"""Clips: the same frames give the same bytes, a frame is a tenth of a second, and damage is named."""

from __future__ import annotations

import base64
import hashlib
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

from tests.build.errors import raises
from tests.build.frames import frames
from tests.pages import CHROMIUM, a_browser
from traps_pipeline.base.digests import file_digest
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.base.paths import RELEASED
from traps_pipeline.benchmark.records import load_released
from traps_pipeline.scenes.family_registry import get_family
from traps_pipeline.scenes.physics.kit import Physics
from traps_pipeline.scenes.picture.camera import Camera
from traps_pipeline.scenes.picture.render import Renderer
from traps_pipeline.scenes.worlds.clip_notes import check_clip, clip_note_path, read_clip, save_clip
from traps_pipeline.scenes.worlds.outcome import compile_scene
from traps_pipeline.scenes.worlds.spec import load_trajectory
from traps_pipeline.video.encode import DamagedClip, decode, encode, frames_digest


@pytest.fixture
def clip(tmp_path: Path) -> Path:
    path = tmp_path / "clip.mp4"
    encode(frames(), path, 10)
    return path


def test_the_same_frames_give_the_same_bytes_and_others_others(tmp_path: Path) -> None:
    for name, drawn in (("a", frames()), ("b", frames()), ("c", frames()[:-1])):
        encode(drawn, tmp_path / f"{name}.mp4", 10)
    digests = [file_digest(tmp_path / f"{name}.mp4") for name in "abc"]
    assert digests[0] == digests[1] != digests[2]


def test_frame_i_shows_time_i_tenths_exactly(clip: Path) -> None:
    decoded, times = decode(clip)
    assert decoded.shape == (20, 120, 160, 3) and decoded.dtype == np.uint8
    assert times.tolist() == [i / 10 for i in range(20)]


def test_a_clip_cut_off_anywhere_or_none_at_all_is_named_with_the_remedy(clip: Path, tmp_path: Path) -> None:
    whole = clip.read_bytes()
    for kept in [*range(0, len(whole), len(whole) // 40), len(whole) - 1]:
        clip.write_bytes(whole[:kept])
        with raises(DamagedClip, "video.encode.decode", "clip.mp4"):
            decode(clip)
    (tmp_path / "words.mp4").write_text("no clip")
    for name in ("words.mp4", "nothing.mp4"):
        with raises(DamagedClip, "video.encode.decode", name):
            decode(tmp_path / name)


def test_a_clip_is_checked_by_size_and_digest(clip: Path) -> None:
    digest, size = file_digest(clip), clip.stat().st_size
    check_clip(clip, digest, size)
    whole = clip.read_bytes()
    for damaged in (whole[:-1], whole[:-1] + bytes([whole[-1] ^ 1]), b""):
        clip.write_bytes(damaged)
        with raises(DamagedClip, "scenes.worlds.clip_notes.check_clip", "clip.mp4"):
            check_clip(clip, digest, size)
    clip.unlink()
    with raises(DamagedClip, "scenes.worlds.clip_notes.check_clip", "clip.mp4"):
        check_clip(clip, digest, size)


@pytest.mark.slow
def test_a_flipped_bit_in_a_clips_note_is_never_believed(tmp_path: Path) -> None:
    clip = tmp_path / "void.mp4"
    save_clip(clip, frames(3), 10, leaked_pixels=0.25)
    known, note = read_clip(clip), clip_note_path(clip)
    assert known is not None and (known.n_frames, known.fps, known.leaked_pixels) == (3, 10, 0.25)
    written = note.read_bytes()
    for place in range(8 * len(written)):
        flipped = bytearray(written)
        flipped[place // 8] ^= 1 << place % 8
        note.write_bytes(flipped)
        with raises(DamagedClip, "scenes.worlds.clip_notes.read_note", "void.json"):
            read_clip(clip)
    note.unlink()
    assert read_clip(clip) is None  # rendered anew


def test_the_frames_digest_is_over_the_pixels_of_all_frames() -> None:
    drawn = frames(3)
    expected = hashlib.sha256(b"".join(frame.tobytes() for frame in drawn)).hexdigest()
    assert frames_digest(drawn) == expected
    assert frames_digest([np.asfortranarray(frame) for frame in drawn]) == expected
    assert frames_digest(drawn[::-1]) != expected


def test_a_failure_while_encoding_leaves_the_former_clip_and_no_part(clip: Path) -> None:
    before = clip.read_bytes()
    with raises(Exception, "video.encode.encode"):
        encode([*frames(5), np.zeros((7, 7), np.uint8)], clip, 10)
    assert clip.read_bytes() == before
    assert [path.name for path in clip.parent.iterdir()] == ["clip.mp4"]


@pytest.mark.slow
def test_a_real_clip_is_encoded_to_the_same_bytes_every_time(tmp_path: Path) -> None:
    """With x264's macroblock tree on, one encoding in about twenty differed: a clip's digest is part of ledger keys."""
    spec = load_released()["tumbling_dice-0001"]
    family, physics = get_family(spec.family), Physics(**spec.physics)
    model, _ = compile_scene(family, family.params_from(spec.params), physics)
    qpos = load_trajectory(RELEASED / "trajectories" / f"{spec.scenario_id}.npz", spec.trajectory_sha256)
    with Renderer(model, Camera.from_record(spec.camera)) as renderer:
        frames = list(renderer.frames(qpos))
    digests = set()
    for _ in range(30):
        encode(frames, tmp_path / "clip.mp4", physics.fps)
        digests.add(file_digest(tmp_path / "clip.mp4"))
    assert len(digests) == 1


# --- colours ----------------------------------------------------------------------------------------------------------

SIZES = [(480, 360), (960, 720)]  # from 720 lines on players take another matrix where none is stated
# What a page draws of a video's frame at a time, as a PNG.
DRAWN = """async ([source, time]) => {
  const video = document.createElement("video");
  const event = (name) => new Promise((done, failed) => { video[`on${name}`] = done; video.onerror = failed; });
  video.muted = true;
  const loaded = event("loadeddata");
  video.src = source;
  await loaded;
  const sought = event("seeked");
  video.currentTime = time;
  await sought;
  await new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)));
  const canvas = document.createElement("canvas");
  [canvas.width, canvas.height] = [video.videoWidth, video.videoHeight];
  canvas.getContext("2d").drawImage(video, 0, 0);
  return canvas.toDataURL("image/png");
}"""


def patches(width: int, height: int) -> np.ndarray:
    """A frame (H, W, 3) of 48 patches, the first six red, green, blue, yellow, white and black."""
    colours = np.random.default_rng(0).integers(0, 256, (6, 8, 3)).astype(np.uint8)
    colours[0, :6] = [(255, 0, 0), (0, 255, 0), (0, 0, 255), (255, 255, 0), (255, 255, 255), (0, 0, 0)]
    return colours.repeat(height // 6, axis=0).repeat(width // 8, axis=1)


@pytest.mark.parametrize(("width", "height"), SIZES)
def test_a_clip_states_the_colours_that_it_is_encoded_by(tmp_path: Path, width: int, height: int) -> None:
    import av

    encode([patches(width, height)] * 2, tmp_path / "clip.mp4", 10)
    with av.open(str(tmp_path / "clip.mp4")) as container:
        stated = container.streams.video[0].codec_context
        # ITU-T H.273: 6 is SMPTE 170M, which is BT.601 of 525 lines; range 1 is limited.
        assert (stated.color_primaries, stated.color_trc, stated.colorspace) == (6, 6, 6)
        assert stated.color_range == 1
        planes = next(container.decode(video=0)).to_ndarray(channel_last=True, format="yuv444p")
    # ITU-R BT.601, limited range: Y = 16 + 65.481 R + 128.553 G + 24.966 B; BT.709 would give red a Y of 63.
    middles = [planes[height // 12, width // 16 + k * width // 8].tolist() for k in range(6)]
    wanted = [(81, 90, 240), (145, 54, 34), (41, 240, 110), (210, 16, 146), (235, 128, 128), (16, 128, 128)]
    assert np.abs(np.array(middles) - wanted).max() <= 2


@pytest.mark.slow
@pytest.mark.skipif(shutil.which(CHROMIUM) is None, reason="chromium is not installed")
@pytest.mark.parametrize(("width", "height"), SIZES)
def test_a_browser_shows_the_pixels_that_a_model_is_shown(tmp_path: Path, width: int, height: int) -> None:
    encode([patches(width, height)] * 5, tmp_path / "clip.mp4", 10)
    decoded, _ = decode(tmp_path / "clip.mp4")
    source = f"data:video/mp4;base64,{base64.b64encode((tmp_path / 'clip.mp4').read_bytes()).decode()}"
    with a_browser() as browser:
        drawn = browser.new_page().evaluate(DRAWN, [source, 0.25])
    png = np.frombuffer(base64.b64decode(drawn.partition(",")[2]), np.uint8)
    shown = cv2.imdecode(png, cv2.IMREAD_COLOR)
    assert shown is not None and shown.shape == (height, width, 3)
    difference = np.abs(shown[..., ::-1].astype(int) - decoded[2])
    assert difference.mean() < 2 and difference.max() <= 10  # of 255; 6.3 and 40 at 720 lines where none are stated


@pytest.mark.parametrize(("shape", "wanted"), [((360, 481, 3), "482 x 360"), ((359, 480, 3), "480 x 360")])
def test_a_clip_with_an_odd_side_is_refused_before_a_file_is_written(
    shape: tuple[int, ...], wanted: str, tmp_path: Path
) -> None:
    with raises(TrapsError, "video.encode.encode", "clip.mp4", wanted):
        encode([np.zeros(shape, np.uint8)], tmp_path / "clip.mp4", 5)
    assert not list(tmp_path.iterdir())
