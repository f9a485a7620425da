"""Launch runs on Ray with dagster-ray; `dagster.yaml` names this launcher."""

from __future__ import annotations

import os
import shlex
import socket
from collections.abc import Callable
from functools import cached_property
from typing import Any

import dagster as dg
from dagster_ray import RayRunLauncher  # pyright: ignore[reportMissingImports] - of the extra `cluster`
from ray.job_submission import JobSubmissionClient  # pyright: ignore[reportMissingImports]

from traps_cluster.ray_runs import RESOURCES_TAG, STUDY_TAG, own_tags
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.models.asking.answer_rows import RESPONSES
from traps_pipeline.pipeline.graph import Stage, the_graph
from traps_pipeline.pipeline.runs import keys_of
from traps_pipeline.storage.workspace import RAY, RUN_CPUS, RUN_GPUS, Workspace


class ClusterLauncher(RayRunLauncher):
    """A launcher of runs through `traps_cluster/node.py`, with their stages' resources."""

    @cached_property
    def client(self) -> JobSubmissionClient:
        """Ray's client, through which dagster-ray submits jobs."""
        return _NodeClient(self.address, metadata=self.metadata, headers=self.headers, cookies=self.cookies)

    def launch_run(self, context: Any) -> None:
        """Launch a run; first tag one from Dagster's pages or sensors like a command's."""
        run = context.dagster_run
        if RESOURCES_TAG not in run.tags:
            tags = tags_of_page_run(run)
            context.workspace.instance.add_run_tags(run.run_id, tags)
            run = run.with_tags({**run.tags, **tags})
            context = type(context)(run, context.workspace)
        self._submit(super().launch_run, context)

    def resume_run(self, context: Any) -> None:
        """Launch a run again after its host died."""
        self._submit(super().resume_run, context)

    def _submit(self, submit: Callable[[Any], None], context: Any) -> None:
        try:
            submit(context)
        except OSError as error:
            study, reason = context.dagster_run.tags.get(STUDY_TAG, ""), " ".join(str(error).split())[:200]
            raise TrapsError(
                f"{self.address}: Ray's head does not answer the host {socket.gethostname()}, which starts the runs of "
                f"the study {study} ({reason}). See that the head runs (`ray status`) and that {RAY} is its address; "
                "then run the same command again"
            ) from error


class _NodeClient(JobSubmissionClient):
    """A job client that submits a run through `traps_cluster/node.py`, quoted for a shell.

    dagster-ray 0.4.8 puts the run, as JSON, between single quotes without escaping.
    """

    def submit_job(self, *, entrypoint: str, metadata: dict[str, str] | None = None, **options: Any) -> str:
        """Submit a job; return its id."""
        command = node_command(entrypoint, (metadata or {})["dagster/run-id"])
        return super().submit_job(entrypoint=command, metadata=metadata, **options)


def node_command(entrypoint: str, run_id: str) -> str:
    """Return a run's command line in the form that dagster-ray expects."""
    command, _, run = entrypoint.partition(" '")
    _, *arguments = command.split()  # without the launching host's `dagster`
    return shlex.join(["python", "-P", "-m", "traps_cluster.node", run_id, *arguments, run.removesuffix("'")])


def tags_of_page_run(run: dg.DagsterRun) -> dict[str, str]:
    """Return a page's or sensor's run tags, as `traps run --cluster` would set them."""
    import traps_pipeline.definitions  # noqa: F401 - declares the stages, which the daemon's process has not loaded

    declared = [the_graph().declared.get(key.path[-1]) for key in run.asset_selection or ()]
    stages = [each for each in declared if isinstance(each, Stage)]
    keys = [key for stage in stages if stage.name == RESPONSES.name for key in keys_of(stage, run.tags)]
    cpus, gpus = int(os.environ.get(RUN_CPUS, "1")), float(os.environ.get(RUN_GPUS, "0"))
    return own_tags(Workspace.open(), stages, keys, cpus, gpus)
