"""Define the interface to a study's files, in a folder or an object store.

Code names a file by its path below the workspace's folder on this machine, writes it there, and publishes it with
`keep`; before it reads files that another host may have written, it fetches them with `bring`. In a folder
(`FolderStore`) both do nothing. Only `Workspace.is_shared` tells the two apart, for what several hosts cannot share.
"""

import os
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from datetime import datetime
from fnmatch import fnmatchcase
from functools import partial
from pathlib import Path

from typing_extensions import override

from traps_pipeline.base.digests import file_digest
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.base.files import remedy, try_lock, write_bytes

GRACE_DAYS = 7.0  # an unreferenced younger object may still be being written
LEASES = ".leases"  # in a study's folder: lease files


@dataclass(frozen=True)
class Lease:
    """An exclusive right to a piece of work, until `close` or this process's end."""

    close: Callable[[], None]


@dataclass(frozen=True)
class UnusedObject:
    """An unreferenced object: size in bytes, and write time by the store's clock."""

    name: str
    size: int
    at: datetime


class Store(ABC):
    """Where a study's files lie: a folder, or a place in an object store.

    root: the local folder below which every path lies. leases: who keeps them; by default, locks on files below it.
    """

    def __init__(self, root: Path, leases: Callable[[str], Lease | None] | None = None) -> None:
        self.root, self._leases = root, leases or partial(_file_lease, root / LEASES)

    @abstractmethod
    def here(self, path: Path) -> Path:
        """Return a local file with a path's content, unchanged while it is read.

        Raises FileNotFoundError if there is none, TrapsError if it is damaged or cannot be fetched.
        """

    @abstractmethod
    def bring(self, paths: Iterable[Path]) -> None:
        """Fetch files of the study, if they exist, to their local paths. Raises TrapsError."""

    @abstractmethod
    def keep(self, paths: Iterable[Path]) -> None:
        """Publish local files to every host, all or none. Raises TrapsError, OSError."""

    @abstractmethod
    def write(self, files: Mapping[Path, bytes], *, note: str | None = None, durable: bool = False) -> None:
        """Write files of the study; where several hosts see them, all or none.

        note: returned by `note` later. durable: not even a power cut leaves a torn file. Raises TrapsError.
        """

    @abstractmethod
    def remove(self, paths: Iterable[Path]) -> None:
        """Remove files of the study, if they exist."""

    def has(self, path: Path) -> bool:
        """Return whether a path has a file."""
        return bool(self.there([path]))

    @abstractmethod
    def sizes(self, paths: Iterable[Path]) -> dict[Path, int]:
        """Return the sizes, in bytes, of those files that exist."""

    @abstractmethod
    def there(self, paths: Iterable[Path]) -> set[Path]:
        """Return which paths exist as files, without reading them."""

    @abstractmethod
    def digests(self, paths: Iterable[Path]) -> dict[Path, str]:
        """Return the hex SHA-256 of those files that exist, without fetching content."""

    def lease(self, name: str) -> Lease | None:
        """Take a lease on a piece of work; None if any process, also this one, holds it.

        It ends when it is closed, and soon after its process or host has died. A host that is cut off may lose it
        unknowingly, so work under a lease must be idempotent. Raises TrapsError.
        """
        return self._leases(name)

    @abstractmethod
    def below(self, folder: Path, pattern: str = "**/*") -> list[Path]:
        """Return a folder's files that match a relative pattern, sorted; none hidden."""

    @abstractmethod
    def note(self, path: Path) -> str | None:
        """Return the note written with a file; None if only the file itself can tell."""

    @abstractmethod
    def changed_ns(self, path: Path) -> int:
        """Return when a file was written, in ns since 1970; 0 if it does not exist."""

    @abstractmethod
    def look(self) -> None:
        """Refresh the view of other hosts' files, which may be half a second old."""

    def unused(self, *, is_removed: bool = False, grace_days: float | None = None) -> list[UnusedObject]:
        """Return unreferenced objects, the oldest first, and remove them if asked to.

        A folder has none. grace_days: their minimum age, GRACE_DAYS if None. Raises TrapsError if the store cannot be
        used, or is another study's.
        """
        return []


