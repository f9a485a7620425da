"""Whether two hosts run the same code: what is compared before a run of another host's begins."""

from __future__ import annotations

import json
import re
import socket
import sys
from functools import cache
from pathlib import Path

from traps_pipeline.base.digests import digest, file_digest
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.base.paths import ASSETS, PACKAGE, SCENE_SPECS, SHIPPED

CODE = "TRAPS_CODE"  # of a run: the code of the host that submitted it
DISTRIBUTION = "traps-pipeline"
_NAME, _NOT_FOR_RUNS = re.compile(r"[\w.-]+"), re.compile(r"extra == ['\"](dev|docs|sign|test)['\"]")


@cache
def code_here() -> str:
    """Return this host's code, as JSON: digests of the package's own files and of those that people edit (`assets/`,
    `scene_specs/`), and the versions of Python and of every package that `pyproject.toml` names and that is here."""
    folders = {"the package": PACKAGE, "assets": ASSETS, "scene_specs": SCENE_SPECS}
    return json.dumps({f"files of {name}": _digest_of(folder) for name, folder in folders.items()} | installed())


def installed() -> dict[str, str]:
    """Return versions of Python, of this package, and of what it names, by name; what is not installed is left out.

    Builds for other hardware (`+cpu`, `+cu128`) are the same version.
    """
    from importlib.metadata import PackageNotFoundError, requires, version

    requirements = [line for line in requires(DISTRIBUTION) or () if not _NOT_FOR_RUNS.search(line)]
    versions = {"python": ".".join(map(str, sys.version_info[:2]))}
    for name in sorted({DISTRIBUTION, *(match[0] for line in requirements if (match := _NAME.match(line)))}):
        try:
            versions[name] = version(name).partition("+")[0]
        except PackageNotFoundError:
            continue
    return versions


def require_same_code(submitted: str, study: str) -> None:
    """Check that a run was submitted by a host with the same code, which `code_here` returned there. Raises TrapsError.

    What only one of the two has installed is not compared: a host without a GPU need not have what a GPU wants.
    """
    if not submitted:
        return
    here, theirs = json.loads(code_here()), json.loads(submitted)
    if differences := [name for name in sorted(here.keys() & theirs.keys()) if here[name] != theirs[name]]:
        described = ", ".join(f"{name} {here[name]} here and {theirs[name]} there" for name in differences)
        raise TrapsError(
            f"the host {socket.gethostname()} has other code than the host that submitted this run of the study "
            f"{study}: {described}. Install the same version of the package from the same lock on both, and run the "
            "same command again"
        )


def _digest_of(folder: Path) -> str:
    files = (path for path in folder.rglob("*") if path.is_file() and "__pycache__" not in path.parts)
    own = (path for path in files if not path.is_relative_to(SHIPPED))
    return digest({path.relative_to(folder).as_posix(): file_digest(path) for path in own})[:12]
