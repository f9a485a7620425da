"""Where a study can lie: in a folder of this machine, or at an address in an object store."""

from __future__ import annotations

import os
import re
from pathlib import Path
from urllib.parse import urlsplit

from traps_pipeline.base.digests import digest
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.base.names import LONGEST
from traps_pipeline.base.paths import require_history_path, user_cache

STUDY = "study.yaml"
SCRATCH = "TRAPS_SCRATCH"  # names the folder in which the files of object stores are while they are used
SCHEMES = ("s3", "gs", "az")
Place = Path | str  # a folder, or an address s3://bucket/study


def place_of(text: str) -> Place:
    """Return what a person names: an address in an object store, or a folder. Raises TrapsError for another address."""
    if "://" not in text:
        folder = Path(text).absolute()
        require_history_path(folder)
        return folder
    address = urlsplit(text.rstrip("/"))
    if address.scheme not in SCHEMES or not address.netloc or address.query or address.username:
        raise TrapsError(
            f"{text}: is no place for a study; name a folder, or {', '.join(f'{s}://BUCKET/STUDY' for s in SCHEMES)}, "
            "and give keys in the environment"
        )
    return address.geturl()


def name_of(place: Place) -> str:
    """Return a name that no study elsewhere has: the folder's, and a digest of where it was made."""
    plain = re.sub(r"[^a-z0-9]+", "-", str(place).rpartition("/")[2].lower()).strip("-")[:LONGEST]
    return f"{plain}-{digest(str(place))[:8]}".lstrip("-")


def scratch_of(address: str) -> Path:
    """Return the folder of this machine for the files of a study in an object store."""
    return Path(os.environ.get(SCRATCH) or user_cache()).absolute() / name_of(address)
