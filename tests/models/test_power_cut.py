"""What a power cut leaves of a run: answers whose file was synced, and no others."""

from __future__ import annotations

import asyncio
import itertools
import os
import shutil
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.build.asking import TEN, Answering, ask, kept
from traps_pipeline.models.asking import workers
from traps_pipeline.models.request import Outcome, Request

OnDisk = Callable[[], list[str]]


@pytest.fixture
def study(tmp_path: Path) -> Path:
    return tmp_path / "study"


@pytest.fixture
def on_disk(study: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> OnDisk:
    """The items whose answers the ledger has in a copy made as its log was last synced."""
    fsync, copies, numbers = os.fsync, list[Path](), itertools.count()  # two threads may sync at once

    def syncing(descriptor: int) -> None:
        fsync(descriptor)
        if Path(f"/proc/self/fd/{descriptor}").readlink().name.endswith("-wal"):
            copy = tmp_path / f"disk-{next(numbers)}"
            shutil.copytree(study, copy, ignore=shutil.ignore_patterns("*-shm"))
            copies.append(copy)

    monkeypatch.setattr(os, "fsync", syncing)
    return lambda: kept(copies[-1]) if copies else []


def test_no_answer_of_a_finished_cell_is_lost(study: Path, on_disk: OnDisk) -> None:
    ask(study, Answering(), TEN)
    assert len(on_disk()) == len(TEN)


def test_while_a_call_is_out_the_answers_that_came_before_are_safe(
    study: Path, on_disk: OnDisk, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(workers, "SYNC_S", 0.01)
    safe = list[int]()

    class LastIsOut(Answering):
        async def ask(self, request: Request) -> Outcome:
            if request.about["item_id"] == "item-9":
                until = time.monotonic() + 30
                while len(on_disk()) < 9 and time.monotonic() < until:
                    await asyncio.sleep(0.02)
                safe.append(len(on_disk()))
            return await super().ask(request)

    ask(study, LastIsOut(), TEN)
    assert safe == [9]