class FolderStore(Store):
    """Files in a folder of this machine, or in one that several hosts share.

    These need other leases than files: on some file systems, locks of files are local to a machine.
    """

    @override
    def here(self, path: Path) -> Path:
        return path

    @override
    def bring(self, paths: Iterable[Path]) -> None:
        pass

    @override
    def keep(self, paths: Iterable[Path]) -> None:
        pass

    @override
    def write(self, files: Mapping[Path, bytes], *, note: str | None = None, durable: bool = False) -> None:
        for path, content in files.items():
            write_bytes(path, content, durable=durable)

    @override
    def remove(self, paths: Iterable[Path]) -> None:
        for path in paths:
            path.unlink(missing_ok=True)

    @override
    def sizes(self, paths: Iterable[Path]) -> dict[Path, int]:
        size_of: dict[Path, int] = {}
        for path in paths:
            try:
                size_of[path] = path.stat().st_size
            except OSError:
                continue
        return size_of

    @override
    def there(self, paths: Iterable[Path]) -> set[Path]:
        return {path for path in paths if path.is_file()}

    @override
    def digests(self, paths: Iterable[Path]) -> dict[Path, str]:
        return {path: file_digest(path) for path in self.there(paths)}

    @override
    def below(self, folder: Path, pattern: str = "**/*") -> list[Path]:
        if "**" in pattern:
            files = (path for path in folder.glob(pattern) if path.is_file())
            return sorted(path for path in files if not is_hidden(path.relative_to(folder)))
        found = [(str(folder),)]
        for depth, part in enumerate(parts := pattern.split("/"), start=1):  # a run asks for thousands of patterns
            found = [(*above, name) for above in found for name in _names(above, part, is_file=depth == len(parts))]
        return [Path(*path) for path in sorted(found)]

    @override
    def note(self, path: Path) -> str | None:
        return None

    @override
    def changed_ns(self, path: Path) -> int:
        return path.stat().st_mtime_ns if path.exists() else 0

    @override
    def look(self) -> None:
        pass


def _file_lease(folder: Path, name: str) -> Lease | None:
    """Lock a file, which is removed at the lease's end."""
    path = folder / name.replace("/", "-")
    with require_writable(folder):
        descriptor = try_lock(path)

    def close() -> None:
        assert descriptor is not None, "only what is held is closed"
        path.unlink(missing_ok=True)  # first, so that a process that has opened it finds it gone
        os.close(descriptor)
        with suppress(OSError):
            folder.rmdir()  # unless there are others

    return None if descriptor is None else Lease(close)


def _names(folder: Sequence[str], pattern: str, *, is_file: bool) -> list[str]:
    """Return the names of a folder's files, or else of all that it holds, that match; none hidden."""
    path = "/".join(folder)
    if not any(sign in pattern for sign in "*?["):
        return [pattern] if not pattern.startswith(".") and (not is_file or Path(path, pattern).is_file()) else []
    try:
        with os.scandir(path) as entries:
            shown = [entry for entry in entries if not entry.name.startswith(".") and fnmatchcase(entry.name, pattern)]
            return [entry.name for entry in shown if not is_file or entry.is_file()]
    except (FileNotFoundError, NotADirectoryError, PermissionError):
        return []


@contextmanager
def require_writable(folder: Path) -> Iterator[None]:
    """Raise TrapsError if a folder is not writable."""
    try:
        yield
    except OSError as error:
        raise TrapsError(f"{folder}: cannot be written ({error.strerror or error}); {remedy(error)}") from error


def is_hidden(relative: Path) -> bool:
    """Return whether a name on the path begins with a dot (locks, unfinished files)."""
    return any(part.startswith(".") for part in relative.parts)
