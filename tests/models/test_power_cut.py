"""What a power cut leaves of a run: answers whose file was synced, and no others."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import pytest

from tests.build.asking import LEFT, TEN, Answering, ask, kept
from traps_pipeline.models import ask as asking
from traps_pipeline.models.request import Outcome, Request


@pytest.fixture
def study(tmp_path: Path) -> Path:
    return tmp_path / "study"


@pytest.fixture
def disk(study: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The study as the last sync of its ledger's log left it."""
    fsync, left = os.fsync, tmp_path / "disk"

    def syncing(descriptor: int) -> None:
        fsync(descriptor)
        if Path(f"/proc/self/fd/{descriptor}").readlink().name.endswith("-wal"):
            shutil.copytree(study, left, ignore=shutil.ignore_patterns("*-shm"), dirs_exist_ok=True)

    monkeypatch.setattr(os, "fsync", syncing)
    return left


def test_no_answer_of_a_finished_cell_is_lost(study: Path, disk: Path) -> None:
    ask(study, Answering(), TEN)
    assert len(kept(disk)) == len(TEN)


def test_a_run_that_goes_on_loses_only_its_last_moments(
    study: Path, disk: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(asking, "SYNC_S", 0.01)
    left: list[int] = []

    def says(request: Request, _: int) -> Outcome:
        if request.about["item_id"] == "item-9":
            left.append(len(kept(disk)))
        return LEFT

    ask(study, Answering(says, after_s=0.2), TEN)
    assert left[0] >= 4  # the first four had come back long before
