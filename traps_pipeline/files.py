"""The one way to write a file: whole or not at all."""

from __future__ import annotations

import os
import secrets
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from traps_pipeline.errors import TrapsError


@contextmanager
def replacing(path: Path, *, durable: bool = False) -> Iterator[Path]:
    """A path beside `path` for the block to write to. At the block's end the file there takes the place of `path`.

    Until then, and after an error, Ctrl-C or a kill, `path` is what it was before. An unfinished file is removed. Only
    a kill leaves it, hidden and named `*.part`; nothing reads it. Missing folders are made.

    durable: the content is on the disk before it gets its name, so that not even a power cut leaves a torn file under
    that name. Raises TrapsError that names `path` when it cannot be written; an OSError about another file, which the
    block reads, passes as it is.
    """
    # No process, thread or machine that shares the folder draws the same name.
    part = path.with_name(f".{path.name}.{secrets.token_hex(4)}.part")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            yield part
            if durable:
                with part.open("rb") as stream:
                    os.fsync(stream.fileno())
            part.replace(path)
        finally:
            part.unlink(missing_ok=True)
    except OSError as error:
        if error.filename is not None and str(error.filename) not in map(str, (part, *path.parents)):
            raise
        raise TrapsError(
            f"{path}: cannot be written ({error.strerror or error}); free some space and run the same command again "
            "(nothing was half-written, and what is finished is kept)"
        ) from error


def write_bytes(path: Path, content: bytes, *, durable: bool = False) -> None:
    """Write a file as `replacing` does."""
    with replacing(path, durable=durable) as part:
        part.write_bytes(content)


def write_text(path: Path, text: str) -> None:
    """Write UTF-8 text as `replacing` does."""
    write_bytes(path, text.encode())
