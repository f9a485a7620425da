"""Write files atomically: a file is complete or absent."""

import errno
import fcntl
import os
import secrets
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from traps_pipeline.base.errors import TrapsError

PART = ".part"  # how the hidden names of unfinished files end
_REMEDIES = {
    errno.ENOSPC: "free some space",
    errno.EDQUOT: "free some space, or raise the quota",
    errno.EFBIG: "raise the limit of a file's size (`ulimit -f`)",
    errno.EROFS: "it lies on a disk that is mounted read-only: choose another folder, or mount it for writing",
    errno.EACCES: "make its folder writable for this user, or choose another folder",
    errno.EPERM: "make its folder writable for this user, or choose another folder",
    errno.ENAMETOOLONG: "choose a folder with a shorter path",
    errno.EMFILE: "let this shell open more files (`ulimit -n 4096`)",
    errno.ENFILE: "end programs that hold many files open",
    errno.ENOTDIR: "one of the folders of its path is a file: move that file away, or choose another folder",
    errno.EEXIST: "a file lies where its folder must be: move that away",
    errno.EISDIR: "a folder lies in its place: move that away",
    errno.ENOENT: "its folder is gone: make it again, or name the right one",
    errno.EIO: "the disk fails: look at it, or choose a folder on another one",
}


def remedy(error: OSError) -> str:
    """Return what a person can do about a file that cannot be read or written."""
    return _REMEDIES.get(error.errno or 0, "see to the file or its disk")


@contextmanager
def replace_file(path: Path, *, durable: bool = False, private: bool = False) -> Iterator[Path]:
    """Yield a temporary path beside `path`, which replaces `path` after the block.

    Until then, and after an error, Ctrl-C or a kill, `path` keeps its former content. An unfinished file is removed;
    only a kill leaves one, hidden and named `*.part`, which nothing reads. Missing folders are created.

    durable: sync the content to disk before it gets its name, so that a power cut leaves no torn file under that name.
    private: let the owner alone read it, from its first byte.
    Raises TrapsError that names `path` when it cannot be written; an OSError about another file, which the block reads,
    passes unchanged.
    """
    # Unique among all processes, threads and machines that share the folder.
    part = path.with_name(f".{path.name}.{secrets.token_hex(4)}{PART}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            if private:
                part.touch(0o600, exist_ok=False)
            yield part
            if durable:
                with part.open("rb") as stream:
                    os.fsync(stream.fileno())
            part.replace(path)
            if durable:
                sync_folder(path.parent)
        finally:
            part.unlink(missing_ok=True)
    except BrokenPipeError:
        raise  # the reader of the block's output has gone
    except OSError as error:
        if error.filename is not None and str(error.filename) not in map(str, (part, *path.parents)):
            raise
        raise TrapsError(
            f"{path}: cannot be written ({error.strerror or error}); {remedy(error)} and run the same command again "
            "(nothing was half-written, and what is finished is kept)"
        ) from error


def sync_folder(folder: Path) -> None:
    """Sync a folder's entries, so that a power cut does not lose new file names."""
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def is_in_place(descriptor: int, path: Path) -> bool:
    """Return whether an open file still has its name; else its lock excludes nobody."""
    try:
        current, open_file = path.stat(), os.fstat(descriptor)
    except FileNotFoundError:
        return False
    return (current.st_dev, current.st_ino) == (open_file.st_dev, open_file.st_ino)


def try_lock(path: Path) -> int | None:
    """Lock a file and return its descriptor; None if another process holds it.

    The lock lasts until the descriptor is closed or the process ends. Missing folders are created. Raises OSError.
    """
    while True:
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            descriptor = os.open(path, os.O_RDWR | os.O_CREAT, 0o644)
        except FileNotFoundError:
            if path.parent.is_dir():
                raise
            continue  # the process that released the lock has removed the folder
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            os.close(descriptor)
            if isinstance(error, BlockingIOError):
                return None
            raise
        if is_in_place(descriptor, path):
            return descriptor
        os.close(descriptor)  # removed meanwhile: the next one is another file


def require_in_place(descriptor: int, path: Path) -> None:
    """Raise TrapsError if a held lock's file was removed: others could lock anew."""
    if not is_in_place(descriptor, path):
        raise TrapsError(
            f"{path}: was removed while this run held it, so that another run may ask the same calls; nothing more is "
            "sent. Leave lock files alone (they hold nothing when no run goes on), and run the same command again"
        )


def write_bytes(path: Path, content: bytes, *, durable: bool = False, private: bool = False) -> None:
    """Write a file atomically, as `replace_file` does."""
    with replace_file(path, durable=durable, private=private) as part:
        part.write_bytes(content)


def write_text(path: Path, text: str, *, private: bool = False) -> None:
    """Write UTF-8 text atomically, as `replace_file` does."""
    write_bytes(path, text.encode(), private=private)


@contextmanager
def replace_folder(path: Path) -> Iterator[Path]:
    """Yield an empty folder beside `path`, which replaces `path` and its files after the block.

    Until then, and after an error, Ctrl-C or a kill, `path` keeps its former content. Hidden entries of `path`, such as
    `.git`, stay. What a kill leaves is hidden, and the next call for `path` clears it. Raises TrapsError.
    """
    part, former = (path.with_name(f".{path.name}.{name}{PART}") for name in ("new", "former"))
    try:
        _finish_replacement(path, former)
        shutil.rmtree(part, ignore_errors=True)
        part.mkdir(parents=True)
        try:
            yield part
            if path.exists():
                path.rename(former)
            part.rename(path)
            _finish_replacement(path, former)
        finally:
            shutil.rmtree(part, ignore_errors=True)
    except OSError as error:
        if error.filename is not None and not str(error.filename).startswith((str(path), str(part), str(former))):
            raise
        raise TrapsError(
            f"{path}: cannot be written ({error.strerror or error}); {remedy(error)} and run the same command again"
        ) from error


def _finish_replacement(path: Path, former: Path) -> None:
    """Take a folder's former content back if nothing has replaced it, else delete it but for hidden entries."""
    if not former.is_dir():
        return
    if not path.exists():
        former.rename(path)
        return
    for entry in former.glob(".*"):
        entry.rename(path / entry.name)
    shutil.rmtree(former)


def check_disk(folder: Path, least_gb: float) -> str:
    """Return a folder's free space in words; raise TrapsError if it is too small."""
    existing = next(path for path in (folder, *folder.parents) if path.exists())
    free = shutil.disk_usage(existing).free / 1e9
    if free < least_gb:
        raise TrapsError(f"{free:.1f} GB free at {existing}; free at least {least_gb} GB or choose another workspace")
    return f"{free:.1f} GB free at {existing}"
