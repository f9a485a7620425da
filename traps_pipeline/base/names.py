"""Validate names that users choose, of models, judges, benchmarks and the like."""

import re
from contextlib import suppress
from functools import lru_cache
from typing import Annotated

from pydantic import AfterValidator

MAX_NAME_LENGTH = 80  # characters: two names and what is added to them stay below the 255 bytes of a file name
_NAME = re.compile(rf"(?!.*\.\.)[a-z0-9](?:[a-z0-9.-]{{0,{MAX_NAME_LENGTH - 2}}}[a-z0-9])?")


@lru_cache(maxsize=4096)
def check_name(name: str) -> str:
    """Return the name unchanged.

    Raises ValueError unless it is valid in a partition key (so it contains no `...`), a path, a file name and an
    option, and unless every reader of YAML, CSV and partitioned folders reads it as text.
    """
    if not _NAME.fullmatch(name) or not _is_text(name):
        raise ValueError(
            f"id {name[:100]!r} must match [a-z0-9.-]+, begin and end with a letter or digit, have no two dots in a "
            f"row and at most {MAX_NAME_LENGTH} characters, and be no number, date or truth value (it becomes part of "
            "partition keys, file names and YAML)"
        )
    return name


def _is_text(name: str) -> bool:
    import yaml

    with suppress(ValueError):
        float(name)  # a number of CSV and of folders, nan and inf among them
        return False
    try:
        return isinstance(yaml.safe_load(name), str)
    except (ValueError, yaml.YAMLError):  # 2026-13-45 looks like a date
        return False


Name = Annotated[str, AfterValidator(check_name)]
