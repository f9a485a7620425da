"""What errors about labels, votes and people's files say to do lets the same command succeed."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pandas as pd
import pytest

from tests.judging.conftest import answered_study, judge_at
from tests.providers.server import Provider
from tests.remedies.remedied import remedied
from traps_pipeline.judging.judging_rows import VOTES
from traps_pipeline.judging.panel import collect_votes, judged_answers, wanted_ballots
from traps_pipeline.judging.robustness import check_panel, load_attacks
from traps_pipeline.judging.verdicts import decide
from traps_pipeline.models.answer_rows import RESPONSES
from traps_pipeline.models.judges import JudgeEntry, load_panel
from traps_pipeline.protocol.cells import Cell, Evaluation
from traps_pipeline.storage.benchmark_tables import ITEMS
from traps_pipeline.storage.study import Study
from traps_pipeline.storage.workspace import Workspace

__all__ = ["judge_at"]  # the fixture
CELL = Cell("chaotic", Evaluation("oracle", "standard", 1))
ANSWERS = {CELL: {(k, side): "It goes left." for k in range(2) for side in ("control", "void")}}


def items_of(workspace: Workspace) -> pd.DataFrame:
    return workspace.tables.read(ITEMS, {"dataset": "chaotic"})


def test_answers_are_judged_once_they_are_of_the_items_that_are_there(tmp_path: Path) -> None:
    workspace, panel = answered_study(tmp_path, ANSWERS), load_panel("rules")
    items, responses = items_of(workspace), workspace.tables.read(RESPONSES, CELL.partition)

    def write(rows: pd.DataFrame) -> Callable[[], object]:
        return lambda: workspace.tables.write(RESPONSES, CELL.partition, rows, {})

    write(responses.assign(request_key="of an earlier question"))()
    remedied(
        lambda: wanted_ballots(workspace, panel, CELL),
        "judging.panel.wanted_ballots",
        lambda: answered_study(tmp_path, ANSWERS),
    )
    whole = workspace.tables.read(RESPONSES, CELL.partition)
    workspace.tables.write(ITEMS, {"dataset": "chaotic"}, items.iloc[1:], {})
    remedied(
        lambda: list(judged_answers(workspace, RESPONSES, CELL)),
        "judging.panel.judged_answers",
        write(whole[whole["item_id"] != items["item_id"][0]]),
    )


def test_verdicts_are_made_once_all_votes_are_there(tmp_path: Path) -> None:
    workspace = answered_study(tmp_path, ANSWERS)

    def voted() -> None:
        for cell, made in collect_votes(workspace, [CELL]):
            workspace.tables.write(VOTES, cell.partition, made.rows(VOTES), {})

    voted()
    votes = workspace.tables.read(VOTES, CELL.partition)
    workspace.tables.write(VOTES, CELL.partition, votes.iloc[3:], {})

    def verdicts() -> pd.DataFrame:
        own = [name for name in items_of(workspace).columns if name != "benchmark_version"]
        answers = workspace.tables.read(RESPONSES, CELL.partition).drop(columns="benchmark_version")
        items = items_of(workspace)[
            [n for n in own if n not in answers.columns or n == "item_id"] + ["benchmark_version"]
        ]
        return decide(items, answers, workspace.tables.read(VOTES, CELL.partition))

    assert len(remedied(verdicts, "judging.verdicts", voted)) == 4


@pytest.mark.slow  # asks a server
def test_the_judges_that_failed_alone_are_asked_again(
    provider: Provider, judge_at: Callable[[str], JudgeEntry], tmp_path: Path
) -> None:
    workspace = Workspace.create(tmp_path, Study(budget_usd=10))
    panel = [judge_at("judge-one")]
    provider.configure(fault_by_model={"judge-one": "bad_request"})
    attacks = load_attacks()
    few = attacks.model_copy(update={"attacks": attacks.attacks[:2]})

    def call() -> object:
        return check_panel(workspace, "one", panel, few)

    remedied(call, "judging.robustness", lambda: provider.configure(fault_by_model={}))
