"""The launcher of runs on Ray, with a command line that survives a shell."""

from __future__ import annotations

import shlex
from typing import Any

from dagster_ray import RayRunLauncher  # pyright: ignore[reportMissingImports] - of the extra `cluster`


class QuotingRayRunLauncher(RayRunLauncher):
    """dagster-ray puts what a run is, as JSON, between single quotes without looking whether it holds some. It does
    where `dagster.yaml` names a storage of its own, and Dagster's command then refuses it (dagster-ray 0.4.8)."""

    def _launch_ray_job(self, submission_id: str, entrypoint: str, run: Any) -> None:
        command, _, quoted = entrypoint.partition(" '")
        super()._launch_ray_job(submission_id, f"{command} {shlex.quote(quoted.removesuffix(chr(39)))}", run)
