"""What a run's resource owes the steps that Dagster drops."""

import gc
import resource
from collections.abc import Generator, Iterator
from pathlib import Path

import dagster as dg
import pytest

from traps_pipeline.pipeline.assets import WorkspaceResource
from traps_pipeline.pipeline.run import dagster_history
from traps_pipeline.pipeline.step import Event
from traps_pipeline.storage.study import Study
from traps_pipeline.storage.workspace import Workspace


@pytest.fixture
def limits() -> Iterator[None]:
    """Undo what a test does to this process: a limit on files, and no garbage collection."""
    former = resource.getrlimit(resource.RLIMIT_FSIZE)
    gc.disable()
    yield
    gc.enable()
    resource.setrlimit(resource.RLIMIT_FSIZE, former)


def test_a_step_that_is_dropped_when_the_disk_is_full_is_closed_at_the_end_of_its_run(
    tmp_path: Path, limits: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("DAGSTER_HOME", str(tmp_path / "study" / "dagster"))
    workspace, steps = Workspace.create(tmp_path / "study", Study()), list[str]()

    def events() -> Generator[Event, None, None]:
        _, most = resource.getrlimit(resource.RLIMIT_FSIZE)
        try:
            resource.setrlimit(resource.RLIMIT_FSIZE, (0, most))  # the history cannot be written any more
            yield dg.AssetMaterialization("table", metadata={"text": "x" * 100_000})
            steps.append("went on")
            yield dg.Output(None)
        finally:
            steps.append("closed")
            resource.setrlimit(resource.RLIMIT_FSIZE, (most, most))

    @dg.asset
    def table(workspace: WorkspaceResource) -> Iterator[Event]:
        yield from workspace.until_torn_down(events())

    given = {"workspace": WorkspaceResource(root=str(workspace.root))}
    with dagster_history(workspace) as history, pytest.raises(Exception, match=r"File too large|could not be written"):
        dg.materialize([table], instance=history, resources=given)
    assert steps == ["closed"]
