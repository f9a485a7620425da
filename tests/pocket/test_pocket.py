"""The pocket model: its training data, training that continues bit for bit, and the files that ship with it."""

from __future__ import annotations

import dataclasses
import json
import shutil
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from tests.build.errors import raises
from tools.pocket.__main__ import build_parser
from tools.pocket.commands import CARD, FACTS, MECHANISM, WEIGHTS
from tools.pocket.data import STREAM, SceneRecord, ShardJob, draw_shard, released_digests, shard_jobs
from tools.pocket.evaluate import AnswerCounts, markdown
from tools.pocket.recipe import GAP, LANES, POCKET, SHIPPED, Recipe, load_recipe
from tools.pocket.seeds import read_seeds
from tools.pocket.words import PROMPTS, say
from traps_pipeline.base.digests import digest, file_digest
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.cli import main
from traps_pipeline.judging.rules import ABSTENTION, Statement, read_statement
from traps_pipeline.models.reading.judged_answers import normalise
from traps_pipeline.models.registry.prompts import system_prompt
from traps_pipeline.storage.media import pick_frames

pytestmark = pytest.mark.slow

FEW = 2  # scenes


@pytest.fixture(autouse=True, scope="module")
def _one_thread() -> Iterator[None]:
    """Two threads beside other tests only wait for each other."""
    import torch

    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.fixture(scope="module")
def recipe() -> Recipe:
    """The shipped recipe with two scenes of one family, and three steps."""
    shipped = load_recipe()
    training = shipped.training.model_copy(update={"steps": 3, "batch": 2, "naming_steps": 1})
    return shipped.model_copy(update={"scenes": {"drop_split": FEW}, "held_out": 1, "training": training})


