"""Where a study's files lie: one interface with two implementations, which what reads and writes files does not tell
apart (`Workspace.is_shared` does, for what several hosts cannot share).

In a folder of one machine (`FolderStore`), or in an object store that several hosts share. Code
names a file by its path below the workspace's folder on this machine, makes it there, and hands it over with `keep`;
before it reads files that another host may have made, it asks for them with `bring`. In a folder both do nothing.
"""

from __future__ import annotations

import os
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

from traps_pipeline.base.digests import file_digest
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.base.files import remedy, try_lock, write_bytes

GRACE_DAYS = 7.0  # an object that nobody names is younger while it is written
LEASES = ".leases"  # in a study's folder: the files of pieces of work that are under way


@dataclass(frozen=True)
class Lease:
    """The right to a piece of work, which no other process has until `close` or the end of this process."""

    close: Callable[[], None]


@dataclass(frozen=True)
class UnusedObject:
    """An object in a study's store that nobody names. size: in bytes; at: when it was written, by the store's clock."""

    name: str
    size: int
    at: datetime


class Store(ABC):
    """The files of one study. root: the folder on this machine below which every path lies."""

    def __init__(self, root: Path) -> None:
        self.root = root

    @abstractmethod
    def here(self, path: Path) -> Path:
        """Return a file on this machine that holds what is current under that path; nobody changes it while it is read.

        Raises FileNotFoundError where there is none, TrapsError where it is not what was written or cannot be had.
        """

    @abstractmethod
    def bring(self, paths: Iterable[Path]) -> None:
        """See to it that these files lie at their paths on this machine, as far as they exist. Raises TrapsError."""

    @abstractmethod
    def keep(self, paths: Iterable[Path]) -> None:
        """Make what lies at these paths on this machine current for every host: all of them or none. Raises TrapsError
        and OSError."""

    @abstractmethod
    def write(self, files: Mapping[Path, bytes], *, note: str | None = None, durable: bool = False) -> None:
        """Make these contents current: all of them or none, where several hosts see them. note: what `note` will say
        of them. durable: not even a power cut leaves a torn file. Raises TrapsError."""

    @abstractmethod
    def remove(self, paths: Iterable[Path]) -> None:
        """Let nothing be current under these paths."""

    @abstractmethod
    def has(self, path: Path) -> bool:
        """Return whether something is current under that path."""

    @abstractmethod
    def sizes(self, paths: Iterable[Path]) -> dict[Path, int]:
        """Return the sizes, in bytes, of those files that are really there."""

    @abstractmethod
    def there(self, paths: Iterable[Path]) -> set[Path]:
        """Return those of these paths under which something is current. No content is looked for."""

    @abstractmethod
    def digests(self, paths: Iterable[Path]) -> dict[Path, str]:
        """Return the SHA-256, in hex, of what is current under these paths, as far as something is. No content is
        fetched."""

    @abstractmethod
    def lease(self, name: str) -> Lease | None:
        """Take a piece of work of the study; None where another process, on whatever host, has it, or this one. It is
        free again when the lease is closed, and soon after its process or host is dead. A host that is cut off may lose
        it and not know, so what is made under a lease must be such that twice is as good as once. Raises TrapsError."""

    @abstractmethod
    def below(self, folder: Path, pattern: str = "**/*") -> list[Path]:
        """Return the files below a folder whose paths from there match a pattern, hidden ones left out, in order."""

    @abstractmethod
    def note(self, path: Path) -> str | None:
        """Return what was noted of a file when it was written; None where nothing was, and only the file itself
        tells.
        """

    @abstractmethod
    def changed_ns(self, path: Path) -> int:
        """Return when the file was written, in ns since 1970; 0 where there is none."""

    @abstractmethod
    def look(self) -> None:
        """See what other hosts have made until now. Without it, what is seen may be half a second old."""

    def unused(self, *, is_removed: bool = False, grace_days: float | None = None) -> list[UnusedObject]:
        """Return objects that nobody names, the oldest first, and remove them if asked to; a folder has none.

        grace_days: how old they are at least, GRACE_DAYS if None. Raises TrapsError where the store cannot be used, or
        is another study's.
        """
        return []


class FolderStore(Store):
    """Files in a folder of this machine."""

    def here(self, path: Path) -> Path:
        """See `Store`."""
        return path

    def bring(self, paths: Iterable[Path]) -> None:
        """See `Store`."""

    def keep(self, paths: Iterable[Path]) -> None:
        """See `Store`."""

    def write(self, files: Mapping[Path, bytes], *, note: str | None = None, durable: bool = False) -> None:
        """See `Store`."""
        for path, content in files.items():
            write_bytes(path, content, durable=durable)

    def remove(self, paths: Iterable[Path]) -> None:
        """See `Store`."""
        for path in paths:
            path.unlink(missing_ok=True)

    def has(self, path: Path) -> bool:
        """See `Store`."""
        return path.is_file()

    def sizes(self, paths: Iterable[Path]) -> dict[Path, int]:
        """See `Store`."""
        size_of: dict[Path, int] = {}
        for path in paths:
            try:
                size_of[path] = path.stat().st_size
            except OSError:
                continue
        return size_of

    def there(self, paths: Iterable[Path]) -> set[Path]:
        """See `Store`."""
        return {path for path in paths if path.is_file()}

    def digests(self, paths: Iterable[Path]) -> dict[Path, str]:
        """See `Store`."""
        return {path: file_digest(path) for path in self.there(paths)}

    def lease(self, name: str) -> Lease | None:
        """See `Store`. A lock on a file, which is there while it is held."""
        folder = self.root / LEASES
        path = folder / name.replace("/", "-")
        with writable(folder):
            held = try_lock(path)

        def close() -> None:
            assert held is not None, "only what is held is closed"
            path.unlink(missing_ok=True)  # first: who opened it meanwhile sees that it holds no lock any more
            os.close(held)
            with suppress(OSError):
                folder.rmdir()  # unless there are others

        return None if held is None else Lease(close)

    def below(self, folder: Path, pattern: str = "**/*") -> list[Path]:
        """See `Store`."""
        files = (path for path in folder.glob(pattern) if path.is_file())
        return sorted(path for path in files if not is_hidden(path.relative_to(folder)))

    def note(self, path: Path) -> str | None:
        """See `Store`."""
        return None

    def changed_ns(self, path: Path) -> int:
        """See `Store`."""
        return path.stat().st_mtime_ns if path.exists() else 0

    def look(self) -> None:
        """See `Store`."""


@contextmanager
def writable(folder: Path) -> Iterator[None]:
    """Raise TrapsError where nothing can be written in a folder."""
    try:
        yield
    except OSError as error:
        raise TrapsError(f"{folder}: cannot be written ({error.strerror or error}); {remedy(error)}") from error


def is_hidden(relative: Path) -> bool:
    """Return whether a file, or a folder on the way to it, has a name with a dot before it: locks, unfinished files."""
    return any(part.startswith(".") for part in relative.parts)
