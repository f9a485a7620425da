"""Prepare a clip for a model: pick frames by time, encode a video or images.

The same decoded frames go to every backend. They are encoded once per clip and profile and shared over regimes and
runs; the digest of the encoded bytes is part of the ledger key.
"""

from __future__ import annotations

import base64
import fcntl
import hashlib
import json
import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, model_validator

from traps_pipeline.base.archives import BadArchive, unzip_bytes, zip_bytes
from traps_pipeline.base.bounded_cache import BoundedCache
from traps_pipeline.base.digests import digest, file_digest
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.base.files import remedy, write_bytes
from traps_pipeline.storage.lines import NOT_WHOLE, line_with_checksum, read_checked
from traps_pipeline.storage.store import FolderStore, Store
from traps_pipeline.video.encode import ENCODER, DamagedClip, decode, encode
from traps_pipeline.video.policies import FramePolicy

Profile = Literal["video", "images", "frames"]
MAX_FRAMES = 25  # frames an API model sees, docs/spec.md 3.1
JPEG_QUALITY = 92
CACHE_BYTES = 256 * 2**20
_REVISION = 1  # raise it when picking, resizing or the container changes, so that all media are prepared anew
_SUFFIX: dict[Profile, str] = {"video": ".mp4", "images": ".zip"}
_MIME: dict[Profile, str] = {"video": "video/mp4", "images": "image/jpeg"}


