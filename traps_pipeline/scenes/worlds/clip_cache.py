"""Clips that this machine has rendered, by content: another study with the same scene copies them.

An entry is a clip with its note, under a digest of all that decides its bytes. Entries are copied, so that a study
never changes with the cache; the one that was used longest ago goes first.
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
from traps_pipeline.scenes.picture.render import RenderingUnavailable, drawn_by
from traps_pipeline.scenes.worlds.clips import note_of, read_clip, read_note
from traps_pipeline.video.encode import DamagedClip

VARIABLE = "TRAPS_CLIP_CACHE"  # at most so many GB, or "off"
DEFAULT_GB = 4.0


@dataclass(frozen=True)
class ClipCache:
    """Rendered clips in a folder of at most `most_bytes` bytes. Threads and processes may share it.

    What cannot be read or written there is as if it were not there: a study is made without it.
    """

    folder: Path
    most_bytes: float

    @classmethod
    def of_user(cls) -> ClipCache | None:
        """Return the cache that the environment chooses; None where it is off, or there is no folder for this user.

        Raises TrapsError for a wrong size.
        """
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
        """Copy a clip and its note to where a study has it; return whether it was there. A damaged entry is removed."""
        entry = self._entry(clip, scene_hash)
        if entry is None:
            return False
        try:
            if not entry.is_file():
                return False
            note = read_note(entry)
            content, beside = entry.read_bytes(), note_of(entry).read_bytes()
            if note is None or sha256(content).hexdigest() != note.file_sha256:
                raise DamagedClip(f"{entry}: is not what was rendered")
            os.utime(entry)  # used last
        except (DamagedClip, OSError):
            _remove(entry)
            return False
        write_bytes(clip, content)
        write_bytes(note_of(clip), beside)
        return True

    def keep(self, clips: Iterable[Path], scene_hash: str) -> None:
        """Copy clips of a study, with their notes, into the cache."""
        for clip in clips:
            entry = self._entry(clip, scene_hash)
            if entry is None:
                return
            try:
                if not entry.is_file() and read_clip(clip) is not None:
                    write_bytes(note_of(entry), note_of(clip).read_bytes())
                    write_bytes(entry, clip.read_bytes())  # last: it is what `bring` looks for
            except (DamagedClip, TrapsError, OSError):
                _remove(entry)

    def trim(self) -> None:
        """Remove the entries that were used longest ago until the rest takes nine tenths of what is allowed."""
        entries = self._entries()
        size = sum(each for _, each, _ in entries)
        if size <= self.most_bytes:
            return
        for _, each, entry in sorted(entries):
            _remove(entry)
            size -= each
            if size <= 0.9 * self.most_bytes:
                break

    def describe(self) -> str:
        """Return folder, number of clips, size and bound in a line."""
        sizes = [size for _, size, _ in self._entries()]
        return f"{self.folder}: {len(sizes):,} clips, {sum(sizes) / 1e9:.2f} of {self.most_bytes / 1e9:g} GB"

    def _entry(self, clip: Path, scene_hash: str) -> Path | None:
        """Return the place of a clip; None where nothing can be drawn, so that nobody knows what would draw it."""
        try:
            key = digest([scene_hash, clip.name, _renderer()])
        except RenderingUnavailable:
            return None
        return self.folder / key[:2] / f"{key}.mp4"

    def _entries(self) -> list[tuple[float, int, Path]]:
        """Return of each clip when it was used last, its bytes with its note, and its path."""
        entries = []
        for path in self.folder.glob("??/*.mp4"):
            try:
                status = path.stat()
                entries.append((status.st_mtime, status.st_size + note_of(path).stat().st_size, path))
            except OSError:  # another process removes it
                continue
        return entries


def _remove(entry: Path) -> None:
    for path in (entry, note_of(entry)):
        try:
            path.unlink(missing_ok=True)
        except OSError:
            return


@cache
def _renderer() -> str:
    """Return a digest of what turns a scene into bytes: code of `scenes` and `video`, OpenGL, MuJoCo, OpenCV, encoder.

    Raises RenderingUnavailable.
    """
    import av
    import cv2
    import mujoco

    files = sorted(path for room in ("scenes", "video") for path in (PACKAGE / room).rglob("*.py"))
    code = {path.relative_to(PACKAGE).as_posix(): file_digest(path) for path in files}
    versions = (mujoco.__version__, cv2.__version__, av.__version__, sorted(av.library_versions.items()))
    return digest([code, drawn_by(), versions])
