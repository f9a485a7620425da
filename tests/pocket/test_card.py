"""The pocket model's card: what it claims is what its tables have, over training seeds."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from tools.pocket.planted import planted

from tests.mechanism.study import filled
from tools.pocket import inside
from tools.pocket.commands import CARD, EVALUATION, FACTS, WEIGHTS, card_tables, marks, other_tables
from tools.pocket.evaluate import read_cells
from tools.pocket.recipe import GAP, SHIPPED, load_recipe
from tools.pocket.words import PROMPTS
from traps_pipeline.judging.judging_rows import VERDICTS
from traps_pipeline.mechanism.control_rows import GATE, PATCHING, STEERING_NULLS
from traps_pipeline.mechanism.mechanism_rows import HIDDEN_STATES, PROBES, STEERING_SHARES
from traps_pipeline.models.local.checkpoint import folder_digest
from traps_pipeline.storage.study import Study
from traps_pipeline.storage.workspace import Workspace

pytestmark = pytest.mark.slow


def in_card(table: str) -> str:
    begin, end = marks(table)
    return CARD.read_text().partition(begin)[2].partition(end)[0].strip()


def test_the_card_shows_the_shipped_figures() -> None:
    tables = card_tables()
    assert {name: in_card(name) for name in tables} == tables
    assert {*tables} == {"contrast", "evaluation of pocket"}
    assert all(table.count("\n|") > 8 for table in other_tables())


@pytest.mark.parametrize("folder", SHIPPED.values(), ids=[*SHIPPED])
def test_every_family_is_counted_under_every_regime(folder: Path) -> None:
    cells, recipe = read_cells(folder / EVALUATION), load_recipe(folder / "recipe.yaml")
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


def examined_study(root: Path, seed: int, area: float, share: float) -> Workspace:
    """A finished workspace of one seed: its weights with their facts, and the tables that the card reads."""
    weights = root / f"seed{seed}" / WEIGHTS
    weights.mkdir(parents=True)
    (weights / "model.safetensors").write_bytes(bytes([seed]))
    (weights.parent / FACTS).write_text(json.dumps({"seed": seed, "weights": f"{seed}" * 64}))
    workspace, extraction = Workspace.create(root / f"inside{seed}", Study()), {"model": GAP, "prompt": "standard"}
    states = filled(HIDDEN_STATES, dataset="chaotic", **extraction, checkpoint=str(weights),
                    checkpoint_digest=folder_digest(weights))  # fmt: skip
    workspace.tables.write(HIDDEN_STATES, {"dataset": "chaotic", **extraction}, [states], {})
    common = {**extraction, "scope": "all", "source": "occlusion", "target": "chaotic"}
    probes = [
        filled(PROBES, **common, analysis="transfer", layer=layer, value=value, own_best=layer == 2,
               chosen=layer == 1)
        for layer, value in ((1, area - 0.1), (2, area))
    ]  # fmt: skip
    workspace.tables.write(PROBES, extraction, probes, {})
    shares = [
        filled(STEERING_SHARES, model=GAP, path_set="all", directions="all", regime=regime, kind="void", layer=3,
               alpha=alpha, side="void", abstention=value, low=value - 0.1, high=value + 0.2, n_answers=28,
               n_scenarios=10)
        for regime, alpha, value in (("all", 0.0, 0.75), ("all", 10.0, share), ("guided", 10.0, 0.01))
    ]  # fmt: skip
    workspace.tables.write(STEERING_SHARES, {}, shares, {})
    return workspace


def test_the_card_over_seeds_is_made_from_their_finished_workspaces(tmp_path: Path) -> None:
    table = tmp_path / "mechanism.csv"
    for seed, area, share in ((1, 1.0, 0.5), (2, 0.8, 0.25)):
        made = examined_study(tmp_path, seed, area, share)
        inside.write_figures(table, inside.figures_of(made))
        inside.write_figures(table, inside.figures_of(made))  # the same seed again takes its own place
    found = [figure for figure in inside.read_figures(table) if figure.figure != "claim"]
    assert [figure.seed for figure in found] == [1] * 4 + [2] * 4
    lines = inside.markdown(found).splitlines()
    assert not any("planted" in line for line in lines)  # the study has none of these figures
    assert "| Cross-domain | 0.900 (0.800-1.000) | 2 | 0.800 (0.700-0.900) | 1 |" in lines
    assert "| voids, void directions | 75.0 (75.0-75.0) | 37.5 (25.0-50.0) | 15.0-70.0 | 28 | 10 |" in lines
    assert lines[-1] == "Training seeds: 1, 2."


def test_what_was_planted_is_read_from_the_tables_of_the_controls(tmp_path: Path) -> None:
    workspace, at = examined_study(tmp_path, 4, 1.0, 0.5), {"model": GAP, "prompt": "standard"}
    effect = {"dataset": "chaotic", "source": "pair", "site": "residual", "group": "stamps"}
    patched = [
        filled(PATCHING, **at, **effect, into=into, layer=layer, effect=value)
        for into, layer, value in (("control", 0, 0.02), ("void", 0, 0.06), ("void", 1, 0.9))
    ]
    workspace.tables.write(PATCHING, at, patched, {})
    for dataset, regime, said in (
        ("chaotic", "standard", False),
        ("chaotic", "guided", True),
        ("decoy", "guided", False),
    ):
        part = {"dataset": dataset, "model": GAP, "regime": regime, "run": 1}
        side = "control" if dataset == "decoy" else "void"
        rows = [filled(VERDICTS, **part, item_id=f"{dataset}:{n}", side=side, abstained=said) for n in range(3)]
        workspace.tables.write(VERDICTS, part, rows, {})
    gated = {"features": "states", "source": "other datasets", "threshold": "mid", "target": "decoy", "false_abs": 0.25}
    workspace.tables.write(GATE, at, [filled(GATE, **at, **gated)], {})
    ranks = (("chaotic", "void", 2 / 21), ("chaotic", "control", 3 / 21), ("all", "void", 1.0))
    nulls = [
        filled(STEERING_NULLS, model=GAP, target=name, null="isotropic", side=side, p=p) for name, side, p in ranks
    ]
    workspace.tables.write(STEERING_NULLS, {}, nulls, {})
    assert planted(workspace, GAP) == {
        **{"stamps": pytest.approx(0.04), "standard": 0.0, "guided": 1.0, "decoy_guided": 0.0},
        **{"decoy_gate": 0.25, "nulls": 0.5},
    }
    lines = inside.markdown(inside.figures_of(workspace)).splitlines()
    assert "| AbsRec under guided, % | 30 points above | 100.0 |" in lines
    assert "| indirect effect of the time stamps at layer 0, chaotic | at most 0.1 | 0.040 |" in lines
