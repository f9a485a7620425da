"""In a study whose tables are not made yet each error names the stage to materialize; once the study was run, the same
calls succeed. And what its exports, imports and files say to do lets them go on."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from tests.conftest import EXPERIMENT, Checkout, copied
from tests.remedies.remedied import refused
from traps_pipeline.base.partitions import Cell
from traps_pipeline.benchmark.items import build_items
from traps_pipeline.benchmark.tables import ITEMS
from traps_pipeline.defs import judging, report, scoring
from traps_pipeline.explorer.annotate import Annotation
from traps_pipeline.explorer.answers import study_items
from traps_pipeline.explorer.review import Review
from traps_pipeline.models.answers import wanted_questions
from traps_pipeline.orchestration.lineage import Lineage
from traps_pipeline.release.content import content_of
from traps_pipeline.scenes.clips import read_clip
from traps_pipeline.scenes.encode import DamagedClip
from traps_pipeline.storage.workspace import Workspace
from traps_pipeline.study import exchange
from traps_pipeline.study.canary import canary_items
from traps_pipeline.study.exchange import export_requests
from traps_pipeline.study.experiment import Experiment, load_experiment

pytestmark = pytest.mark.slow
CELL = Cell.parse("occlusion|oracle__standard__run1")


def test_once_a_study_was_run_all_that_wanted_its_tables_has_them(small: Checkout, tmp_path: Path) -> None:
    study = copied(small, tmp_path)
    shutil.rmtree(study.workspace / "tables")
    (study.workspace / "tables").mkdir()
    workspace = Workspace.open(study.workspace)
    experiment = load_experiment(str(study.root / EXPERIMENT))
    cards = {**{name: partial(make, workspace) for name, make in FILES.items()}}
    again: list[Callable[[], Any]] = [
        refused(
            lambda: build_items(workspace, "occlusion"), "no scene_specs yet; materialize scene_specs and videos first"
        ),
        refused(
            lambda: wanted_questions(workspace, CELL), "not made yet; materialize scene_specs, videos and items first"
        ),
        refused(cards["sheet"], "contact_sheet: no items yet; materialize items first"),
        refused(cards["gallery"], "gallery: no clips yet; materialize videos first"),
        refused(cards["shortcuts"], "shortcuts: no items yet; materialize items first"),
        refused(
            lambda: scoring._make_metrics(workspace, "occlusion"),
            "no verdicts yet; materialize verdicts for a cell of this dataset first",
        ),
        refused(
            lambda: scoring._scored(workspace, "contrasts"), "no metrics yet; materialize metrics for a dataset first"
        ),
        refused(
            lambda: scoring._make_robust(workspace, None),
            "robust: no verdicts yet; materialize verdicts for a cell first",
        ),
        refused(lambda: judging._votes(workspace, "agreement"), "no votes yet; materialize votes for a cell first"),
        refused(lambda: Annotation(workspace), "has no clips yet; run `traps run EXPERIMENT` in it first"),
        refused(lambda: study_items(workspace), "has no items yet; run `traps run EXPERIMENT` in it first"),
        refused(lambda: Review(workspace, "jd").specs, "has no scenes yet; run `traps run EXPERIMENT` in it first"),
        refused(lambda: canary_items(workspace), "canary: no items yet; materialize items first"),
        refused(
            lambda: export_requests(workspace, experiment, tmp_path / "out"),
            "no items yet; materialize scene_specs, videos and items first",
        ),
        refused(lambda: content_of(workspace), "no pairs to release; make items first (traps run ... --until items)"),
        refused(
            may_be_made(workspace, "verdicts"),
            "is not made; materialize {} for this partition first",
            error=AssertionError,
        ),
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
        refused(
            lambda: list(exchange._wanted_votes(workspace, experiment)),
            "no answers yet; make responses first (traps run ... --until responses)",
        ),
        refused(
            lambda: build_items(workspace, "occlusion"),
            "is not the clip that was rendered ({} of {} bytes; truncated or altered); delete it and run again: it is",
        ),
        refused(lambda: content_of(workspace), "is missing or not the clip of its item; materialize videos again"),
        refused(
            lambda: read_clip(note.with_suffix(".mp4")),
            "scenes/clips.py | is not what was written ({}); delete it and run again",
            error=DamagedClip,
        ),
    ]
    clip.unlink()
    note.unlink()
    items = workspace.tables.path(ITEMS, {"dataset": "occlusion"})
    items.write_bytes(items.read_bytes()[:-200])
    made = may_be_made(workspace, "responses")
    return [*calls, refused(made, "is damaged: {}; materialize {} for it again", error=AssertionError)]


FILES = {"sheet": report._sheet, "gallery": report._gallery, "shortcuts": report._shortcuts}


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
