"""The pocket model's card: what it claims is what its tables have, over training seeds."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tests.mechanism.study import filled
from tools.pocket import inside
from tools.pocket.claims import markdown
from tools.pocket.commands import CARD, EVALUATION, FACTS, WEIGHTS, card_tables, marks, other_tables
from tools.pocket.evaluate import AnswerCounts
from tools.pocket.recipe import GAP, SHIPPED, load_recipe
from tools.pocket.seeds import Figure, read_seeds, write_seeds
from tools.pocket.words import PROMPTS
from traps_pipeline.mechanism.control_rows import PATCHING
from traps_pipeline.mechanism.mechanism_rows import HIDDEN_STATES
from traps_pipeline.models.registry.checkpoint import folder_digest
from traps_pipeline.storage.study import Study
from traps_pipeline.storage.workspace import Workspace

pytestmark = pytest.mark.slow


def in_card(table: str) -> str:
    begin, end = marks(table)
    return CARD.read_text().partition(begin)[2].partition(end)[0].strip()


def test_the_card_shows_the_shipped_figures() -> None:
    tables = card_tables()
    assert {name: in_card(name) for name in tables} == tables
    assert {*tables} == {"contrast"}
    assert all(table.count("\n|") > 8 for table in other_tables())


@pytest.mark.parametrize("folder", SHIPPED.values(), ids=[*SHIPPED])
def test_every_family_is_counted_under_every_regime(folder: Path) -> None:
    cells, recipe = read_seeds(folder / EVALUATION, AnswerCounts), load_recipe(folder / "recipe.yaml")
    assert {(cell.family, cell.regime) for cell in cells} == {
        (family, regime) for family in recipe.scenes for regime in ("standard", "guided", "json")
    }
    assert {cell.n for cell in cells} == {recipe.held_out}


def test_the_two_recipes_differ_in_shares_alone() -> None:
    gap, no_gap = (load_recipe(folder / "recipe.yaml") for folder in SHIPPED.values())
    fields = type(gap).model_fields
    assert {name for name in fields if getattr(gap, name) != getattr(no_gap, name)} == {"abstain_shares", "hedge"}
    assert gap.hedge is not None and no_gap.hedge is None
    for prompt in PROMPTS:
        for ball in ("red", "green"):
            void, control = (gap.share(prompt, ball, void=side) for side in (True, False))
            if prompt in gap.hedge.prompts:
                assert void == control < 0.5  # abstentions tell no side, and are never the answer
            else:
                assert void == no_gap.share(prompt, ball, void=True) and control == 0


# --- what was found inside, over seeds --------------------------------------------------------------------------------


def examined_study(root: Path, seed: int, differ: int) -> Workspace:
    """A finished workspace of one seed: its weights with their facts, and patches of four pairs, of which the sides of
    so many differ in sign."""
    weights = root / f"seed{seed}" / WEIGHTS
    weights.mkdir(parents=True)
    (weights / "model.safetensors").write_bytes(bytes([seed]))
    (weights.parent / FACTS).write_text(json.dumps({"seed": seed, "weights": f"{seed}" * 64}))
    workspace, extraction = Workspace.create(root / f"inside{seed}", Study()), {"model": GAP, "prompt": "guided"}
    states = filled(HIDDEN_STATES, dataset="chaotic", **extraction, checkpoint=str(weights),
                    checkpoint_digest=folder_digest(weights))  # fmt: skip
    workspace.tables.write(HIDDEN_STATES, {"dataset": "chaotic", **extraction}, [states], {})
    patched = filled(PATCHING, **extraction, dataset="chaotic", source="pair", n=4, n_flippable=differ)
    workspace.tables.write(PATCHING, extraction, [patched], {})
    return workspace


def test_the_card_over_seeds_is_made_from_their_finished_workspaces(tmp_path: Path) -> None:
    table = tmp_path / "mechanism.csv"
    for seed, differ in ((2, 3), (1, 4)):
        made = examined_study(tmp_path, seed, differ)
        write_seeds(table, inside.figures_of(made))
        write_seeds(table, inside.figures_of(made))  # the same seed again takes its own place
    found = read_seeds(table, Figure)
    assert found == [
        Figure(1, "1" * 12, "differ", "model", 1.0), Figure(2, "2" * 12, "differ", "model", 0.75),
    ]  # fmt: skip
    *_, row = markdown(found, found[:1]).splitlines()
    assert row.endswith(" ≥ 0.5 | 1.00, 0.75 | 1.00 | holds in pocket, no gap too |")
