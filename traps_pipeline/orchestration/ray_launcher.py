"""The launcher of runs on Ray, with a command line that survives a shell."""

from __future__ import annotations

import shlex
import socket
from typing import Any

from dagster_ray import RayRunLauncher  # pyright: ignore[reportMissingImports] - of the extra `cluster`

from traps_pipeline.errors import TrapsError
from traps_pipeline.orchestration.cluster import STUDY_TAG
from traps_pipeline.storage.workspace import RAY


class QuotingRayRunLauncher(RayRunLauncher):
    """dagster-ray puts what a run is, as JSON, between single quotes without looking whether it holds some. It does
    where `dagster.yaml` names a storage of its own, and Dagster's command then refuses it (dagster-ray 0.4.8)."""

    def _launch_ray_job(self, submission_id: str, entrypoint: str, run: Any) -> None:
        command, _, quoted = entrypoint.partition(" '")
        try:
            super()._launch_ray_job(submission_id, f"{command} {shlex.quote(quoted.removesuffix(chr(39)))}", run)
        except OSError as error:
            raise TrapsError(
                f"{self.address}: Ray's head does not answer the host {socket.gethostname()}, which starts the runs of "
                f"the study {run.tags.get(STUDY_TAG, '')} ({' '.join(str(error).split())[:200]}). See that the head "
                f"runs (`ray status`) and that {RAY} is its address; then run the same command again"
            ) from error
