"""Read people's own videos into frames as rendered clips have them (docs/recorded.md).

A clip is read by its picture alone: upright, square pixels, 8-bit RGB, ten frames a second, about as many pixels as a
rendered clip. Sound, subtitles, chapters and metadata are not read.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from av import VideoFrame

FPS = 10  # of rendered clips
AREA = 480 * 360  # pixels of a rendered clip
MIN_S, MAX_S = 1.0, 5.0  # an API model sees 25 frames, at five a second
LEAST_PX, MOST_PX = 64, 8192 * 4320  # of the shorter side; of a picture
STILL_LEVELS = 4  # of 255, at an eighth of the size: codecs make less noise where nothing moves
LOST_S = 0.5  # of its declared length that a video may lack
_HDR = {16: "PQ", 18: "HLG"}  # transfer functions (ISO/IEC 23091-2)
_UNSPECIFIED, _BT709, _BT601 = 2, 1, 5
_EPS = 1e-3  # s: containers round times to a millisecond


class UnusableFootage(ValueError):
    """Raised for a video that makes no clip; the message says what is wrong, and what to do."""


@dataclass(frozen=True)
class Footage:
    """A clip cut from a video: frames (H, W, 3) uint8 RGB, its size in px, and in words what was changed."""

    frames: list[np.ndarray]
    seen: tuple[int, int]
    notes: list[str] = field(default_factory=list)


def read_footage(path: Path, start_s: float = 0.0, end_s: float | None = None) -> Footage:
    """Return a video's frames from `start_s` to `end_s` (default: to its end). Raises UnusableFootage."""
    import av
    from av.error import FFmpegError

    try:
        if not path.stat().st_size:
            raise UnusableFootage("is empty; copy the video again")
        # From a stream and under no protocol: a playlist cannot name other files or addresses.
        with path.open("rb") as file, av.open(file, options={"protocol_whitelist": "none"}) as container:
            return _read(container, start_s, end_s)
    except (FFmpegError, OSError, ValueError) as error:
        if isinstance(error, UnusableFootage):
            raise
        reason = getattr(error, "strerror", None) or error
        raise UnusableFootage(f"cannot be read as a video ({reason}); convert it to mp4 (H.264)") from error


def _read(container: Any, start_s: float, end_s: float | None) -> Footage:
    videos = [each for each in container.streams.video if not each.disposition & each.disposition.attached_pic]
    if not videos:
        raise UnusableFootage("has no video stream; give a video")
    stream = videos[0]
    stream.thread_type = "AUTO"
    width, height = stream.codec_context.width, stream.codec_context.height
    if width * height > MOST_PX:
        raise UnusableFootage(f"has pictures of {width} x {height} pixels; scale it down to 3840 x 2160 or less")
    declared = stream.duration * stream.time_base if stream.duration else (container.duration or 0) / 1e6
    if (end_s if end_s is not None else float(declared)) - start_s > MAX_S + 1 / FPS:
        raise UnusableFootage(_too_long(float(declared) if end_s is None else end_s - start_s))
    frames, last, seen = list[np.ndarray](), None, (width, height)
    for frame in _shown(_decoded(container, stream, start_s), start_s, end_s):
        if last is None:  # as a player shows it: square pixels, turned as the camera was
            across, down = round(frame.width * float(stream.sample_aspect_ratio or 1)), frame.height
            seen = (down, across) if frame.rotation % 180 else (across, down)
        frames.append(frames[-1] if frame is last else _upright(frame, (width, height), seen))
        last = frame
    promised = min(math.inf if end_s is None else end_s, float(declared)) if stream.duration else 0.0
    if promised - (reached := start_s + len(frames) / FPS) > LOST_S:
        raise UnusableFootage(f"breaks off after {reached:.1f} s; give start_s and end_s of what is whole")
    if len({id(frame) for frame in frames}) < 2:
        raise UnusableFootage("has one picture there; give a video, or other times")
    if len(frames) < MIN_S * FPS:
        raise UnusableFootage(f"shows {len(frames) / FPS:.1f} s there; give a clip of {MIN_S:g} s or more")
    if _is_still(frames):
        raise UnusableFootage("is a still picture there; give a clip in which something moves")
    out = frames[0].shape[1], frames[0].shape[0]
    notes = [f"{seen[0]} x {seen[1]} pixels, shown as {out[0]} x {out[1]}"] if seen[0] % 2 or seen[1] % 2 else []
    return Footage(frames, seen, notes)


