"""Folders whose names have characters that mean something in a URL."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.build.errors import raises
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.checks.doctor import _damaged_history
from traps_pipeline.storage.place import place_of


@pytest.mark.parametrize("name", ["p%41", "q?x"])
def test_a_folder_that_dagster_would_read_as_another_is_refused(tmp_path: Path, name: str) -> None:
    with raises(TrapsError, "base.paths.require_history_path"):
        place_of(str(tmp_path / name))


@pytest.mark.parametrize("name", ["a b", "a#1", "100% x", "\u00e9"])
def test_other_folders_are_taken_as_they_are(tmp_path: Path, name: str) -> None:
    assert place_of(str(tmp_path / name)) == tmp_path / name


def test_a_damaged_history_below_a_folder_with_a_hash_is_found(tmp_path: Path) -> None:
    history = tmp_path / "a#1" / "runs.db"
    history.parent.mkdir()
    history.write_bytes(b"no database" * 1000)
    assert str(history) in _damaged_history(history)
    assert [path.name for path in tmp_path.iterdir()] == ["a#1"]
