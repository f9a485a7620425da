"""Whether two hosts run the same code: what is compared before a run of another host's begins."""

from __future__ import annotations

import json
import re
import socket
import sys
from collections.abc import Iterator, Mapping
from functools import cache
from pathlib import Path

from traps_pipeline.base.digests import digest, file_digest
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.base.paths import ASSETS, PACKAGE, SCENE_SPECS, SHIPPED

CODE_TAG = "traps/code"  # of runs: the code of the host that submitted them
DISTRIBUTION = "traps-pipeline"
_NAME, _NOT_FOR_RUNS = re.compile(r"[\w.-]+"), re.compile(r"extra == ['\"](dev|docs|sign|test)['\"]")


@cache
def code_here() -> str:
    """This host's code, as JSON: digests of the package's own files and of those that people edit (`assets/`,
    `scene_specs/`), and the versions of Python and of every package that `pyproject.toml` names and that is here."""
    folders = {"the package": PACKAGE, "assets": ASSETS, "scene_specs": SCENE_SPECS}
    files = {name: _digest_of(folder) for name, folder in folders.items()}
    return json.dumps({"files": files, "versions": installed()}, sort_keys=True)


def installed() -> dict[str, str]:
    """Versions of Python, of this package, and of what it names, by name; what is not installed is left out. Builds for
    other hardware (`+cpu`, `+cu128`) are the same version."""
    from importlib.metadata import PackageNotFoundError, requires, version

    wanted = [line for line in requires(DISTRIBUTION) or () if not _NOT_FOR_RUNS.search(line)]
    found = {"python": ".".join(map(str, sys.version_info[:2]))}
    for name in sorted({DISTRIBUTION, *(match[0] for line in wanted if (match := _NAME.match(line)))}):
        try:
            found[name] = version(name).partition("+")[0]
        except PackageNotFoundError:
            continue
    return found


def require_same_code(tags: Mapping[str, str], study: str) -> None:
    """Raises TrapsError where a run was submitted by a host with other code than this one's. What only one of the two
    has installed is not compared: a host without a GPU need not have what a GPU wants."""
    if CODE_TAG not in tags:
        return
    here, there = _flat(code_here()), _flat(tags[CODE_TAG])
    differ = [name for name in sorted(here.keys() & there.keys()) if here[name] != there[name]]
    if differ:
        told = ", ".join(f"{name} {here[name]} here and {there[name]} there" for name in differ)
        raise TrapsError(
            f"the host {socket.gethostname()} has other code than the host that submitted this run of the study "
            f"{study}: {told}. Install the same version of the package from the same lock on both, and run the same "
            "command again"
        )


def _flat(said: str) -> dict[str, str]:
    """What is compared, by name. Something that no host of this version says is one thing that differs."""
    try:
        parsed = json.loads(said)
        return {f"files of {name}": str(one) for name, one in parsed["files"].items()} | {
            str(name): str(one) for name, one in parsed["versions"].items()
        }
    except (ValueError, KeyError, TypeError, AttributeError):
        return {DISTRIBUTION: said[:80]}


def _digest_of(folder: Path) -> str:
    return digest({path.relative_to(folder).as_posix(): file_digest(path) for path in _files(folder)})[:12]


def _files(folder: Path) -> Iterator[Path]:
    for path in sorted(folder.rglob("*")):
        if path.is_file() and "__pycache__" not in path.parts and not path.is_relative_to(SHIPPED):
            yield path
