"""Folders below which Dagster can keep no history."""

from __future__ import annotations

from pathlib import Path

import pytest

from traps_pipeline.base.errors import TrapsError
from traps_pipeline.storage.study import Study
from traps_pipeline.storage.workspace import Workspace


@pytest.mark.parametrize("name", ["a?b", "a%41b"])
@pytest.mark.parametrize("is_home", [False, True])
def test_a_folder_that_dagsters_history_cannot_lie_in_is_refused_before_anything_is_written(
    name: str, is_home: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    if is_home:
        monkeypatch.setenv("DAGSTER_HOME", str(tmp_path / name))
    else:
        monkeypatch.delenv("DAGSTER_HOME", raising=False)
    with pytest.raises(TrapsError, match="choose a path without it"):
        Workspace.create(tmp_path / ("study" if is_home else name), Study(name="study"))
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("name", ["a#b", "a%b", "a b"])
def test_a_folder_with_other_signs_keeps_a_history(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from traps_pipeline.pipeline.run import dagster_history

    monkeypatch.setenv("TRAPS_WORKSPACE", str(tmp_path / name))
    monkeypatch.setenv("DAGSTER_HOME", str(tmp_path / name / "dagster"))
    workspace = Workspace.create(tmp_path / name, Study(name="study"))
    with dagster_history(workspace) as history:
        assert history.get_runs() == []
    assert (tmp_path / name / "dagster" / "dagster.yaml").is_file()