class MediaSpec(BaseModel):
    """How a model is shown a clip: `media` of an entry of `assets/models.yaml`.

    profile: an mp4, separate JPEGs, or raw frames for a local model. Frames are a grid of fps a second, at most `most`,
    or `uniform` evenly spaced ones. size: (width, height) in pixels to resize to. fit: a clip of another shape is
    stretched to that size, or keeps its shape and is cropped on both sides. later: shift the picked frames by this many
    frames of the clip.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)
    profile: Profile
    fps: float | None = Field(default=None, gt=0, allow_inf_nan=False)
    most: int = Field(default=MAX_FRAMES, ge=1)
    uniform: int | None = Field(default=None, ge=1)
    size: tuple[int, int] | None = None
    fit: Literal["stretch", "crop"] = "stretch"
    later: int = Field(default=0, ge=0)

    def content(self) -> dict[str, Any]:
        """Return the fields for a digest; fields added later count only if set."""
        default_fields = {
            name for name in ("fit", "later") if getattr(self, name) == type(self).model_fields[name].default
        }
        return self.model_dump(mode="json", exclude=default_fields)

    @model_validator(mode="after")
    def _one_frame_policy(self) -> MediaSpec:
        if (self.fps is None) == (self.uniform is None):
            raise ValueError(f"give fps or uniform, {'one of them' if self.fps is None else 'not both'}")
        if self.uniform is not None and self.most != MAX_FRAMES:
            raise ValueError("most goes with fps; uniform says itself how many frames there are")
        if self.size is not None and min(self.size) < 1:
            raise ValueError(f"size is {self.size}; it is a width and a height in pixels")
        if self.size is None and self.fit != "stretch":
            raise ValueError(f"fit is {self.fit}; it goes with size")
        if self.profile == "video":
            self._check_video()
        return self

    def _check_video(self) -> None:
        if self.fps is None or self.fps != int(self.fps):
            raise ValueError("profile video needs fps, a whole number: the frames a second at which it plays")
        if self.size is not None and (self.size[0] % 2 or self.size[1] % 2):
            raise ValueError(f"size is {self.size}; H.264 needs an even width and height")


@dataclass(frozen=True, eq=False)
class Frames:
    """Frames (N, H, W, 3) uint8 RGB of a clip, and their times_s (N,) in seconds.

    clip_fps: frames a second of the whole clip; None if it has one frame.
    """

    frames: np.ndarray
    times_s: np.ndarray
    clip_fps: float | None


@dataclass(frozen=True)
class Media:
    """A clip as it is sent.

    path: the mp4, or the zip of JPEGs; None for profile frames, which `pick_frames` returns. sha256: digest of the sent
    content (the mp4; the JPEGs one after another; pixels and times), wherever the clip lies. times_s: seconds into the
    clip. fps: playing speed of a video; None for other profiles. size_bytes: size of the file, or of the pixels.
    """

    profile: Profile
    path: Path | None
    sha256: str
    n_frames: int
    times_s: tuple[float, ...]
    fps: float | None
    size_bytes: int


# --- frames -----------------------------------------------------------------------------------------------------------


def pick(times: np.ndarray, spec: MediaSpec) -> np.ndarray:
    """Return indices of the frames shown to a model; times: (F,) of the clip, in s."""
    return FramePolicy(spec.fps, spec.uniform, spec.most, spec.later).pick(times)


def pick_frames(clip: Path, spec: MediaSpec) -> Frames:
    """Return the frames of a clip that a model is sent; may raise DamagedClip.

    Those of profile frames are cached until the file changes, and shared by callers, who must not change them; the
    files of other profiles are prepared once.
    """
    if spec.profile != "frames":
        return _sample(clip, spec)
    try:
        file = clip.stat()
    except OSError as error:
        raise DamagedClip(f"{clip}: cannot be read ({error.strerror}); materialize videos again") from error
    return _SAMPLED.get((clip, file.st_mtime_ns, file.st_size, spec), lambda: _sample(clip, spec))


def _sample(clip: Path, spec: MediaSpec) -> Frames:
    frames, times = decode(clip, partial(pick, spec=spec))
    clip_fps = round((len(times) - 1) / float(times[-1] - times[0]), 3) if len(times) > 1 else None
    return Frames(resize(frames, spec.size, spec.fit), times[pick(times, spec)], clip_fps)


def resize(frames: np.ndarray, size: tuple[int, int] | None, fit: Literal["stretch", "crop"] = "stretch") -> np.ndarray:
    """Return frames (N, H, W, 3) uint8 at another size, unchanged if it is None.

    With fit `crop` they keep their shape: they are resized until they cover the size, and their middle is kept.
    """
    import cv2

    if size is None or size == (frames.shape[2], frames.shape[1]):
        return frames
    if fit == "crop":
        height, width = frames.shape[1:3]
        scale = max(size[0] / width, size[1] / height)
        covering = max(size[0], round(width * scale)), max(size[1], round(height * scale))
        left, top = (covering[0] - size[0]) // 2, (covering[1] - size[1]) // 2
        return np.ascontiguousarray(resize(frames, covering)[:, top : top + size[1], left : left + size[0]])
    # Bit-exact, since the pixels are in the ledger key: other filters may differ between CPUs.
    return np.stack([cv2.resize(frame, size, interpolation=cv2.INTER_LINEAR_EXACT) for frame in frames])


# --- what is sent -----------------------------------------------------------------------------------------------------


class MediaStore:
    """Prepared media under one folder, by clip and profile; safe for concurrent use."""

    def __init__(self, folder: Path, store: Store | None = None) -> None:
        self.folder, self._store = folder, store or FolderStore(folder)
        self._sound: dict[Path, Media] = {}  # by note: media that this process has prepared or checked byte by byte

    def prepare(self, clip: Path, clip_digest: str, spec: MediaSpec) -> Media:
        """Return a clip's media, prepared once or rebuilt; blocks, so call it in a thread.

        clip_digest: SHA-256 of the clip's file. Raises DamagedClip if the clip has another digest or is unreadable,
        TrapsError if nothing can be written, or if a video cannot play at the clip's own frame rate.
        """
        note = self._note(clip_digest, spec)
        if note not in self._sound:
            with _lock_folder(note.parent):
                self._bring(note, spec)
                media = self._local_path(clip_digest, spec)
                if media is None or not _is_complete(media):
                    media = _make(clip, clip_digest, spec, note)
                self._store.keep([note] if media.path is None else [media.path, note])
                self._sound[note] = media
        return self._sound[note]

    def known(self, clip_digest: str, spec: MediaSpec) -> Media | None:
        """Return a clip's prepared media, else None; checks only note and size."""
        note = self._note(clip_digest, spec)
        if note in self._sound:
            return self._sound[note]
        self._bring(note, spec)
        return self._local_path(clip_digest, spec)

    def _bring(self, note: Path, spec: MediaSpec) -> None:
        path = _file(note, spec.profile)
        self._store.bring([note] if path is None else [note, path])

    def _local_path(self, clip_digest: str, spec: MediaSpec) -> Media | None:
        try:
            media = read_note(self._note(clip_digest, spec))
            return media if media.path is None or media.path.stat().st_size == media.size_bytes else None
        except (OSError, ValueError):
            return None

    def _note(self, clip_digest: str, spec: MediaSpec) -> Path:
        """Return the path of the JSON note about the media, which is written last."""
        return self.folder / clip_digest[:2] / f"{clip_digest}-{profile_digest(spec)[:16]}.json"


def read_note(note: Path) -> Media:
    """Return the media that a note describes, or raise ValueError or OSError."""
    (line, *other_lines) = [*read_checked(note)] or [None]
    if line is None or other_lines or not line.whole:
        raise ValueError(f"{note}: {NOT_WHOLE}; delete it and run again: it is prepared anew")
    record: dict[str, Any] = json.loads(line.content)
    record.pop("sum")
    return Media(**record | {"path": _file(note, record["profile"]), "times_s": tuple(record["times_s"])})


def profile_digest(spec: MediaSpec) -> str:
    """Return the digest of everything that decides a profile's bytes, except the clip."""
    content: dict[str, Any] = {"revision": _REVISION, "spec": spec.content()}
    if spec.profile == "video":
        content["encoder"] = ENCODER
    if spec.profile == "images":
        content["jpeg_quality"] = JPEG_QUALITY
    return digest(content)


