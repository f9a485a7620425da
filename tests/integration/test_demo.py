"""`make demo` as a user sees it: the numbers that must come out, the second run, what is written."""

from __future__ import annotations

import pytest

from tests.build.pooled import pooled_j
from tests.conftest import Checkout
from tests.tables import TABLES
from traps_pipeline.benchmark.records import load_release
from traps_pipeline.judging.judging_rows import AGREEMENT, JUDGE_BIAS, VERDICTS
from traps_pipeline.scoring.score_rows import LEADERBOARD, LEAVE_ONE_OUT, METRICS
from traps_pipeline.storage.benchmark_tables import ITEMS, VIDEOS
from traps_pipeline.storage.workspace import Workspace

pytestmark = pytest.mark.slow
NOT_RUN = ("confabulation", "confabulation_prevalence", "judge_validation", "judge_robustness")  # empty, never zeros
MECHANISM = ("probe_items", "hidden_states", "probes", "directions", "cosines", "steering", "steering_votes")
MECHANISM += ("steering_effects", "steering_shares", "steering_nulls", "steering_pecs")
MECHANISM += ("probe_baselines", "gate", "risk_coverage", "lens", "item_scores", "sentences", "patching")
PEOPLE = ("human_labels", "human_agreement", "human_row", "panel_errors", "corrected")  # nobody has labelled
ON_REQUEST = ("arms", "graded", "hypotheses", "robust")  # an experiment names arms and variations
DEGENERATE = ("always-abstain", "never-abstain", "perfect-answerer", "inverse-oracle")


@pytest.fixture(scope="module")
def workspace(demo: Checkout) -> Workspace:
    return Workspace.open(demo.workspace)


@pytest.mark.parametrize("model", DEGENERATE)
def test_a_degenerate_strategy_scores_zero_everywhere(workspace: Workspace, model: str) -> None:
    cells = workspace.tables.read_all(METRICS).query("model == @model and scope == 'all'")
    assert len(cells) == 4 * 3
    assert (cells["pecs"] == 0.0).all()


@pytest.mark.parametrize("model", ["random-50", "confidence-noise"])
def test_a_random_strategy_does_not_discriminate(workspace: Workspace, model: str) -> None:
    pooled = pooled_j(workspace.tables.read_all(VERDICTS)).set_index("model").loc[model]
    assert abs(pooled["j"]) < 3 * pooled["standard_error"]


def test_a_panel_of_one_rule_agrees_with_itself_and_owes_nothing_to_any_seat(workspace: Workspace) -> None:
    panel = workspace.tables.read(AGREEMENT, {}).query("judges == 'panel'")
    assert len(panel) == 4 * 3  # datasets x tasks
    assert panel["n_items"].sum() == 15_552 / 3
    assert (panel[["agreement", "fleiss_kappa", "alpha"]] == 1.0).all().all()
    assert (workspace.tables.read(JUDGE_BIAS, {})["bias"] == 0.0).all()
    left_out = workspace.tables.read(LEAVE_ONE_OUT, {})
    assert len(left_out) == 3 * len(workspace.tables.read(LEADERBOARD, {}))
    assert (left_out["difference"] == 0.0).all()


def test_every_dataset_has_sixteen_pairs_of_two_items(workspace: Workspace) -> None:
    items = workspace.tables.read_all(ITEMS)
    assert items.groupby(["dataset", "side"]).size().to_dict() == {
        (dataset, side): 16
        for dataset in ("occlusion", "occlusion_ill_posed", "chaotic", "chaotic_ill_posed")
        for side in ("control", "void")
    }


def test_clips_are_five_second_masters_and_chaotic_voids_are_prefixes(workspace: Workspace) -> None:
    clips = workspace.tables.read_all(VIDEOS)
    assert len(clips) == 96  # control, void, twin
    assert set(zip(clips["width"], clips["height"], clips["fps"], strict=True)) == {(480, 360, 10)}
    assert (clips.query("side == 'control'")["n_frames"] == 50).all()
    chaotic = clips[clips["category"].isin(["plinko", "tumbling_dice"])].query("side == 'void'")
    assert chaotic["n_frames"].between(10, 49).all()


def test_every_table_knows_its_benchmark_version(workspace: Workspace) -> None:
    for table in TABLES.values():
        rows = workspace.tables.read_all(table)
        assert rows.empty == (table.name in {*NOT_RUN, *MECHANISM, *PEOPLE, *ON_REQUEST}), table.name
        assert set(rows.get("benchmark_version", ())) <= {load_release().version}, table.name


def test_the_pages_of_the_demo_are_few_and_small(demo: Checkout) -> None:
    files = [path for path in (demo.workspace / "reports").rglob("*") if path.is_file()]
    assert len(files) <= 30 and sum(path.stat().st_size for path in files) <= 6e6
