"""Arms from an experiment to the conjunction, and variations to the table of hypotheses: asked on request, made once,
and no part of the pairs' figures."""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path

import pytest

from tests.conftest import Checkout
from traps_pipeline.benchmark.records import load_released
from traps_pipeline.models.asking.answer_rows import RESPONSES
from traps_pipeline.report.leaderboard_page import leaderboard_text
from traps_pipeline.scoring.score_rows import GRADED_CUTS, HYPOTHESES, LEADERBOARD, ROBUST
from traps_pipeline.storage.benchmark_tables import ARMS, ITEMS
from traps_pipeline.storage.parquet import TableStore
from traps_pipeline.storage.workspace import Workspace

pytestmark = pytest.mark.slow
EXPERIMENT = """
name: with-arms
models: [oracle, any-rule, occluder-rule]
regimes: [standard]
panel: rules
epoch: small
scenarios: [hidden_race-0001, plinko-0001]
datasets:
  [occlusion, occlusion_ill_posed, chaotic, chaotic_ill_posed, decoy, twin_control, crossed,
   labels_two, labels_six, occluder_grey, schema_abstain, frames_few, graded]
"""


UNTIL = ("--until", "leaderboard,robust,hypotheses,graded")


@pytest.fixture(scope="module")
def armed(small: Checkout, tmp_path_factory: pytest.TempPathFactory) -> tuple[Checkout, Path, dict[str, int]]:
    """A study of the experiment, which takes over the small study's clips; its file; and what its run counted."""
    folder = tmp_path_factory.mktemp("arms")
    (folder / "with-arms.yaml").write_text(EXPERIMENT)
    study = Checkout(small.root, folder / "armed")
    shutil.copytree(small.workspace / "clips", study.workspace / "clips")
    ran = study.traps("run", folder / "with-arms.yaml", *UNTIL).ok()
    return study, folder / "with-arms.yaml", ran.counts()


@pytest.fixture
def tables(armed: tuple[Checkout, Path, dict[str, int]]) -> TableStore:
    return Workspace.open(armed[0].workspace).tables


def test_arms_and_variations_are_asked_and_rendered_once(
    armed: tuple[Checkout, Path, dict[str, int]], tables: TableStore
) -> None:
    study, path, counts = armed
    # Pairs: 2 scenarios x 2 datasets x 2 sides. Arms: decoy 1, twin_control 2, crossed 1 x 2: a race has no partner.
    # Variations: 2 x 2 of the race, whose answers are colours, panel 1, schema and frames 2 x 2 each. A graded cut.
    assert counts["answers"] == 3 * (8 + (1 + 2 + 2) + (4 + 1 + 4 + 4) + 1)
    arms = tables.read_all(ARMS)
    # Decoy and grey, and the graded cut; the others show the pair's own clips.
    assert counts["frames"] == 50 + 50 + arms.set_index("arm").loc["graded", "n_frames"]
    refused = arms.dropna(subset=["refused"])
    assert {*zip(refused["arm"], refused["scenario_id"], strict=True)} == {
        ("crossed", "hidden_race-0001"),  # its choices are colours, which its question names
        *((arm, "plinko-0001") for arm in ("labels_two", "labels_six")),  # the numbers of its buckets are no colours
    }
    assert study.traps("run", path, *UNTIL).counts() == {"answers": 0, "votes": 0, "frames": 0}


def test_a_crossed_pair_shows_each_clip_with_another_question(tables: TableStore) -> None:
    items = tables.read_all(ITEMS, dataset="crossed").set_index("item_id")
    pair = tables.read_all(ITEMS, dataset="chaotic").set_index("item_id")
    aside, foreign = (items.loc[f"crossed:plinko-0001:{side}"] for side in ("control", "void"))
    answer = load_released()["plinko-0001"].answerable_question.answer
    assert (aside["clip"], aside["ground_truth"]) == (pair.loc["chaotic:plinko-0001:void", "clip"], answer)
    assert foreign["clip"] == pair.loc["chaotic:plinko-0001:control", "clip"]
    assert items["ground_truth"].isna().groupby(items["side"]).all().to_dict() == {"control": False, "void": True}


def test_arms_take_the_shortcuts_gain_away(tables: TableStore) -> None:
    robust = tables.read_all(ROBUST).set_index("model")
    board = tables.read_all(LEADERBOARD).query("dataset == 'overall'").set_index("model")
    assert robust.loc["oracle", ["conjunction", "robust"]].tolist() == [1.0, 1.0] and board.loc["oracle", "pecs"] == 1.0
    assert board.loc["any-rule", "pecs"] == 1.0  # it understands nothing of a void
    # Right in the pairs (weight 1) and twin_control (2 scenarios of 30), wrong in decoy and crossed (1 of 30 each).
    robust_of_rule = 32 / 34 * (30 / 31 - 2 / 34)
    assert robust.loc["any-rule", ["conjunction", "robust"]].tolist() == pytest.approx([0, robust_of_rule])
    text = leaderboard_text(tables.read(LEADERBOARD, {}), tables.read_all(ROBUST))
    assert re.search(r"\b3\b.* 7 .*: decoy, twin_control, crossed", text) and "nan" not in text
    assert robust["refused"].isna().all()


def test_variations_are_doses_of_their_hypotheses(tables: TableStore) -> None:
    doses = tables.read_all(HYPOTHESES).set_index(["model", "hypothesis", "dose"])
    grey = doses.loc[("occluder-rule", "occluder", "grey")]
    assert (grey["at_reference"], grey["value"], grey["rule_change"]) == (1.0, 0.0, -1.0)
    assert doses.loc[("oracle", "schema", "reason, abstain, final_answer"), "j"] == 1.0
    assert doses.loc[("oracle", "answer space", "6 answers"), "chance"] == pytest.approx(1 / 6)
    assert set(tables.read_all(ITEMS, dataset="labels_two")["labels"].map(len)) == {2}
    said = tables.read_all(RESPONSES, dataset="schema_abstain").query("model == 'oracle'")
    assert said["is_json"].all() and {json.loads(text)["abstain"] for text in said["text"]} == {True, False}


def test_a_graded_cut_is_scored_by_its_posterior(tables: TableStore) -> None:
    posterior = json.loads(tables.read_all(ARMS).set_index("arm").loc["graded", "evidence"])["posterior"]
    truth = load_released()["plinko-0001"].ground_truth
    graded = tables.read_all(GRADED_CUTS).query("scope == 'all'").set_index("model")
    assert graded.loc["oracle", "points"] == pytest.approx(4 * posterior[truth] - 3)  # it knows what came of it
    assert graded.loc["oracle", "points_best"] == pytest.approx(4 * max(posterior.values()) - 3)
    assert (graded.loc["any-rule", ["coverage", "points"]] == 0).all()  # it takes a short clip for a void
