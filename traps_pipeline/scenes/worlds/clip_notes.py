"""Read and write clips, each with the note beside it that vouches for it."""

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from traps_pipeline.base.digests import digest, file_digest
from traps_pipeline.base.files import write_text
from traps_pipeline.video.encode import DamagedClip, encode, frames_digest


@dataclass(frozen=True)
class Clip:
    """A clip's note: digest, size and length. leaked_pixels: visible pixels of hidden things; None without occluder."""

    file_sha256: str
    frames_sha256: str
    n_frames: int
    fps: int
    size_bytes: int
    leaked_pixels: float | None = None

    @property
    def duration_s(self) -> float:
        """The clip's duration in seconds."""
        return self.n_frames / self.fps


_SEAL = "seal"  # of a note: the digest of what else it says


def _seal_of(clip: Clip) -> str:
    return digest(asdict(clip))[:16]


def clip_note_path(clip: Path) -> Path:
    """Return the path of a clip's note (JSON), which is written last and vouches for the clip."""
    return clip.with_suffix(".json")


def read_clip(path: Path) -> Clip | None:
    """Return a rendered clip, None if missing. Raises DamagedClip if it was altered."""
    clip = read_note(path) if path.is_file() else None
    if clip is not None:
        check_clip(path, clip.file_sha256, clip.size_bytes)
    return clip


def read_note(path: Path) -> Clip | None:
    """Return the content of a clip's note, None if there is none. Raises DamagedClip."""
    if not (note_path := clip_note_path(path)).is_file():
        return None
    try:
        note = json.loads(note_path.read_text(encoding="utf-8"))
        seal = note.pop(_SEAL, None)  # notes of version 0.1.0 have none
        clip = Clip(**note)
        if seal not in (None, _seal_of(clip)):
            raise ValueError("it was altered")
    except (ValueError, TypeError, AttributeError) as error:
        raise DamagedClip(f"{note_path}: is not what was written ({error}); delete it and run again") from error
    return clip


def check_clip(path: Path, sha256: str, size_bytes: int) -> None:
    """Raise DamagedClip, with the remedy, unless a file has that size and digest."""
    size = path.stat().st_size if path.is_file() else 0
    if size != size_bytes or file_digest(path) != sha256:
        raise DamagedClip(
            f"{path}: is not the clip that was rendered ({size} of {size_bytes} bytes; truncated or altered); "
            "delete it and run again: it is rendered anew"
        )


def save_clip(path: Path, frames: Sequence[np.ndarray], fps: int, leaked_pixels: float | None = None) -> int:
    """Encode frames, write the note that vouches for them, and return their number."""
    encode(frames, path, fps)
    clip = Clip(file_digest(path), frames_digest(frames), len(frames), fps, path.stat().st_size, leaked_pixels)
    write_text(clip_note_path(path), json.dumps(asdict(clip) | {_SEAL: _seal_of(clip)}))
    return len(frames)
