"""A metric is declared once: tables, intervals, the printed board, its legend and the explorer have it from there."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from tests.conftest import ROOT
from traps_pipeline.protocol.metric_words import COUNT_WORDS, METRIC_WORDS
from traps_pipeline.report.leaderboard_page import LEGEND
from traps_pipeline.scoring.score_rows import LEADERBOARD, METRICS

# Balanced accuracy: the mean of Acc and AbsRec. It is declared before any table is.
WITH_A_NEW_METRIC = """
import sys
from pathlib import Path
from traps_pipeline.protocol.metric_words import METRIC_WORDS, Metric

METRIC_WORDS["balanced"] = Metric(
    "balanced", "Balanced", "mean of Acc and AbsRec", lambda acc, false_abs, abs_rec: (acc + abs_rec) / 2
)
import pandas as pd
from tests.build.cells import write_cell
from tests.scoring.conftest import verdict_rows
from traps_pipeline.protocol.datasets import DATASETS
from traps_pipeline.report.explorer.site import write_site
from traps_pipeline.report.leaderboard_page import leaderboard_markdown
from traps_pipeline.scoring.bootstrap import intervals, resample
from traps_pipeline.scoring.metrics import cell_metrics
from traps_pipeline.scoring.score_rows import CONTRASTS, LEADERBOARD
from traps_pipeline.scoring.standings import leaderboard
from traps_pipeline.storage.study import Study
from traps_pipeline.storage.workspace import Workspace

pairs = [(True, False, True), (True, False, True), (True, True, True), (True, False, False), (False, False, False)]
verdicts = {dataset: verdict_rows(pairs, dataset) for dataset in DATASETS}
metrics = pd.concat([cell_metrics(rows) for rows in verdicts.values()])
contrasts = pd.DataFrame(columns=pd.Index(CONTRASTS.names))
board = leaderboard(metrics, intervals(resample(pd.concat(verdicts.values()), 200)), contrasts)
folder = Path(sys.argv[1])
workspace = Workspace.create(folder / "study", Study(name="hand-made", scenarios=["plinko-0001"]))
write_cell(workspace)
workspace.tables.write(LEADERBOARD, {}, board, {})
write_site(workspace, folder / "site")
(folder / "board.md").write_text(leaderboard_markdown(workspace.tables.read(LEADERBOARD, {})), encoding="utf-8")
"""


def test_every_metric_and_every_printed_count_is_a_column_and_in_the_legend() -> None:
    marks = {f"{name}{end}" for name in METRIC_WORDS for end in ("", "_std", "_ci_low", "_ci_high")}
    assert marks | {*COUNT_WORDS} <= {*LEADERBOARD.names} and {*METRIC_WORDS, *COUNT_WORDS} <= {*METRICS.names}
    headings = {each.heading for each in (*METRIC_WORDS.values(), *COUNT_WORDS.values()) if each.heading}
    assert headings <= {*LEGEND}


@pytest.mark.slow
@pytest.mark.promise
def test_a_metric_declared_once_is_on_the_board_with_its_interval_in_the_legend_and_in_the_explorer(
    tmp_path: Path,
) -> None:
    subprocess.run([sys.executable, "-c", WITH_A_NEW_METRIC, tmp_path], cwd=ROOT, check=True)
    heading, _, line, *_ = (row for row in (tmp_path / "board.md").read_text().splitlines() if row.startswith("|"))
    shown = dict(zip(heading.split(" | "), line.split(" | "), strict=True))
    assert shown["Balanced"] == "0.700"  # Acc 4/5, AbsRec 3/5
    assert "**Balanced**: mean of Acc and AbsRec" in (tmp_path / "board.md").read_text()
    study = json.loads((tmp_path / "site/data/study.js").read_text().split(",", 2)[2].removesuffix(");\n"))
    assert {"field": "balanced", "title": "Balanced", "unit": "fraction", "in_paper": False} in study["metrics"]
    assert {each["field"] for each in study["metrics"] if each["in_paper"]} == {"pecs", "acc", "abs_rec", "false_abs"}
    (overall,) = (row for row in study["leaderboard"] if row["dataset"] == "overall")
    assert overall["balanced"] == pytest.approx(0.7) and overall["balanced_std"] == 0
    assert 0.2 < overall["balanced_ci_low"] < 0.7 < overall["balanced_ci_high"] < 1
