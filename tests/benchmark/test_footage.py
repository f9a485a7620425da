"""People's own videos become frames as rendered clips have them, or one sentence says why not: real encoded files."""

from __future__ import annotations

import shutil
import struct
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import pytest

from tests.build.recorded import ball, film
from traps_pipeline.benchmark.footage import UnusableFootage, read_footage


def quarters(n: int = 30, size: tuple[int, int] = (320, 240)) -> list[np.ndarray]:
    """Return frames whose quarters are red, green, blue and white, from the upper left on, under a moving bar."""
    width, height = size
    frames = []
    for k in range(n):
        frame = np.zeros((height, width, 3), np.uint8)
        frame[: height // 2, : width // 2], frame[: height // 2, width // 2 :] = (220, 30, 30), (30, 200, 30)
        frame[height // 2 :, : width // 2], frame[height // 2 :, width // 2 :] = (30, 30, 220), (235, 235, 235)
        frame[:, int(k / n * width) :][:, : width // 16] = 0
        frames.append(frame)
    return frames


def corners(frame: np.ndarray) -> list[str]:
    """Return the colours of a frame's corners, from the upper left on, row by row."""
    names = {"red": (220, 30, 30), "green": (30, 200, 30), "blue": (30, 30, 220), "white": (235, 235, 235)}
    height, width = frame.shape[:2]
    spots = [frame[y, x].astype(int) for y in (height // 8, -height // 8) for x in (width // 4, -width // 4)]
    return [min(names, key=lambda name: int(np.abs(spot - names[name]).sum())) for spot in spots]


def turn(path: Path, matrix: tuple[int, int, int, int]) -> None:
    """Write a turned display matrix into the track header of an mp4, as a phone that is held upright does."""
    data = bytearray(path.read_bytes())
    at = data.index(b"tkhd") + 4 + 40  # version 0: nine numbers of 32 bits follow
    for place, value in zip((0, 1, 3, 4), matrix, strict=True):
        struct.pack_into(">i", data, at + 4 * place, value << 16)
    path.write_bytes(data)


def test_a_clip_is_read_at_ten_frames_a_second_without_sound(tmp_path: Path) -> None:
    footage = read_footage(film(tmp_path / "a.mp4", quarters(60), rate=20, sound=True))
    assert len(footage.frames) == 30
    assert footage.frames[0].shape == (240, 320, 3)
    assert corners(footage.frames[-1]) == ["red", "green", "blue", "white"]


@pytest.mark.parametrize(
    ("matrix", "upright"),
    [
        ((0, 1, -1, 0), ["blue", "red", "white", "green"]),  # a quarter turn clockwise
        ((0, -1, 1, 0), ["green", "white", "red", "blue"]),
        ((-1, 0, 0, -1), ["white", "blue", "green", "red"]),
    ],
)
def test_a_turned_clip_stands_upright(tmp_path: Path, matrix: tuple[int, int, int, int], upright: list[str]) -> None:
    path = film(tmp_path / "a.mp4", quarters())
    turn(path, matrix)
    footage = read_footage(path)
    assert corners(footage.frames[5]) == upright
    assert footage.seen == ((240, 320) if matrix[0] == 0 else (320, 240))


def test_uneven_times_are_shown_as_a_player_shows_them(tmp_path: Path) -> None:
    """Grey k stands from its time to the next one's: 0, 0.1, 0.2, then a gap to 0.6, and 1.0 to the end at 1.1."""
    greys = [np.full((96, 96, 3), 20 * k + 10, np.uint8) for k in range(5)]
    path = film(tmp_path / "a.mp4", [*greys, greys[0]], rate=20, times=[0, 2, 4, 12, 20, 22], options={"qp": "0"})
    shown = [round((int(frame.mean()) - 10) / 20) for frame in read_footage(path).frames]
    assert shown == [0, 1, 2, 2, 2, 2, 3, 3, 3, 3, 4, 0][: len(shown)]
    assert len(shown) in (11, 12)


def test_a_part_of_a_long_clip_is_read_by_its_times(tmp_path: Path) -> None:
    greys = [np.full((96, 96, 3), 2 * k, np.uint8) for k in range(120)]
    path = film(tmp_path / "a.mp4", greys, rate=10, options={"qp": "0", "g": "12"})
    footage = read_footage(path, 7.3, 9.3)
    assert [frame.mean() for frame in footage.frames] == pytest.approx([2 * k for k in range(73, 93)], abs=1.0)


def test_wide_pixels_are_made_square_and_large_pictures_as_large_as_rendered_ones(tmp_path: Path) -> None:
    path = film(tmp_path / "a.mp4", quarters(20, (720, 576)), sample_aspect_ratio=Fraction(64, 45))
    footage = read_footage(path)
    assert footage.seen == (1024, 576)
    height, width = footage.frames[0].shape[:2]
    assert width / height == pytest.approx(1024 / 576, rel=0.01)
    assert height * width == pytest.approx(480 * 360, rel=0.02)


@pytest.mark.parametrize(("space", "size"), [("bt709", (320, 240)), ("smpte170m", (320, 240)), (None, (1280, 720))])
def test_colours_are_those_that_a_player_shows(tmp_path: Path, space: str | None, size: tuple[int, int]) -> None:
    """What a file states counts; one of 720 lines that states nothing is BT.709."""
    path, stated = tmp_path / "a.mp4", {"colorspace": space} if space else {}
    with av.open(str(path), "w") as file:
        stream = file.add_stream("libx264", rate=10, options={"crf": "4", "preset": "ultrafast", **stated})
        stream.width, stream.height, stream.pix_fmt = *size, "yuv420p"
        for picture in quarters(12, size):
            frame = av.VideoFrame.from_ndarray(picture, format="rgb24")
            as_written = "ITU601" if space == "smpte170m" else "ITU709"
            frame = frame.reformat(format="yuv420p", dst_colorspace=as_written)
            file.mux(stream.encode(frame))
        file.mux(stream.encode(None))
    frame = read_footage(path).frames[0]
    height, width = frame.shape[:2]
    assert np.abs(frame[height // 4, width // 4].astype(int) - (220, 30, 30)).max() <= 6


def test_an_odd_size_is_made_even_and_said(tmp_path: Path) -> None:
    path = film(tmp_path / "a.mkv", quarters(20, (133, 101)), codec="ffv1", pix_fmt="yuv444p", options={})
    footage = read_footage(path)
    assert footage.frames[0].shape[:2] == (100, 132)
    assert footage.notes == ["133 x 101 pixels, shown as 132 x 100"]


def _empty(path: Path) -> None:
    path.write_bytes(b"")


def _cut_off(path: Path) -> None:
    film(path, quarters(40))
    path.write_bytes(path.read_bytes()[:1500])


def _breaks_off(path: Path) -> None:
    film(path, quarters(40), container={"movflags": "+faststart"})
    path.write_bytes(path.read_bytes()[:-4000])


def _text(path: Path) -> None:
    path.write_text("no video")


def _playlist(path: Path) -> None:
    film(path.with_name("other.mp4"), quarters(40))
    other = path.with_name("other.mp4").as_uri()
    path.write_text(f"#EXTM3U\n#EXT-X-TARGETDURATION:5\n#EXTINF:5,\n{other}\n#EXT-X-ENDLIST\n")


def _one_frame(path: Path) -> None:
    film(path, quarters(1))


def _still(path: Path) -> None:
    film(path, [quarters()[0]] * 40, options={"crf": "30"})


def _short(path: Path) -> None:
    film(path, quarters(8), rate=20)


def _long(path: Path) -> None:
    film(path, quarters(3), rate=1, times=[0, 1, 36_000])


def _small(path: Path) -> None:
    film(path, quarters(30, (48, 32)))


def _hdr(path: Path) -> None:
    film(path, quarters(), options={"preset": "ultrafast", "x264-params": "transfer=smpte2084:colorprim=bt2020"})


def _transparent(path: Path) -> None:
    see_through = [np.dstack([frame, np.full(frame.shape[:2], 90, np.uint8)]) for frame in quarters(12)]
    film(path, see_through, codec="ffv1", pix_fmt="bgra", options={}, rate=10)


def _sound(path: Path) -> None:
    with av.open(str(path), "w", format="mp4") as file:
        stream = file.add_stream("aac", rate=48000)
        hum = av.AudioFrame.from_ndarray(np.zeros((1, 1024), np.float32), format="fltp", layout="mono")
        hum.sample_rate = 48000
        file.mux(stream.encode(hum))
        file.mux(stream.encode(None))


def _huge(path: Path) -> None:
    film(path, [np.zeros((8704, 8704, 3), np.uint8)], codec="mjpeg", pix_fmt="yuvj420p", options={})


@pytest.mark.parametrize(
    ("make", "suffix", "reason"),
    [
        (_empty, ".mp4", "is empty"),
        (_cut_off, ".mp4", "cannot be read"),
        (_breaks_off, ".mp4", "breaks off after"),
        (_text, ".mp4", "cannot be read"),
        (_playlist, ".m3u8", "cannot be read"),
        (_one_frame, ".mp4", "one picture"),
        (_still, ".mp4", "still picture"),
        (_short, ".mp4", "shows 0.4 s"),
        (_long, ".mp4", "lasts 36,00"),
        (_small, ".mp4", "is 48 x 32 pixels"),
        (_hdr, ".mp4", "is HDR (PQ)"),
        (_transparent, ".mkv", "is transparent"),
        (_sound, ".mp4", "has no video stream"),
        (_huge, ".mkv", "of 8704 x 8704 pixels"),
    ],
)
def test_what_makes_no_clip_gets_one_sentence(tmp_path: Path, make, suffix: str, reason: str) -> None:
    path = tmp_path / f"clip{suffix}"
    make(path)
    with pytest.raises(UnusableFootage) as refused:
        read_footage(path)
    assert reason in str(refused.value)
    assert "\n" not in str(refused.value)


def test_ten_hours_of_which_two_seconds_are_named_are_read(tmp_path: Path) -> None:
    frames = quarters(40)
    times = [*range(20), *range(720_000, 720_020)]  # at 20 a second: ten hours later it goes on
    path = film(tmp_path / "a.mp4", frames, rate=20, times=times)
    assert len(read_footage(path, 0.0, 1.0).frames) == 10
    assert len(read_footage(path, 35_999.9, 36_001.0).frames) == 11


def test_no_name_or_metadata_of_a_file_is_in_what_is_read(tmp_path: Path) -> None:
    one = film(tmp_path / "the answer is left.mp4", ball("left"))
    other = shutil.copy(one, tmp_path / "b.mov")
    frames, same = read_footage(one).frames, read_footage(Path(other)).frames
    assert all(np.array_equal(a, b) for a, b in zip(frames, same, strict=True))
