"""Append JSON Lines with a checksum per line, to detect damaged lines."""

import errno
import json
import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from hashlib import blake2b
from pathlib import Path
from typing import Any

_SUM = b', "sum": "'
_TAIL = len(_SUM) + 16 + len(b'"}\n')
NOT_WHOLE = "not what was written"


def line_with_checksum(row: Mapping[str, Any]) -> bytes:
    """Return a JSON line that ends with its checksum. Raises ValueError for NaN."""
    body = json.dumps(row, ensure_ascii=False, allow_nan=False).encode()[:-1]
    return body + _SUM + _sum_of(body) + b'"}\n'


def _sum_of(body: bytes) -> bytes:
    return blake2b(body, digest_size=8).hexdigest().encode()


def is_whole(line: bytes) -> bool:
    """Return whether a line is undamaged output of `line_with_checksum`."""
    tail = line[-_TAIL:]
    return tail.startswith(_SUM) and tail.endswith(b'"}\n') and tail[len(_SUM) : -3] == _sum_of(line[:-_TAIL])


@dataclass(frozen=True)
class Line:
    """A line of a file, numbered from 1: `whole` if intact, `torn` if cut by a crash."""

    number: int
    content: bytes
    whole: bool
    torn: bool = False


def read_checked(path: Path) -> Iterator[Line]:
    """Yield the lines of a file that this module wrote, damaged ones included."""
    with path.open("rb") as stream:
        for number, line in enumerate(stream, start=1):
            if not line.endswith(b"\n"):  # the last one; that which lacks only its end, or has another one, is whole
                full_line = line + b"\n" if is_whole(line + b"\n") else line[:-1] + b"\n"
                yield Line(number, full_line, is_whole(full_line), torn=not is_whole(full_line))
            else:
                yield Line(number, line, is_whole(line))


def append_whole(descriptor: int, content: bytes) -> None:
    """Append all of the content, or nothing. Raises OSError."""
    size, remaining = os.lseek(descriptor, 0, os.SEEK_END), content
    try:
        while remaining:
            count = os.write(descriptor, remaining)
            if not count:
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            remaining = remaining[count:]
    except OSError:
        os.ftruncate(descriptor, size)
        raise
