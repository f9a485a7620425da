"""Two-lane scenes of a pocket model: drawn beside the released ones, and named by what their clips show."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from tools.pocket.batches import NAMED
from tools.pocket.data import ShardJob, params_digest, shard_jobs
from tools.pocket.lane_evaluation import LaneFigures, evaluate
from tools.pocket.lanes import LaneScene, LaneScenes, draw_shard, released_digests
from tools.pocket.recipe import LANES as FOLDER
from tools.pocket.recipe import NO_GAP, Recipe, load_recipe
from tools.pocket.seeds import read_seeds
from tools.pocket.words import ABSTENTION, ANSWER, COLUMNS, ROWS
from traps_pipeline.benchmark.records import two_events_lines
from traps_pipeline.models.registry.entries import get_model
from traps_pipeline.protocol.two_events import CLIPS, LANES
from traps_pipeline.scenes.physics.kit import params_to_dict

pytestmark = pytest.mark.slow
FEW, UNSEEN = 2, 8  # scenes


@pytest.fixture(scope="module")
def recipe() -> Recipe:
    shipped = load_recipe(FOLDER / "recipe.yaml")
    return shipped.model_copy(update={"scenes": {"drop_split": FEW}, "held_out": 1})


@pytest.fixture(scope="module")
def data(recipe: Recipe, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("lanes")
    for split in ("train", "held-out"):
        for job in shard_jobs(recipe, split, folder):
            draw_shard(job)
    return folder


def events(job: ShardJob) -> list[str]:
    return [event for line in job.lines.read_text().splitlines() for event in LaneScene.read(line).digests]


def test_a_released_event_is_never_trained_on(recipe: Recipe, data: Path, tmp_path: Path) -> None:
    ((job,), (unseen,)) = (shard_jobs(recipe, split, data) for split in ("train", "held-out"))
    assert len({*events(job)} | {*events(unseen)}) == 2 * (FEW + 1)
    assert not released_digests() & {*events(job), *events(unseen)}
    spec = two_events_lines()["drop_split-e001"].spec
    ours = [params_digest(spec.family, params_to_dict(event.params)) for event in spec.world().events]
    assert released_digests().issuperset(ours)  # so a released event would be known
    banned = dataclasses.replace(job, folder=tmp_path, banned=frozenset(events(job)[1:2]))
    draw_shard(banned)  # as if the first scene's right lane were released: the draw goes on to another scene
    assert not {*events(job)[:2]} & {*events(banned)} and {*events(job)[2:]} <= {*events(banned)}


def test_each_clip_is_named_by_what_its_lanes_show(recipe: Recipe, data: Path) -> None:
    """Halves of the picture are the same in all clips that hide the lane alike, and differ elsewhere where they are
    open; names say so."""
    scenes, clips = LaneScenes(recipe, data), [*CLIPS.values()]
    frames = np.stack([scenes.frames(0, side) for side in range(len(clips))]).astype(int)
    record, half = scenes.records[0], frames.shape[3] // 2
    rows, columns = (length // 16 for length in frames.shape[2:4])
    for lane, part in enumerate((slice(0, half), slice(half, None))):
        seen = {hidden: frames[[c[lane] for c in clips].index(hidden)][:, :, part] for hidden in (False, True)}
        differs = np.array([(np.abs(a - b) > 40).any() for a, b in zip(seen[False], seen[True], strict=True)])
        assert differs[np.array(record.open[lane])].all() and any(record.settled[lane])
        for side, hidden in enumerate(clips):
            assert np.array_equal(frames[side][:, :, part], seen[hidden[lane]])
            names = scenes.names(0, side).reshape(-1, rows, columns, len(NAMED) + len(COLUMNS) + len(ROWS) + 4)[
                :, 0, lane * (columns - 1)
            ]
            words = dict(zip(scenes.words, names[:, -4:].T.astype(bool), strict=True))
            is_open = [any(pair) for pair in zip(record.open[lane][::2], record.open[lane][1::2], strict=True)]
            assert words[ABSTENTION if hidden[lane] else ANSWER].tolist() == is_open
            assert not words[ANSWER if hidden[lane] else ABSTENTION].any()
            assert words[record.answers[lane]].any() == (not hidden[lane])


def test_the_asked_lane_alone_decides_what_is_said(recipe: Recipe, data: Path) -> None:
    scenes, rng, seen = LaneScenes(recipe, data), np.random.default_rng(0), set[tuple[str, bool]]()
    for look in (scenes.look(rng, 0.7) for _ in range(60)):
        record, hidden = scenes.records[look.scene], [*CLIPS.values()][look.side]
        for lane, name in enumerate(LANES):
            (asked,) = (each for each in look.questions if each.question == record.questions[lane])
            assert f"the {record.strips[lane]} strip, not on its grey bench: " in asked.question
            label = scenes.label(look, asked, "vqa_guided")
            assert label == (None if hidden[lane] else record.answers[lane])
            seen.add((name, hidden[lane]))
    assert len(seen) == 4


@pytest.mark.parametrize(("name", "holds"), [("pocket-lanes", True), (NO_GAP, False)])
def test_one_shipped_model_holds_which_event_is_asked_and_hidden_and_another_does_not(
    name: str, holds: bool, recipe: Recipe, tmp_path: Path
) -> None:
    """Scenes of no seed that it was trained on; at the last layer, a probe fitted on other scenes."""
    entry = get_model(name)
    unseen = recipe.model_copy(update={"held_out": UNSEEN, "data_seed": 9, "media": entry.media})
    (job,) = shard_jobs(unseen, "held-out", tmp_path)
    draw_shard(job)
    *_, last = evaluate(entry, LaneScenes(unseen, tmp_path, "held-out"), 1, weights=(None,))
    assert last.n_clips == 2 * UNSEEN and (last.within > 0.8) == holds
    assert (last.abstained > 0.8) == holds
    measured = [row for row in read_seeds(FOLDER / "interaction.csv", LaneFigures) if row.held_out == "families"]
    within = {(row.weights, row.layer): row.within for row in measured}
    assert within["model", last.layer] > 0.8 > max(within[weights, last.layer] for weights in ("random_0", "random_1"))
