"""In a study whose tables are not made yet each error names the stage to materialize; once the study was run, the same
calls succeed. And what its exports, imports and files say to do lets them go on."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from tests.conftest import EXPERIMENT, Checkout, copied
from tests.remedies.remedied import refused
from traps_pipeline.benchmark.items import build_items
from traps_pipeline.checks.canary import canary_items
from traps_pipeline.exchange import answer_exchange
from traps_pipeline.exchange.answer_exchange import export_requests
from traps_pipeline.models.asking.answers import wanted_questions
from traps_pipeline.pipeline.experiment import Experiment, load_experiment
from traps_pipeline.pipeline.lineage import Lineage
from traps_pipeline.pipeline.stages import judging_stages, scoring_stages
from traps_pipeline.protocol.cells import Cell
from traps_pipeline.release.content import content_of
from traps_pipeline.report.explorer.answer_shards import study_items
from traps_pipeline.scenes.worlds.clip_notes import read_clip
from traps_pipeline.servers.annotate import Annotation
from traps_pipeline.servers.review import Review
from traps_pipeline.storage.benchmark_tables import ITEMS
from traps_pipeline.storage.workspace import Workspace
from traps_pipeline.video.encode import DamagedClip

pytestmark = pytest.mark.slow
CELL = Cell.parse("occlusion|oracle__standard__run1")


def test_once_a_study_was_run_all_that_wanted_its_tables_has_them(small: Checkout, tmp_path: Path) -> None:
    study = copied(small, tmp_path)
    shutil.rmtree(study.workspace / "tables")
    (study.workspace / "tables").mkdir()
    workspace = Workspace.open(study.workspace)
    experiment = load_experiment(str(study.root / EXPERIMENT))
    again: list[Callable[[], Any]] = [
        refused(lambda: build_items(workspace, "occlusion"), "benchmark.items.build_items"),
        refused(lambda: wanted_questions(workspace, CELL), "models.asking.answers.wanted_questions"),
        refused(lambda: scoring_stages.metrics.make(workspace, "occlusion"), "pipeline.stages.scoring_stages"),
        refused(lambda: scoring_stages._metrics_and_verdicts(workspace, "contrasts"), "pipeline.stages.scoring_stages"),
        refused(lambda: judging_stages._votes(workspace, "agreement"), "pipeline.stages.judging_stages"),
        refused(lambda: Annotation(workspace), "servers.annotate"),
        refused(lambda: study_items(workspace), "report.explorer.answer_shards.study_items"),
        refused(lambda: Review(workspace, "jd").specs, "servers.review.Review.specs"),
        refused(lambda: canary_items(workspace), "checks.canary.canary_items"),
        refused(lambda: export_requests(workspace, experiment, tmp_path / "out"), "exchange.answer_exchange"),
        refused(lambda: content_of(workspace), "release.content.content_of"),
        refused(may_be_made(workspace, "verdicts"), "", error=AssertionError),
    ]
    finished = study.traps("run", EXPERIMENT, "--until", "items")
    assert finished.code == 0, finished.err
    again += damaged(workspace, experiment)
    finished = study.traps("run", EXPERIMENT, "--until", "leaderboard")
    assert finished.code == 0, finished.err
    assert finished.counts() == {"answers": 0, "votes": 0, "frames": 100}
    for call in again:
        call()


def damaged(workspace: Workspace, experiment: Experiment) -> list[Callable[[], Any]]:
    """What no longer succeeds in a study with items and without answers, of which a table, a clip and the note of
    another clip are damaged; what the errors say to delete is deleted."""
    clips = workspace.root / "clips" / "hidden_race-0001"
    clip, note = next(clips.glob("void-*.mp4")), next(clips.glob("control-*.json"))
    clip.write_bytes(clip.read_bytes()[: clip.stat().st_size // 2])
    edited(note, "1", "2")
    calls = [
        refused(lambda: list(answer_exchange._wanted_votes(workspace, experiment)), "exchange.answer_exchange"),
        refused(lambda: build_items(workspace, "occlusion"), "benchmark.items"),
        refused(lambda: content_of(workspace), "release.content.content_of"),
        refused(lambda: read_clip(note.with_suffix(".mp4")), "scenes.worlds.clip_notes.read_note", error=DamagedClip),
    ]
    clip.unlink()
    note.unlink()
    items = workspace.tables.path(ITEMS, {"dataset": "occlusion"})
    items.write_bytes(items.read_bytes()[:-200])
    made = may_be_made(workspace, "responses")
    return [*calls, refused(made, "", error=AssertionError)]


def may_be_made(workspace: Workspace, stage: str) -> Callable[[], None]:
    """That nothing keeps the stage of the cell from being made."""

    def call() -> None:
        why = Lineage(workspace).blocked(stage, CELL.key, current=False)
        assert not why, why

    return call


def edited(path: Path, old: str, new: str) -> Path:
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))
    return path
