"""The launcher of runs on Ray, with a command line that survives a shell, and with what runs of Dagster's own pages
do not say of themselves."""

from __future__ import annotations

import os
import shlex
import socket
from typing import Any

from dagster_ray import RayRunLauncher  # pyright: ignore[reportMissingImports] - of the extra `cluster`

from traps_pipeline.base.errors import TrapsError
from traps_pipeline.cluster.ray_runs import RUN_CPUS, RUN_GPUS, STUDY_TAG, keys_in, own_tags
from traps_pipeline.cluster.same_code import CODE_TAG, code_here
from traps_pipeline.models.tables import RESPONSES
from traps_pipeline.orchestration.graph import DECLARED, Stage, the_graph
from traps_pipeline.orchestration.runs import range_of
from traps_pipeline.storage.workspace import RAY, Workspace


class QuotingRayRunLauncher(RayRunLauncher):
    """dagster-ray puts what a run is, as JSON, between single quotes without looking whether it holds some. It does
    where `dagster.yaml` names a storage of its own, and Dagster's command then refuses it (dagster-ray 0.4.8)."""

    def _launch_ray_job(self, submission_id: str, entrypoint: str, run: Any) -> None:
        command, _, quoted = entrypoint.partition(" '")
        if CODE_TAG not in run.tags and run.asset_selection:
            tags = tags_of_page_run(run)
            self._instance.add_run_tags(run.run_id, tags)
            run = run.with_tags({**run.tags, **tags})
        try:
            super()._launch_ray_job(submission_id, f"{command} {shlex.quote(quoted.removesuffix(chr(39)))}", run)
        except OSError as error:
            raise TrapsError(
                f"{self.address}: Ray's head does not answer the host {socket.gethostname()}, which starts the runs of "
                f"the study {run.tags.get(STUDY_TAG, '')} ({' '.join(str(error).split())[:200]}). See that the head "
                f"runs (`ray status`) and that {RAY} is its address; then run the same command again"
            ) from error


def tags_of_page_run(run: Any) -> dict[str, str]:
    """What `traps run --cluster` would have said of a run that was launched in Dagster's pages, or by its sensors."""
    if not DECLARED:  # the daemon's own process has not loaded the stages
        run.job_code_origin.repository_origin.code_pointer.load_target()
    workspace, declared = Workspace.open(), the_graph().declared
    names = [key.path[-1] for key in run.asset_selection or ()]
    stages = [one for name in names if isinstance(one := declared.get(name), Stage)]
    if not stages:  # of sources alone, or of checks
        return {STUDY_TAG: workspace.study.name, CODE_TAG: code_here()}
    asked = keys_in([one for one in stages if one.name == RESPONSES.name], range_of(run.tags))
    given = int(os.environ.get(RUN_CPUS, "1")), float(os.environ.get(RUN_GPUS, "0"))
    return own_tags(workspace.study.name, str(workspace.place), stages, asked, *given)
