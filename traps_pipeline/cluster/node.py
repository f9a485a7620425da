"""Execute a run on the node where Ray started it, after checks of the host.

Command: `python -P -m traps_pipeline.cluster.node RUN_ID api execute_run RUN`. Before Dagster's own command begins,
this process checks that the host has the same code and can open the study. Otherwise the run fails with a sentence that
names the host, and is not retried.
"""

from __future__ import annotations

import os
import runpy
import sys
from contextlib import suppress
from typing import NoReturn

from traps_pipeline.base.errors import TrapsError
from traps_pipeline.cluster.logs import uploading
from traps_pipeline.cluster.same_code import CODE, require_same_code
from traps_pipeline.cluster.shared_history import export
from traps_pipeline.storage.workspace import Workspace

REFUSED_TAG = "traps/refused"  # tag of a run that its node refused


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
