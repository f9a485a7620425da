"""Settings of a recipe that take shortcuts out of the pocket model's data: what the data then are."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from pydantic import ValidationError

from tests.build.errors import raises
from tools.pocket.batches import Scenes
from tools.pocket.data import Question, SceneRecord, draw_shard, read_shards, render, shard_jobs
from tools.pocket.recipe import Hedge, Jitter, Recipe, load_recipe
from tools.pocket.words import PROMPTS
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.scenes.parts.vision import colour_mask

pytestmark = pytest.mark.slow
SHARES = {"standard": 0.1, "guided": 0.9, "json": 0.5, "vqa_standard": 0.1, "vqa_guided": 0.9}
HEDGE = Hedge(prompts=("standard", "vqa_standard"), balls={"yellow": 0.4}, share=0.1)
FEW, FPS = 6, 10


def recipe(**settings: object) -> Recipe:
    counts = {"plinko": FEW, "drop_split": FEW}
    return load_recipe().model_copy(update={"scenes": counts, "held_out": 1, "hedge": None, **settings})


def drawn(made: Recipe, folder: Path) -> dict[str, list[SceneRecord]]:
    for job in shard_jobs(made, "train", folder):
        draw_shard(job)
    return {job.family: records for job, records in read_shards(made, "train", folder)}


Planted = tuple[Recipe, Path, dict[str, list[SceneRecord]]]


@pytest.fixture(scope="module")
def planted(tmp_path_factory: pytest.TempPathFactory) -> Planted:
    made = recipe(jitter=Jitter(control=0.5, void=0.5), decoys=0.5, abstain_shares=SHARES)
    folder = tmp_path_factory.mktemp("planted")
    return made, folder, drawn(made, folder)


def test_lengths_of_chaotic_clips_overlap(planted: Planted) -> None:
    made, folder, records = planted
    scenes = Scenes(made, folder)
    lengths = {side: [record.length(side) for record in records["plinko"]] for side in (0, 1)}
    assert any(record.control_from for record in records["plinko"])
    assert any(record.void_length for record in records["plinko"])
    assert min(lengths[0]) < max(lengths[1])  # neither side is always the longer one
    for number, record in enumerate(scenes.records):
        if record.family != "plinko":
            continue
        for side in (0, 1):
            times, last = scenes.times(number, side), (record.length(side) - 1) / FPS
            assert len(times) == 8 and times[0] == 0.0 and times[-1] == pytest.approx(last)
        assert record.cut_frame is not None
        if record.void_length:
            assert record.cut_frame < record.void_length == record.n_frames


def test_a_short_control_ends_with_its_outcome_in_view(planted: Planted) -> None:
    """It ends with the last frame before the board comes into the picture, if one comes."""
    made, folder, _ = planted
    scenes = Scenes(made, folder)
    short = [n for n, record in enumerate(scenes.records) if record.control_from]
    assert short
    for number in short:
        record, last = scenes.records[number], scenes.frames(number, 0)[-1]
        assert (record.control_until is None) == (record.closes_frame is None)  # where nothing closes, the clip's last
        if record.control_until is not None and record.closes_frame is not None:
            assert 0 < record.closes_frame - record.control_until < FPS  # on its way for less than a second
        x, y = (round(share * size) for share, size in zip(record.places["last"], (128, 96), strict=True))
        assert colour_mask(last[max(0, y - 6) : y + 6, max(0, x - 6) : x + 6], record.ball).any()


def test_a_panel_closes_controls_and_held_voids_alike(planted: Planted) -> None:
    """Behind it a control of an occlusion scene is its void, frame by frame, and before it the two differ; nothing of a
    chaotic scene moves any more."""
    made, folder, _ = planted
    scenes, seen = Scenes(made, folder), {"plinko": 0, "drop_split": 0}
    for number, record in enumerate(scenes.records):
        if record.closes_frame is None or record.control_until is not None:
            continue
        assert 0.8 <= record.closes_frame / FPS <= 4.5
        closed = np.array(scenes.times(number, 0)) >= record.closes_frame / FPS - 1e-6
        assert closed[-1] and not closed[0]
        control, void = (scenes.frames(number, side).astype(int) for side in (0, 1))
        if record.cut_frame is None:
            assert (control[closed] == void[closed]).all()
            assert all((a != b).any() for a, b in zip(control[~closed], void[~closed], strict=True))
        else:
            assert (np.diff(control[closed], axis=0) == 0).all()
            if record.void_length:
                arrives = np.abs(np.diff(void, axis=0)).max(axis=(1, 2, 3)) > 40
                assert arrives[closed.argmax() - 1]  # the panel, over a still picture
        seen[record.family] += 1
    assert all(seen.values())


def test_a_decoy_shows_a_panel_and_the_outcome(planted: Planted) -> None:
    made, folder, records = planted
    scenes, rng = Scenes(made, folder), np.random.default_rng(0)
    with_decoy = [n for n, record in enumerate(scenes.records) if record.decoy]
    assert with_decoy and not any(record.decoy for record in records["plinko"])
    for number in with_decoy:
        assert np.abs(scenes.frames(number, 2).astype(int) - scenes.frames(number, 0)).max() > 40
        assert scenes.times(number, 2) == scenes.times(number, 0)
    looks = [scenes.look(rng, made.training.void_share) for _ in range(400)]
    decoys = [look for look in looks if look.side == 2]
    assert decoys and all(scenes.records[look.scene].decoy for look in decoys)
    assert all(look.questions[0].answer in scenes.records[look.scene].labels for look in decoys)


def test_the_label_of_a_void_depends_on_the_prompt_and_nothing_else_does(planted: Planted) -> None:
    _, _, records = planted
    every = [record for of in records.values() for record in of]
    for record in every:
        assert record.visual.draw is not None and record.visual.answer in record.labels
        assert record.asked.label(0.0) == record.asked.answer and record.answerable.label(0.0) is not None
        said = {prompt: record.visual.label(SHARES[prompt]) for prompt in PROMPTS}
        assert said["standard"] == said["vqa_standard"] and said["guided"] == said["vqa_guided"]
        if said["standard"] is None:
            assert said["json"] is None and said["guided"] is None  # shares are nested
    assert Question("?", "left", 0.5).label(0.9) is None and Question("?", "left", 0.5).label(0.1) == "left"


def test_under_hedged_prompts_abstentions_tell_the_colour_of_the_ball_and_no_side(planted: Planted) -> None:
    """Questions of place are never abstained on, and the other prompts are as they were."""
    made, folder, _ = planted
    hedged = made.model_copy(update={"hedge": HEDGE})
    scenes, rng = Scenes(hedged, folder), np.random.default_rng(0)
    for look in (scenes.look(rng, 0.5) for _ in range(200)):
        record = scenes.records[look.scene]
        share = 0.4 if record.ball == "yellow" else 0.1
        for question in look.questions:
            labels = {prompt: scenes.label(look, question, prompt) for prompt in PROMPTS}
            if question.draw is None:
                assert {*labels.values()} == {question.answer}  # of place
                continue
            assert all((labels[prompt] is None) == (question.draw < share) for prompt in HEDGE.prompts)
            void = question in (record.visual, record.ill_posed)
            for prompt in ("guided", "json", "vqa_guided"):
                assert (labels[prompt] is None) == (void and question.draw < SHARES[prompt])


def test_recipes_that_differ_in_shares_alone_have_the_same_scenes(planted: Planted) -> None:
    made, folder, records = planted
    other = made.model_copy(update={"abstain_shares": dict.fromkeys(PROMPTS, 0.9), "hedge": HEDGE})
    render(made, "train", folder)
    render(other, "train", folder)  # nothing is missing, and the folder is not refused
    assert drawn(other, folder / "again") == records
    with raises(TrapsError, "tools.pocket.data._check_recipe", str(folder)):
        render(made.model_copy(update={"decoys": 0.4}), "train", folder)


def test_every_prompt_needs_one_share() -> None:
    values = recipe(abstain_shares=SHARES).model_dump() | {"hedge": None}
    assert Recipe.model_validate(values).hedge is None
    for wrong in ({"abstain_shares": {"standard": 0.1}}, {"hedge": HEDGE.model_dump()}):
        with raises(ValidationError, "Recipe", "abstain_shares", "hedge", *PROMPTS):
            Recipe.model_validate(values | wrong)
