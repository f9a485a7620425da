"""Hash values as SHA-256 of canonical JSON, everywhere in the same way."""

import hashlib
import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

# Made once: `json.dumps` makes an encoder for each value.
_ENCODER = json.JSONEncoder(sort_keys=True, separators=(",", ":"), ensure_ascii=False, allow_nan=False)


def canonical_json(value: Any) -> str:
    """Return JSON with sorted keys, no spaces, no NaN; equal values give equal text."""
    return _ENCODER.encode(value)


def digest(value: Any) -> str:
    """Return the SHA-256 of a JSON-able value in hexadecimal."""
    return hashlib.sha256(canonical_json(value).encode()).hexdigest()


def digest_of_list(values: Iterable[Any]) -> str:
    """Return `digest(list(values))`, but hold only one value in memory at a time."""
    hasher, separator = hashlib.sha256(b"["), b""
    for value in values:
        hasher.update(separator + canonical_json(value).encode())
        separator = b","
    hasher.update(b"]")
    return hasher.hexdigest()


def file_digest(path: Path) -> str:
    """Return the SHA-256 of a file's bytes in hexadecimal."""
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()
