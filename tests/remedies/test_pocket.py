"""What errors about the pocket model's scenes, weights and tables say to do lets the same call succeed."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from pydantic import ValidationError

from tests.pocket.test_card import examined_study
from tests.pocket.test_pocket import FEW, _one_thread, data, recipe
from tests.remedies.remedied import remedied
from traps_pipeline.mechanism.tables import HIDDEN_STATES
from traps_pipeline.pocket import commands, inside
from traps_pipeline.pocket.commands import CARD, EVALUATION, WEIGHTS, write_card
from traps_pipeline.pocket.data import read_shards, render
from traps_pipeline.pocket.evaluate import read_cells, write_cells
from traps_pipeline.pocket.recipe import Recipe
from traps_pipeline.pocket.words import PROMPTS

pytestmark = pytest.mark.slow
__all__ = ["_one_thread", "data", "recipe"]  # fixtures


@pytest.mark.parametrize("elsewhere", [True, False])
def test_scenes_of_another_recipe_are_drawn_in_another_folder_or_once_it_is_deleted(
    recipe: Recipe, tmp_path: Path, elsewhere: bool
) -> None:
    none = recipe.model_copy(update={"scenes": {"drop_split": 0}})
    other = none.model_copy(update={"abstain_share": 0.4})
    folder = tmp_path / "scenes"
    folder.mkdir()
    render(none, "train", folder)
    if elsewhere:
        remedied(
            lambda: render(other, "train", folder),
            "holds scenes of another recipe; give another folder, or delete it",
            again=lambda: render(other, "train", tmp_path),
        )
    else:
        remedied(
            lambda: render(other, "train", folder),
            "holds scenes of another recipe; give another folder, or delete it",
            lambda: (shutil.rmtree(folder), folder.mkdir()),
        )


def test_a_recipe_has_one_kind_of_share(recipe: Recipe) -> None:
    both = recipe.model_dump() | {"abstain_share": 0.4, "abstain_shares": dict.fromkeys(PROMPTS, 0.4)}
    for neither in ("abstain_share", "abstain_shares"):
        remedied(
            lambda: Recipe.model_validate(both),
            "give abstain_share (one for all prompts) or abstain_shares (by prompt), and not both",
            again=lambda neither=neither: Recipe.model_validate(both | {neither: None}),
            error=ValidationError,
        )


def test_scenes_that_are_missing_are_read_once_they_are_rendered(recipe: Recipe, data: Path, tmp_path: Path) -> None:
    folder = Path(shutil.copytree(data, tmp_path / "scenes"))
    next(folder.rglob("*.jsonl")).unlink()

    def read() -> int:
        return sum(len(records) for split in ("train", "held-out") for _, records in read_shards(recipe, split, folder))

    def rendered() -> None:
        for split in ("train", "held-out"):
            render(recipe, split, folder, workers=1)

    assert remedied(read, "has {} of {} scenes; run `traps pocket render --data {}`", rendered) == FEW + 1


def test_training_of_another_seed_goes_to_another_folder(recipe: Recipe, data: Path, tmp_path: Path) -> None:
    from traps_pipeline.pocket.train import train

    train(recipe, data, tmp_path / "one", 1, stop_after=1)
    remedied(
        lambda: train(recipe, data, tmp_path / "one", 2, stop_after=1),
        "belongs to another recipe, data or seed; give another folder, or delete it",
        again=lambda: train(recipe, data, tmp_path / "two", 2, stop_after=1),
    )


def test_figures_are_of_a_workspace_of_one_seed_with_its_weights(tmp_path: Path) -> None:
    workspace = examined_study(tmp_path, 3, 1.0, 0.5)
    rows = workspace.tables.read_all(HIDDEN_STATES)
    other = rows.assign(dataset="occlusion", checkpoint="another")
    columns = {"model": str(rows["model"][0]), "prompt": "standard"}
    workspace.tables.write(HIDDEN_STATES, {"dataset": "occlusion", **columns}, other, {})
    alone = tmp_path / "alone"
    alone.mkdir()
    remedied(
        lambda: inside.figures_of(workspace),
        "run `traps run mechanism` in a workspace of its own for each seed",
        again=lambda: inside.figures_of(examined_study(alone, 3, 1.0, 0.5)),
    )
    weights = alone / "seed3" / WEIGHTS / "model.safetensors"
    weights.write_bytes(b"others")
    afresh = tmp_path / "afresh"
    afresh.mkdir()
    remedied(
        lambda: inside.figures_of(inside.Workspace.open(alone / "inside3")),
        "or none; run `traps run mechanism` again with the weights of the seed",
        again=lambda: inside.figures_of(examined_study(afresh, 3, 1.0, 0.5)),
    )


def test_a_table_of_figures_is_read_once_it_is_written_again(tmp_path: Path) -> None:
    path = tmp_path / "mechanism.csv"
    path.write_text("seed\nthree\n")

    def written() -> None:
        path.unlink()
        inside.write_figures(path, inside.figures_of(examined_study(tmp_path, 3, 1.0, 0.5)))

    figures = remedied(
        lambda: inside.read_figures(path),
        "is not a table of `traps pocket card --mechanism` ({}); write it again from the workspaces",
        written,
    )
    assert {figure.seed for figure in figures} == {3}


def test_a_table_of_counts_is_read_once_it_is_that_of_an_evaluation(tmp_path: Path) -> None:
    path = tmp_path / "evaluation.csv"
    path.write_text("seed\nthree\n")
    whole = read_cells(EVALUATION)

    def evaluated() -> None:
        path.unlink()
        write_cells(path, whole)

    cells = remedied(
        lambda: read_cells(path), "is not a table of `traps pocket evaluate` ({}); run it again", evaluated
    )
    assert cells == whole


def test_a_card_is_written_once_its_comments_are_restored(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    card = tmp_path / "README.md"
    card.write_text("no comments")
    monkeypatch.setattr(commands, "CARD", card)
    tables = remedied(
        lambda: write_card(EVALUATION, []),
        "lacks the comments around a table ({}, {}); restore it from git",
        lambda: shutil.copy(CARD, card),
    )
    assert card.read_text() == CARD.read_text() and len(tables) == 2
