"""Encode frames as H.264 clips (always the same bytes) and decode them, with PyAV."""

import hashlib
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import numpy as np

from traps_pipeline.base.errors import TrapsError
from traps_pipeline.base.files import replace_file
from traps_pipeline.video.policies import SAMPLED, FramePolicy

# veryfast: 3 % larger than medium at the same quality, in half the time. mbtree is off since it is not deterministic in
# this x264: in one of about 20 runs the same frames gave other bytes.
# The stream states its colours, BT.601 of limited range, by which RGB is converted: where none are stated, players take
# BT.709 from 720 lines on, and what a person sees differs from what a model is shown by up to 40 of 255 levels.
ENCODER = {
    **{"crf": "16", "g": "10", "preset": "veryfast", "threads": "1", "x264-params": "mbtree=0"},
    **dict.fromkeys(("colorspace", "color_primaries", "color_trc"), "smpte170m"),
    "color_range": "tv",
}


class DamagedClip(ValueError):
    """A clip that cannot be read in full; the message names the file and the remedy."""


def frames_digest(frames: Sequence[np.ndarray]) -> str:
    """Return SHA-256 over the raw RGB frames before encoding."""
    digest = hashlib.sha256()
    for frame in frames:
        digest.update(np.ascontiguousarray(frame).tobytes())
    return digest.hexdigest()


def encode(frames: Sequence[np.ndarray], path: Path, fps: int) -> None:
    """Write RGB frames (F, H, W, 3) as a whole mp4 (H.264, yuv420p, faststart).

    Raises TrapsError when it cannot be written (a full disk); a former file then still stands. Raises TrapsError, too,
    for a width or height that is odd, before anything is written.
    """
    height, width = frames[0].shape[:2]
    if height % 2 or width % 2:
        raise TrapsError(
            f"{path.name}: the frames are {width} x {height} pixels, and H.264 needs an even width and an even height; "
            f"draw them at {width + width % 2} x {height + height % 2}"
        )
    import av
    from av.error import FFmpegError

    with replace_file(path) as part:
        try:
            with av.open(str(part), "w", format="mp4", options={"movflags": "+faststart"}) as container:
                stream = container.add_stream("libx264", rate=fps, options=ENCODER)
                stream.height, stream.width = height, width
                stream.pix_fmt = "yuv420p"
                stream.codec_context.thread_count = 1
                for frame in frames:
                    container.mux(stream.encode(av.VideoFrame.from_ndarray(frame, format="rgb24")))
                container.mux(stream.encode(None))
        except FFmpegError as error:
            raise OSError(error.errno, error.strerror) from error


def decode(path: Path, pick: Callable[[np.ndarray], np.ndarray] | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Return frames (N, H, W, 3) uint8 RGB and the times (F,) s of all frames.

    pick: maps these times to the indices of the frames to return; all by default. Raises DamagedClip.
    """
    import av
    from av.error import FFmpegError
    from av.video.reformatter import VideoReformatter

    try:
        with av.open(str(path)) as container:
            n_declared = container.streams.video[0].frames
            frames = [*container.decode(video=0)]
    except (FFmpegError, OSError, IndexError) as error:  # IndexError: no video stream
        raise DamagedClip(
            f"{path}: cannot be decoded ({error}); delete the file and materialize videos again"
        ) from error
    if not frames or len(frames) != n_declared:
        raise DamagedClip(
            f"{path}: holds {len(frames)} of {n_declared} frames; delete the file and materialize videos again"
        )
    times = np.array([float(frame.time or 0.0) for frame in frames])
    to_rgb = partial(VideoReformatter().reformat, format="rgb24")  # one for all frames: making it takes as long as one
    chosen = range(len(frames)) if pick is None else pick(times)
    return np.stack([to_rgb(frames[index]).to_ndarray() for index in chosen]), times


def count_frames(path: Path) -> int:
    """Return a clip's declared frame count without decoding. Raises DamagedClip."""
    import av
    from av.error import FFmpegError

    try:
        with av.open(str(path)) as container:
            return container.streams.video[0].frames
    except (FFmpegError, OSError, IndexError) as error:
        raise DamagedClip(
            f"{path}: cannot be decoded ({error}); delete the file and materialize videos again"
        ) from error


def decode_first(path: Path) -> np.ndarray:
    """Return the first frame (H, W, 3) uint8 RGB. Raises DamagedClip."""
    import av
    from av.error import FFmpegError

    try:
        with av.open(str(path)) as container:
            return next(container.decode(video=0)).to_ndarray(format="rgb24")
    except (FFmpegError, OSError, IndexError, StopIteration) as error:
        raise DamagedClip(
            f"{path}: cannot be decoded ({error}); delete the file and materialize videos again"
        ) from error


def decode_sampled(path: Path, policy: FramePolicy = SAMPLED) -> np.ndarray:
    """Return the frames (N, H, W, 3) uint8 RGB that a policy shows.

    By default 5 a second and at most 25 (docs/spec.md 3.1). Raises DamagedClip.
    """
    return decode(path, policy.pick)[0]
