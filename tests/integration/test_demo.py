"""`make demo` as a user sees it: the numbers that must come out, the second run, what is written."""

from __future__ import annotations

import pytest

from tests.build.pooled import pooled_j
from tests.conftest import Checkout
from traps_pipeline.judging.judging_rows import VERDICTS
from traps_pipeline.scoring.score_rows import METRICS
from traps_pipeline.storage.benchmark_tables import VIDEOS
from traps_pipeline.storage.workspace import Workspace

pytestmark = pytest.mark.slow
DEGENERATE = ("always-abstain", "never-abstain", "perfect-answerer", "inverse-oracle")


@pytest.fixture(scope="module")
def workspace(demo: Checkout) -> Workspace:
    return Workspace.open(demo.workspace)


def test_degenerate_strategies_score_zero_everywhere_and_random_ones_do_not_discriminate(workspace: Workspace) -> None:
    cells = workspace.tables.read_all(METRICS).query("scope == 'all' and model in @DEGENERATE")
    assert len(cells) == 4 * 4 * 3 and (cells["pecs"] == 0.0).all()
    pooled = pooled_j(workspace.tables.read_all(VERDICTS)).set_index("model").loc[["random-50", "confidence-noise"]]
    assert (pooled["j"].abs() < 3 * pooled["standard_error"]).all()


def test_clips_are_five_second_masters_and_chaotic_voids_are_prefixes(workspace: Workspace) -> None:
    clips = workspace.tables.read_all(VIDEOS)
    assert len(clips) == 96  # control, void, twin
    assert set(zip(clips["width"], clips["height"], clips["fps"], strict=True)) == {(480, 360, 10)}
    assert (clips.query("side == 'control'")["n_frames"] == 50).all()
    chaotic = clips[clips["category"].isin(["plinko", "tumbling_dice"])].query("side == 'void'")
    assert chaotic["n_frames"].between(10, 49).all()


def test_the_pages_of_the_demo_are_few_and_small(demo: Checkout) -> None:
    files = [path for path in (demo.workspace / "reports").rglob("*") if path.is_file()]
    assert len(files) <= 30 and sum(path.stat().st_size for path in files) <= 6e6
