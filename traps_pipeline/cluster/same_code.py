"""Check that two hosts run the same code, before one executes the other's run."""

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

CODE = "TRAPS_CODE"  # tag of a run: the submitting host's code
DISTRIBUTION = "traps-pipeline"
_NAME, _NOT_FOR_RUNS = re.compile(r"[\w.-]+"), re.compile(r"extra == ['\"](dev|docs|sign|test)['\"]")


@cache
def code_here() -> str:
    """Return this host's code, as JSON.

    It has digests of the package's own files and of those that people edit (`assets/`, `scene_specs/`), and the
    versions of Python and of every installed package that `pyproject.toml` names.
    """
    folders = {"the package": PACKAGE, "assets": ASSETS, "scene_specs": SCENE_SPECS}
    return json.dumps(
        {f"files of {name}": _digest_of(folder) for name, folder in folders.items()} | installed_versions()
    )


def installed_versions() -> dict[str, str]:
    """Return installed versions of Python, this package and its dependencies, by name.

    Builds for other hardware (`+cpu`, `+cu128`) count as the same version.
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
    """Raise TrapsError unless a run was submitted by a host with the same code.

    submitted: the result of `code_here` there. Packages that only one of the two has are ignored: a host without a GPU
    need not have a GPU's packages.
    """
    if not submitted:
        return
    own_code, submitted_code = json.loads(code_here()), json.loads(submitted)
    if differences := [
        name for name in sorted(own_code.keys() & submitted_code.keys()) if own_code[name] != submitted_code[name]
    ]:
        described = ", ".join(f"{name} {own_code[name]} here and {submitted_code[name]} there" for name in differences)
        raise TrapsError(
            f"the host {socket.gethostname()} has other code than the host that submitted this run of the study "
            f"{study}: {described}. Install the same version of the package from the same lock on both, and run the "
            "same command again"
        )


def _digest_of(folder: Path) -> str:
    files = (path for path in folder.rglob("*") if path.is_file() and "__pycache__" not in path.parts)
    own = (path for path in files if not path.is_relative_to(SHIPPED))
    return digest({path.relative_to(folder).as_posix(): file_digest(path) for path in own})[:12]
