"""Whether two hosts run the same code: what is compared before a run of another host's begins."""

from __future__ import annotations

import socket
from collections.abc import Mapping
from functools import cache

from traps_pipeline.digests import digest, file_digest
from traps_pipeline.errors import TrapsError
from traps_pipeline.paths import PACKAGE

CODE_TAG = "traps/code"  # of runs: the code of the host that submitted them
# What decides the bytes of clips, tables and calls; the lock pins these.
DECISIVE = ("av", "dagster", "mujoco", "numpy", "opencv-python-headless", "pandas", "pyarrow", "scikit-learn", "scipy")


@cache
def code_here() -> str:
    """This host's code in one word: the package's version, a digest of its files, and one of the installed versions
    of the packages that results depend on."""
    files = {path.relative_to(PACKAGE).as_posix(): file_digest(path) for path in sorted(PACKAGE.rglob("*.py"))}
    return f"{_version('traps-pipeline')}, files {digest(files)[:8]}, packages {digest(installed())[:8]}"


def installed() -> dict[str, str]:
    """The installed versions of the packages that results depend on."""
    return {name: _version(name) for name in DECISIVE}


def _version(name: str) -> str:
    from importlib.metadata import PackageNotFoundError, version

    try:
        return version(name)
    except PackageNotFoundError:
        return "none"


def require_same_code(tags: Mapping[str, str], study: str) -> None:
    """Raises TrapsError where a run was submitted by a host with other code than this one's."""
    theirs = tags.get(CODE_TAG)
    if theirs is not None and theirs != code_here():
        here = ", ".join(f"{name} {found}" for name, found in installed().items())
        raise TrapsError(
            f"the host {socket.gethostname()} has other code than the host that submitted this run of the study "
            f"{study} ({code_here()} here, {theirs} there; here are {here}). Install the same version of the package "
            "from the same lock on both, and run the same command again"
        )