@pytest.fixture(scope="module")
def data(recipe: Recipe, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("scenes")
    for split in ("train", "held-out"):
        for job in shard_jobs(recipe, split, folder):
            draw_shard(job)
    return folder


def _records(job: ShardJob) -> list[SceneRecord]:
    return [SceneRecord.read(line) for line in job.lines.read_text().splitlines()]


# --- scenes -----------------------------------------------------------------------------------------------------------


def test_a_released_scene_is_never_trained_on(recipe: Recipe, data: Path, tmp_path: Path) -> None:
    (job,) = shard_jobs(recipe, "train", data)
    drawn = _records(job)
    assert not {scene.params_digest for scene in drawn} & released_digests()
    banned = dataclasses.replace(job, folder=tmp_path, banned=frozenset({drawn[0].params_digest}))
    draw_shard(banned)  # as if the first scene were released: the draw goes on to another one
    assert drawn[0].params_digest not in {scene.params_digest for scene in _records(banned)}


def test_frames_for_training_are_those_that_a_clip_gives(
    recipe: Recipe, data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The same scenes written as clips and read through the media path of every model: only H.264 lies between."""
    from tools.pocket.batches import Scenes

    (job,) = shard_jobs(recipe, "train", data)
    rendered = np.load(job.pixels)
    assert rendered.shape == (FEW, 3, 8, 96, 128, 3)  # control, void and decoy
    monkeypatch.setitem(STREAM, "held-out", STREAM["train"])
    as_clips = dataclasses.replace(job, split="held-out", folder=tmp_path, count=1)
    draw_shard(as_clips)
    for side, name in enumerate(("control", "void")):
        shown = pick_frames(as_clips.clip(0, name), recipe.media)
        assert shown.times_s.tolist() == pytest.approx(Scenes(recipe, data).times(0, side))
        off = np.abs(shown.frames.astype(int) - rendered[0, side])
        assert off.mean() < 3 and (off > 40).mean() < 0.005  # of 255: colours are halved in resolution


def test_other_numbers_of_scenes_draw_what_is_missing_and_read_what_is_wanted(
    recipe: Recipe, data: Path, tmp_path: Path
) -> None:
    from tools.pocket.batches import Scenes
    from tools.pocket.data import data_digest, read_shards, render

    fewer = recipe.model_copy(update={"scenes": {"drop_split": FEW - 1}})
    render(fewer, "train", tmp_path, workers=1)
    alone, whole = data_digest(fewer, "train", tmp_path), data_digest(recipe, "train", data)
    named = "`python -m tools.pocket render", f" {FEW - 1} ", f" {FEW} "
    with raises(TrapsError, "tools.pocket.data.read_shards", *named):
        list(read_shards(recipe, "train", tmp_path))
    render(recipe, "train", tmp_path, workers=1)  # more than before: the last shard is drawn again
    assert data_digest(recipe, "train", tmp_path) == whole
    render(fewer, "train", tmp_path, workers=1)  # fewer again: it stays, and its first scenes are read
    assert len(Scenes(fewer, tmp_path).records) == FEW - 1
    assert data_digest(fewer, "train", tmp_path) == alone != whole


@pytest.mark.parametrize("prompt_name", PROMPTS)
def test_what_it_is_taught_to_say_is_read_by_the_rule_judge(prompt_name: str) -> None:
    guesses = ("hollow", "solid", "before", "after", "a man", "a woman", "a child", "wood", "metal", "plastic")
    for answer in ("left", "elsewhere", "4", "0-1", "purple", "yes", *guesses, "the ball", "the wall", "the floor"):
        assert read_statement(say(answer, prompt_name)) == Statement(normalise(answer))
    assert read_statement(say(None, prompt_name)) == ABSTENTION
    if prompt_name == "json":
        assert set(json.loads(say("left", "json"))) == {"reason", "final_answer"}


# --- training ---------------------------------------------------------------------------------------------------------


def test_a_batch_gives_the_loss_of_plain_prompts_one_by_one(recipe: Recipe, data: Path) -> None:
    """Questions share a clip and a system prompt in training; the library's own path knows nothing of that."""
    import torch
    from torch.nn.functional import cross_entropy

    from tools.pocket.batches import Batches, Look, Scenes
    from tools.pocket.model import make_model, train_tokenizer
    from tools.pocket.train import answer_loss, attend_at_once, look_at

    scenes = Scenes(recipe, data)
    model, processor = make_model(train_tokenizer(scenes.records), seed=1)
    model.eval()
    record, frames = scenes.records[1], np.array(scenes.frames(1, 0))
    look = Look(1, 0, (record.asked, record.ill_posed))
    batch = Batches(scenes, model, processor, recipe.training, 1).make([look], "guided", frames[None])
    with torch.no_grad():
        found = answer_loss(model, look_at(model, batch), batch).item()
    expected = 0.0
    for question in look.questions:
        turns = [
            {"role": "system", "content": [{"type": "text", "text": system_prompt("guided")}]},
            {"role": "user", "content": [{"type": "video"}, {"type": "text", "text": question.question}]},
        ]
        text = processor.apply_chat_template(turns, add_generation_prompt=True)
        said = say(scenes.label(look, question, "guided"), "guided") + processor.tokenizer.eos_token
        indices = [round(1000 * time) for time in scenes.times(1, 0)]
        clock = {"fps": 1000.0, "frames_indices": indices, "total_num_frames": indices[-1] + 1}
        inputs = processor(
            text=[text + said], videos=[np.array(frames)], video_metadata=[clock], do_sample_frames=False,
            return_tensors="pt",
        )  # fmt: skip
        inputs.pop("video_metadata", None)
        length = len(processor.tokenizer(said)["input_ids"])
        with torch.no_grad():
            logits = model(**inputs).logits[0]
        expected += cross_entropy(logits[-length - 1 : -1], inputs["input_ids"][0, -length:], reduction="sum").item()
    assert found == pytest.approx(expected, rel=1e-5)
    attend_at_once(model)
    with torch.no_grad():
        assert answer_loss(model, look_at(model, batch), batch).item() == pytest.approx(found, rel=1e-6)


def test_training_that_was_stopped_goes_on_bit_for_bit(recipe: Recipe, data: Path, tmp_path: Path) -> None:
    from tools.pocket.train import train

    whole = train(recipe, data, tmp_path / "whole", 1)
    train(recipe, data, tmp_path / "stopped", 1, stop_after=1)
    assert not (tmp_path / "stopped" / WEIGHTS).exists()
    resumed = train(recipe, data, tmp_path / "stopped", 1)
    assert (whole / "model.safetensors").read_bytes() == (resumed / "model.safetensors").read_bytes()
    with raises(TrapsError, "tools.pocket.train._State.load", str(tmp_path / "stopped")):
        train(recipe, data, tmp_path / "stopped", 2)


# --- what ships -------------------------------------------------------------------------------------------------------


def test_all_that_ships_is_less_than_ten_megabytes() -> None:
    assert sum(file.stat().st_size for file in POCKET.rglob("*") if file.is_file()) < 10e6


@pytest.mark.parametrize("folder", [*SHIPPED.values(), LANES], ids=[*SHIPPED, "pocket-lanes"])
def test_shipped_weights_are_small_and_are_those_of_the_facts(folder: Path) -> None:
    from safetensors import safe_open

    weights, facts = folder / WEIGHTS / "model.safetensors", json.loads((folder / FACTS).read_text())
    with safe_open(weights, "np") as file:
        count = sum(int(np.prod(file.get_slice(name).get_shape())) for name in file.keys())  # noqa: SIM118
    assert count <= 3_000_000 and weights.stat().st_size <= 12 * 2**20
    assert file_digest(weights) == facts["weights"] and f"`{facts['weights']}`" in CARD.read_text()
    recipe = load_recipe(folder / "recipe.yaml")
    assert facts["recipe"] == digest(recipe.content()) and facts["seed"] == 1


def test_the_commands_draw_train_and_count_and_what_is_there_is_not_made_again(
    recipe: Recipe, data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    counts, scenes = tmp_path / "counts.csv", shutil.copytree(data, tmp_path / "scenes")
    (tmp_path / "recipe.yaml").write_text(json.dumps(recipe.content()))  # JSON is YAML
    given = ["--recipe", str(tmp_path / "recipe.yaml"), "--data", str(scenes), "--workers", "1"]
    before = {path: path.stat().st_mtime_ns for path in scenes.rglob("*") if path.is_file()}
    assert main(["render", *given], build_parser()) == 0
    seed = ["--out", str(tmp_path / "out"), "--seed", "3"]
    assert main(["train", *given, *seed], build_parser()) == 0
    assert main(["evaluate", *given, *seed, "--csv", str(counts)], build_parser()) == 0
    assert {path: path.stat().st_mtime_ns for path in before} == before
    facts = json.loads((tmp_path / "out" / FACTS).read_text())
    assert facts["weights"] == file_digest(tmp_path / "out" / WEIGHTS / "model.safetensors") and facts["seed"] == 3
    # A control, its void, its ill-posed question and one that the void answers too, under three prompts.
    cells = read_seeds(counts, AnswerCounts)
    assert sum(cell.n for cell in cells) == 12 and markdown(cells) in capsys.readouterr().out


def test_the_card_command_needs_the_figures_of_every_model(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(SHIPPED, GAP, tmp_path)
    assert main(["card"], build_parser()) == 1
    said = capsys.readouterr().err
    assert str(tmp_path / MECHANISM) in said and "`python -m tools.pocket card" in said