def payload(media: Media) -> list[bytes]:
    """Return the bytes of the mp4, or of each JPEG in order.

    Raises DamagedClip if the file has changed, TrapsError for profile frames.
    """
    if media.path is None:
        raise TrapsError("media.profile frames is not sent as bytes; use video or images for a model behind an API")
    try:
        data = media.path.read_bytes()
        parts = [*unzip_bytes(data).values()] if media.profile == "images" else [data]
    except OSError as error:
        raise _damaged_clip(media.path, error.strerror or str(error)) from error
    except BadArchive as error:
        raise _damaged_clip(media.path, str(error)) from error
    if len(data) != media.size_bytes or _sha256(parts) != media.sha256:
        raise _damaged_clip(media.path, f"{len(data)} of {media.size_bytes} bytes; truncated or altered")
    return parts


def _damaged_clip(path: Path, why: str) -> DamagedClip:
    return DamagedClip(f"{path}: is not what was prepared ({why}); delete it and run again: it is prepared anew")


def _is_complete(media: Media) -> bool:
    try:
        return media.path is None or bool(payload(media))
    except DamagedClip:
        return False


def _file(note: Path, profile: Profile) -> Path | None:
    return note.with_suffix(_SUFFIX[profile]) if profile in _SUFFIX else None


def _make(clip: Path, clip_digest: str, spec: MediaSpec, note: Path) -> Media:
    """Pick and encode frames, write the file, and last the note with its digest."""
    _require(clip, clip_digest)
    frames = pick_frames(clip, spec)
    path, rate = _file(note, spec.profile), None
    if path is None:
        header = str((frames.frames.shape, frames.times_s.tolist())).encode()
        sha256, size = _sha256([header, frames.frames.tobytes()]), frames.frames.nbytes
    elif spec.profile == "video":
        rate = _rate(clip, frames, spec)
        encode(list(frames.frames), path, rate)
        sha256, size = file_digest(path), path.stat().st_size
    else:
        jpegs = [_jpeg(frame) for frame in frames.frames]
        data = zip_bytes({f"{i:02d}.jpg": jpeg for i, jpeg in enumerate(jpegs)})
        write_bytes(path, data)
        sha256, size = _sha256(jpegs), len(data)
    times = tuple(frames.times_s.tolist())
    media = Media(spec.profile, path, sha256, len(times), times, rate, size)
    write_bytes(note, line_with_checksum({name: value for name, value in asdict(media).items() if name != "path"}))
    return media


def _require(clip: Path, clip_digest: str) -> None:
    """Raise DamagedClip unless the clip has the digest that its media will carry."""
    try:
        digest = file_digest(clip)
    except OSError as error:
        raise DamagedClip(f"{clip}: cannot be read ({error.strerror}); materialize videos again") from error
    if digest != clip_digest:
        raise DamagedClip(
            f"{clip}: is not the clip that was rendered (digest {digest[:16]}, not {clip_digest[:16]}); "
            "delete the file and materialize videos again"
        )


def _rate(clip: Path, sampled: Frames, spec: MediaSpec) -> int:
    """Return the playing speed of picked frames: fps, or that of a slower clip."""
    rate = min(spec.fps or 1, sampled.clip_fps or np.inf)
    if rate != int(rate):
        raise TrapsError(
            f"{clip}: has {rate:g} frames a second; a video can be sent at a whole number only: use profile images"
        )
    return int(rate)


def _sha256(parts: Sequence[bytes]) -> str:
    hasher = hashlib.sha256()
    for part in parts:
        hasher.update(part)
    return hasher.hexdigest()


def _jpeg(frame: np.ndarray) -> bytes:
    import cv2

    return cv2.imencode(".jpg", frame[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])[1].tobytes()


@contextmanager
def _lock_folder(folder: Path) -> Iterator[None]:
    """Hold a folder's lock, freed when its holder dies. Raises TrapsError."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        descriptor = os.open(folder / ".lock", os.O_RDWR | os.O_CREAT, 0o644)
    except OSError as error:
        raise TrapsError(f"{folder}: cannot be written ({error.strerror}); {remedy(error)} and run again") from error
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX)
        yield
    finally:
        os.close(descriptor)


# --- as text ----------------------------------------------------------------------------------------------------------


def _data_uri(profile: Profile, data: bytes) -> str:
    return f"data:{_MIME[profile]};base64,{base64.b64encode(data).decode('ascii')}"


def data_uris(media: Media) -> tuple[str, ...]:
    """Return `payload` as data URIs, cached for this process; may raise its errors."""
    make = lambda: tuple(_data_uri(media.profile, part) for part in payload(media))  # noqa: E731
    return _URIS.get((media.profile, media.sha256), make)


_URIS = BoundedCache[tuple[Profile, str], tuple[str, ...]](CACHE_BYTES, lambda uris: sum(map(len, uris)))
_SAMPLED = BoundedCache[tuple[Path, int, int, MediaSpec], Frames](CACHE_BYTES, lambda frames: frames.frames.nbytes)
