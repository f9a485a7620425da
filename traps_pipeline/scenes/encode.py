"""Frames to H.264 clips and back, through PyAV. The same frames give the same bytes (one encoder thread)."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np

ENCODER = {"crf": "16", "g": "10", "preset": "medium", "threads": "1"}


class DamagedClip(ValueError):
    """A clip that cannot be read in full; the message names the file and the remedy."""


def frames_digest(frames: Sequence[np.ndarray]) -> str:
    """SHA-256 over the raw RGB frames before encoding."""
    digest = hashlib.sha256()
    for frame in frames:
        digest.update(np.ascontiguousarray(frame).tobytes())
    return digest.hexdigest()


def encode(frames: Sequence[np.ndarray], path: Path, fps: int) -> None:
    """Write RGB frames (F, H, W, 3) as an mp4 (H.264, yuv420p, faststart); the file appears whole or not at all."""
    import av

    part = path.with_suffix(f".{os.getpid()}.part")
    path.parent.mkdir(parents=True, exist_ok=True)
    try:
        with av.open(str(part), "w", format="mp4", options={"movflags": "+faststart"}) as container:
            stream = container.add_stream("libx264", rate=fps, options=ENCODER)
            stream.height, stream.width = frames[0].shape[:2]
            stream.pix_fmt = "yuv420p"
            stream.codec_context.thread_count = 1
            for frame in frames:
                container.mux(stream.encode(av.VideoFrame.from_ndarray(frame, format="rgb24")))
            container.mux(stream.encode(None))
        os.replace(part, path)
    finally:
        part.unlink(missing_ok=True)


def decode(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """All frames (F, H, W, 3) uint8 RGB and their times (F,) in seconds. Raises DamagedClip."""
    import av

    try:
        with av.open(str(path)) as container:
            pairs = [(f.to_ndarray(format="rgb24"), float(f.time or 0.0)) for f in container.decode(video=0)]
    except (av.FFmpegError, OSError) as error:
        raise DamagedClip(f"{path}: cannot be decoded ({error}); delete the file and materialize videos again") from error
    if not pairs:
        raise DamagedClip(f"{path}: holds no frame; delete the file and materialize videos again")
    return np.stack([p[0] for p in pairs]), np.array([p[1] for p in pairs])
