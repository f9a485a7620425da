"""Launch runs on Ray with dagster-ray; `dagster.yaml` names this launcher."""

from __future__ import annotations

import os
import shlex
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cached_property
from typing import Any

import dagster as dg
from dagster_ray import RayRunLauncher  # pyright: ignore[reportMissingImports] - of the extra `cluster`
from ray.job_submission import JobSubmissionClient  # pyright: ignore[reportMissingImports]

from traps_pipeline.base.errors import TrapsError
from traps_pipeline.cluster.resources import RESOURCES_TAG, STUDY_TAG, keys_in, own_tags
from traps_pipeline.models.answer_rows import RESPONSES
from traps_pipeline.pipeline.graph import Stage, the_graph
from traps_pipeline.pipeline.runs import range_of
from traps_pipeline.storage.workspace import RAY, RUN_CPUS, RUN_GPUS, Workspace


class ClusterLauncher(RayRunLauncher):
    """A launcher of runs through `cluster/node.py`, with their stages' resources."""

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
        with self._answering(run):
            super().launch_run(context)

    def resume_run(self, context: Any) -> None:
        """Launch a run again after its host died."""
        with self._answering(context.dagster_run):
            super().resume_run(context)

    @contextmanager
    def _answering(self, run: dg.DagsterRun) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            raise TrapsError(
                f"{self.address}: Ray's head does not answer the host {socket.gethostname()}, which starts the runs of "
                f"the study {run.tags.get(STUDY_TAG, '')} ({' '.join(str(error).split())[:200]}). See that the head "
                f"runs (`ray status`) and that {RAY} is its address; then run the same command again"
            ) from error


class _NodeClient(JobSubmissionClient):
    """A job client that submits a run through `cluster/node.py`, quoted for a shell.

    dagster-ray 0.4.8 puts the run, as JSON, between single quotes without escaping.
    """

    def submit_job(self, *, entrypoint: str, metadata: dict[str, str] | None = None, **options: Any) -> str:
        """Submit a job; return its id."""
        return super().submit_job(
            entrypoint=node_command(entrypoint, (metadata or {})["dagster/run-id"]), metadata=metadata, **options
        )


def node_command(entrypoint: str, run_id: str) -> str:
    """Return a run's command line in the form that dagster-ray expects."""
    command, _, run = entrypoint.partition(" '")
    _, *arguments = command.split()  # without the launching host's `dagster`
    return shlex.join(["python", "-P", "-m", "traps_pipeline.cluster.node", run_id, *arguments, run.removesuffix("'")])


def tags_of_page_run(run: dg.DagsterRun) -> dict[str, str]:
    """Return a page's or sensor's run tags, as `traps run --cluster` would set them."""
    import traps_pipeline.definitions  # noqa: F401 - declares the stages, which the daemon's process has not loaded

    workspace, declared = Workspace.open(), the_graph().declared
    names = [key.path[-1] for key in run.asset_selection or ()]
    stages = [declaration for name in names if isinstance(declaration := declared.get(name), Stage)]
    keys = keys_in([declaration for declaration in stages if declaration.name == RESPONSES.name], range_of(run.tags))
    cpus, gpus = int(os.environ.get(RUN_CPUS, "1")), float(os.environ.get(RUN_GPUS, "0"))
    return own_tags(workspace, stages, keys, cpus, gpus)
