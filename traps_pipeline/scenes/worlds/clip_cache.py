"""Cache rendered clips by content, shared by this machine's studies.

An entry is a clip with its note, under a digest of all that decides its bytes. Entries are copied, so that a study
never changes with the cache; the least recently used one goes first.
"""

from __future__ import annotations

import os
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cache
from hashlib import sha256
from pathlib import Path

from traps_pipeline.base.digests import digest, file_digest
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.base.files import write_bytes
from traps_pipeline.base.paths import PACKAGE, user_cache
from traps_pipeline.scenes.family_registry import added_digests
from traps_pipeline.scenes.picture.render import RenderingUnavailable, renderer_version
from traps_pipeline.scenes.worlds.clip_notes import clip_note_path, read_clip, read_note
from traps_pipeline.video.encode import DamagedClip

VARIABLE = "TRAPS_CLIP_CACHE"  # at most so many GB, or "off"
DEFAULT_GB = 4.0


@dataclass(frozen=True)
class ClipCache:
    """Rendered clips in a folder of at most `most_bytes` bytes.

    Threads and processes may share it. A study goes on without an entry that cannot be read or written.
    """

    folder: Path
    most_bytes: float

    @classmethod
    def of_user(cls) -> ClipCache | None:
        """Return the cache that the environment chooses, or None. Raises TrapsError for a wrong size."""
        size = os.environ.get(VARIABLE, "").strip() or str(DEFAULT_GB)
        if size == "off":
            return None
        try:
            gigabytes = float(size)
        except ValueError:
            gigabytes = -1.0
        if not 0 < gigabytes < float("inf"):
            raise TrapsError(f"{VARIABLE}={size}: is no size; give the GB that rendered clips may take, or off")
        try:
            return cls(user_cache() / "clips", gigabytes * 1e9)
        except RuntimeError:  # no home folder, as in a container with any user
            return None

    def bring(self, clip: Path, scene_hash: str) -> bool:
        """Copy a clip with its note to a study, if it is cached; return whether it is."""
        entry = self._entry(clip, scene_hash)
        if entry is None:
            return False
        try:
            if not entry.is_file():
                return False
            note = read_note(entry)
            content, note_content = entry.read_bytes(), clip_note_path(entry).read_bytes()
            if note is None or sha256(content).hexdigest() != note.file_sha256:
                raise DamagedClip(f"{entry}: is not what was rendered")
            os.utime(entry)  # used last
        except (DamagedClip, OSError):
            _remove(entry)
            return False
        write_bytes(clip, content)
        write_bytes(clip_note_path(clip), note_content)
        return True

    def keep(self, clips: Iterable[Path], scene_hash: str) -> None:
        """Copy a study's clips with their notes into the cache."""
        for clip in clips:
            entry = self._entry(clip, scene_hash)
            if entry is None:
                return
            try:
                if not entry.is_file() and read_clip(clip) is not None:
                    write_bytes(clip_note_path(entry), clip_note_path(clip).read_bytes())
                    write_bytes(entry, clip.read_bytes())  # last: it is what `bring` looks for
            except (DamagedClip, TrapsError, OSError):
                _remove(entry)

    def trim(self) -> None:
        """Remove least recently used entries until nine tenths of the bound are left."""
        entries = self._entries()
        size = sum(n_bytes for _, n_bytes, _ in entries)
        if size <= self.most_bytes:
            return
        for _, n_bytes, entry in sorted(entries):
            _remove(entry)
            size -= n_bytes
            if size <= 0.9 * self.most_bytes:
                break

    def describe(self) -> str:
        """Return folder, number of clips, size and bound in a line."""
        sizes = [size for _, size, _ in self._entries()]
        return f"{self.folder}: {len(sizes):,} clips, {sum(sizes) / 1e9:.2f} of {self.most_bytes / 1e9:g} GB"

    def _entry(self, clip: Path, scene_hash: str) -> Path | None:
        """Return the cached path of a clip; None where nothing can be drawn."""
        try:
            key = digest([scene_hash, clip.name, _renderer_digest()])
        except RenderingUnavailable:
            return None
        return self.folder / key[:2] / f"{key}.mp4"

    def _entries(self) -> list[tuple[float, int, Path]]:
        """Return time of last use, bytes with its note, and path of each clip."""
        entries = []
        for path in self.folder.glob("??/*.mp4"):
            try:
                status = path.stat()
                entries.append((status.st_mtime, status.st_size + clip_note_path(path).stat().st_size, path))
            except OSError:  # another process removes it
                continue
        return entries


def _remove(entry: Path) -> None:
    for path in (entry, clip_note_path(entry)):
        try:
            path.unlink(missing_ok=True)
        except OSError:
            return


@cache
def _renderer_digest() -> str:
    """Return a digest of all code and versions that turn a scene into bytes. Raises RenderingUnavailable."""
    import av
    import cv2
    import mujoco

    files = sorted(path for room in ("scenes", "video") for path in (PACKAGE / room).rglob("*.py"))
    code = {path.relative_to(PACKAGE).as_posix(): file_digest(path) for path in files}
    versions = (mujoco.__version__, cv2.__version__, av.__version__, sorted(av.library_versions.items()))
    return digest([code, added_digests(), renderer_version(), versions])