def _too_long(seconds: float) -> str:
    return (
        f"lasts {seconds:,.1f} s, of which models are shown the first {MAX_S:g}; give start_s and end_s, at most "
        f"{MAX_S:g} s apart"
    )


def _decoded(container: Any, stream: Any, start_s: float) -> Iterator[tuple[float, float, VideoFrame]]:
    """Yield time (s), duration (s) and frame, from `start_s` or before on; times ascend. Raises UnusableFootage."""
    from av.error import FFmpegError

    begin = float((stream.start_time or 0) * stream.time_base)
    rate = float(stream.average_rate or stream.guessed_rate or FPS)
    if start_s > 1:
        container.seek(int((start_s + begin) / stream.time_base), stream=stream)
    last = -math.inf
    try:
        for frame in container.decode(stream):
            if frame.time is None:
                raise UnusableFootage("has frames without times; convert it to mp4 (H.264)")
            if (at := float(frame.time) - begin) > last:
                yield at, float(frame.duration * frame.time_base) if frame.duration else 1 / rate, frame
                last = at
    except FFmpegError as error:
        at = f"after {last:.1f} s" if last > -math.inf else "at its first picture"
        raise UnusableFootage(f"breaks off {at} ({error.strerror}); give start_s and end_s of what is whole") from error


def _shown(
    decoded: Iterator[tuple[float, float, VideoFrame]], start_s: float, end_s: float | None
) -> Iterator[VideoFrame]:
    """Yield the frame that a player shows at each tick of the clip's even grid."""
    tick, end, previous = 0, math.inf if end_s is None else end_s, None

    def due(until: float) -> bool:
        at = start_s + tick / FPS
        return at < until - _EPS and at < end - _EPS

    for at, length, frame in decoded:
        while previous is not None and due(at):
            yield previous[2]
            tick += 1
            if tick > MAX_S * FPS:
                raise UnusableFootage(_too_long(at - start_s))
        if at >= end:
            return
        previous = at, length, frame
    while previous is not None and tick < MAX_S * FPS and due(previous[0] + previous[1]):
        yield previous[2]
        tick += 1


def _upright(frame: VideoFrame, coded: tuple[int, int], seen: tuple[int, int]) -> np.ndarray:
    """Return a frame as rendered clips have them. Raises UnusableFootage."""
    import cv2

    if (frame.width, frame.height) != coded:
        raise UnusableFootage("changes its size in the middle; convert it to one size")
    if min(seen) < LEAST_PX:
        raise UnusableFootage(f"is {seen[0]} x {seen[1]} pixels; give a clip of {LEAST_PX} or more each way")
    if int(frame.color_trc) in _HDR:
        raise UnusableFootage(f"is HDR ({_HDR[int(frame.color_trc)]}); convert it to SDR (BT.709) first")
    has_alpha = any(component.is_alpha for component in frame.format.components)
    if has_alpha and frame.reformat(format="rgba").to_ndarray()[..., 3].min() < 255:
        raise UnusableFootage("is transparent in places; put it on a background first")
    space = int(frame.colorspace)
    if space == _UNSPECIFIED:  # as players take it
        space = _BT709 if frame.height >= 720 else _BT601
    is_yuv = not frame.format.is_rgb and frame.format.name != "pal8"
    picture = frame.reformat(format="rgb24", src_colorspace=space if is_yuv else None).to_ndarray()
    picture = np.rot90(picture, frame.rotation // 90 % 4)
    scale = min(1.0, math.sqrt(AREA / (seen[0] * seen[1])))
    size = tuple(max(2, 2 * round(side * scale / 2)) for side in seen)
    return np.ascontiguousarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA))


def _is_still(frames: list[np.ndarray]) -> bool:
    import cv2

    height, width = frames[0].shape[:2]
    coarse = [cv2.resize(f, (width // 8, height // 8), interpolation=cv2.INTER_AREA).astype(np.int16) for f in frames]
    return all(np.abs(frame - coarse[0]).max() <= STILL_LEVELS for frame in coarse[1:])
