"""Name the items of a held-out set so that only the key's owner knows them."""

from __future__ import annotations

import hmac
import re
import secrets
from pathlib import Path

from traps_pipeline.base.errors import TrapsError
from traps_pipeline.base.files import write_text

KEY_BYTES = 32


def opaque(key: bytes, item_id: str) -> str:
    """Return a held-out item's name, which only the key can map to the item."""
    return hmac.new(key, item_id.encode(), "sha256").hexdigest()[:24]


def held_out_key(path: Path, *, make: bool = False) -> bytes:
    """Return the key of a held-out set, from its file of 64 hexadecimal digits.

    A missing file is created with a random key, readable by its owner alone. Raises TrapsError.
    """
    if make and not path.exists():
        write_text(path, secrets.token_hex(KEY_BYTES) + "\n")
        path.chmod(0o600)
    try:
        text = path.read_text(encoding="ascii").strip()
    except (OSError, UnicodeDecodeError) as error:
        raise TrapsError(f"{path}: cannot be read ({error}); give the file of the held-out set's key") from error
    if not re.fullmatch(rf"[0-9a-f]{{{2 * KEY_BYTES}}}", text):
        raise TrapsError(f"{path}: is no key ({2 * KEY_BYTES} hexadecimal digits); give the one that the release made")
    return bytes.fromhex(text)
