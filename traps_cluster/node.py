"""Execute a run on the node where Ray started it, if the host has the submitter's code.

Command: `python -P -m traps_cluster.node RUN_ID api execute_run RUN`. Before Dagster's own command begins,
this process checks that the host has the same code and can open the study. Otherwise the run fails with a sentence that
names the host, and is not retried.
"""

from __future__ import annotations

import json
import os
import re
import runpy
import socket
import sys
from contextlib import suppress
from functools import cache
from importlib.metadata import PackageNotFoundError, requires, version
from pathlib import Path
from typing import NoReturn

from traps_cluster.history import export, uploading
from traps_pipeline.base.digests import digest, file_digest
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.base.paths import ASSETS, PACKAGE, SCENE_SPECS, SHIPPED
from traps_pipeline.storage.workspace import Workspace

REFUSED_TAG = "traps/refused"  # tag of a run that its node refused
CODE = "TRAPS_CODE"  # tag of a run: the submitting host's code
DISTRIBUTION = "traps-pipeline"
_NAME, _NOT_FOR_RUNS = re.compile(r"[\w.-]+"), re.compile(r"extra == ['\"](dev|docs|sign|test)['\"]")


@cache
def code_here() -> str:
    """Return this host's code, as JSON.

    It has digests of the package's own files and of those that people edit (`assets/`, `scene_specs/`), and the
    versions of Python and of every installed package that `pyproject.toml` names. Builds for other hardware (`+cpu`,
    `+cu128`) count as the same version.
    """
    own = Path(__file__).parent
    folders = {"the package": PACKAGE, "traps_cluster": own, "assets": ASSETS, "scene_specs": SCENE_SPECS}
    code = {"python": ".".join(map(str, sys.version_info[:2]))}
    code |= {f"files of {name}": _digest_of(folder) for name, folder in folders.items()}
    requirements = [line for line in requires(DISTRIBUTION) or () if not _NOT_FOR_RUNS.search(line)]
    for name in sorted({DISTRIBUTION, *(match[0] for line in requirements if (match := _NAME.match(line)))}):
        with suppress(PackageNotFoundError):
            code[name] = version(name).partition("+")[0]
    return json.dumps(code)


def _digest_of(folder: Path) -> str:
    files = (path for path in folder.rglob("*") if path.is_file() and "__pycache__" not in path.parts)
    own = (path for path in files if not path.is_relative_to(SHIPPED))
    return digest({path.relative_to(folder).as_posix(): file_digest(path) for path in own})[:12]


def require_same_code(submitted: str, study: str) -> None:
    """Raise TrapsError unless a run was submitted by a host with the same code.

    submitted: the result of `code_here` there. Packages that only one of the two has are ignored: a host without a GPU
    need not have a GPU's packages.
    """
    here, there = json.loads(code_here()), json.loads(submitted or "{}")
    if names := [name for name in sorted(here.keys() & there.keys()) if here[name] != there[name]]:
        described = ", ".join(f"{name} {here[name]} here and {there[name]} there" for name in names)
        raise TrapsError(
            f"the host {socket.gethostname()} has other code than the host that submitted this run of the study "
            f"{study}: {described}. Install the same version of the package from the same lock on both, and run the "
            "same command again"
        )


def main() -> None:
    """Execute a run, upload its output, and exit with Dagster's exit code."""
    run_id, *command = sys.argv[1:]
    try:
        workspace = Workspace.open()
        require_same_code(os.environ.get(CODE, ""), workspace.study.name)
    except TrapsError as error:
        _refuse(run_id, error)
    export(workspace, is_kept=True)
    sys.argv = ["dagster", *command]
    with uploading(workspace, run_id):
        runpy.run_module("dagster", run_name="__main__", alter_sys=True)


def _refuse(run_id: str, error: TrapsError) -> NoReturn:
    with suppress(TrapsError):  # then the head learns of it from Ray
        from traps_pipeline.pipeline.run import dagster_history  # reads registries, which may differ, too

        with dagster_history(Workspace.open()) as instance:
            instance.add_run_tags(run_id, {REFUSED_TAG: "true"})
            if run := instance.get_run_by_id(run_id):
                instance.report_run_failed(run, str(error))
    raise SystemExit(str(error))


if __name__ == "__main__":
    main()
