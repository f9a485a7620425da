"""Locate a study: a folder of this machine, or an address in an object store."""

import os
import re
from pathlib import Path
from urllib.parse import urlsplit

from traps_pipeline.base.digests import digest
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.base.names import MAX_NAME_LENGTH
from traps_pipeline.base.paths import require_history_path, user_cache

STUDY = "study.yaml"
SCRATCH = "TRAPS_SCRATCH"  # environment variable: the local folder for files of object stores
SCHEMES = ("s3", "gs", "az")
Place = Path | str  # a folder, or an address s3://bucket/study


def parse_place(text: str) -> Place:
    """Parse an object store's address or a folder. Raises TrapsError."""
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
    """Return a unique name of a study: its folder's, and a digest of where it began."""
    plain_name = re.sub(r"[^a-z0-9]+", "-", str(place).rpartition("/")[2].lower()).strip("-")[:MAX_NAME_LENGTH]
    return f"{plain_name}-{digest(str(place))[:8]}".lstrip("-")


def scratch_of(address: str) -> Path:
    """Return the local folder for the files of a study in an object store."""
    return Path(os.environ.get(SCRATCH) or user_cache()).absolute() / name_of(address)
