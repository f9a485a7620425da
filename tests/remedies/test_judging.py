"""What errors about labels, votes and people's files say to do lets the same command succeed."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import pandas as pd
import pytest

from tests.build.labels import GOOD, HEAD, MODEL, labelled_study, written
from tests.judging.conftest import answered_study, judge_at
from tests.providers.server import Provider
from tests.remedies.remedied import command, remedied
from traps_pipeline.judging.judging_rows import CONFABULATION, VOTES
from traps_pipeline.judging.panel import collect_votes, judged_answers, wanted_ballots
from traps_pipeline.judging.robustness import check_panel, load_attacks
from traps_pipeline.judging.verdicts import decide
from traps_pipeline.models.judges import JudgeEntry, load_panel
from traps_pipeline.models.tables import RESPONSES
from traps_pipeline.people.judge_validation import annotation_sheet, read_labels, write_sheet
from traps_pipeline.people.labels import LABELS_FILE, label_lines
from traps_pipeline.protocol.cells import Cell, Evaluation
from traps_pipeline.servers.labelstore import DATABASE, LabelStore
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


# --- confabulation ----------------------------------------------------------------------------------------------------


def test_a_sheet_is_written_once_there_are_labels_of_these_answers(tmp_path: Path) -> None:
    root, sheet = tmp_path / "study", tmp_path / "sheet.csv"
    at = ("--workspace", root)
    workspace = labelled_study(root, ["It goes left."])
    labels = workspace.tables.read(CONFABULATION, {})
    workspace.tables.write(CONFABULATION, {}, [], {})
    (tmp_path / "labels.csv").write_text(f"{HEAD}\n")
    remedied(
        lambda: command("confabulation", "sheet", sheet, *at),
        "people.judge_validation.sheet_rows",
        lambda: workspace.tables.write(CONFABULATION, {}, labels, {}),
    )
    remedied(
        lambda: command("confabulation", "sheet", sheet, *at),
        "people.judge_validation.write_sheet",
        again=lambda: command("confabulation", "sheet", tmp_path / "other.csv", *at),
    )
    remedied(
        lambda: write_sheet(annotation_sheet(workspace), sheet), "people.judge_validation.write_sheet", sheet.unlink
    )
    cell = Cell("chaotic", Evaluation(MODEL, "standard", 1))
    answers = workspace.tables.read(RESPONSES, cell.partition)
    workspace.tables.write(RESPONSES, cell.partition, answers.assign(text="Right."), {})
    remedied(lambda: annotation_sheet(workspace), "people.judge_validation", lambda: labelled_study(root, ["Right."]))


def test_labels_of_people_are_read_and_compared_once_they_are_as_told(tmp_path: Path) -> None:
    path = written(tmp_path, HEAD, *GOOD[:3], "bob,s2,1,0,2,1")
    for right in ("1", "0", "true", "false", "yes", "no"):
        written(tmp_path, HEAD, *GOOD[:3], "bob,s2,1,0,2,1")
        remedied(
            lambda: read_labels(path, ["s1", "s2"]),
            "people.judge_validation",
            lambda right=right: written(tmp_path, HEAD, *GOOD[:3], f"bob,s2,1,0,{right},1"),
        )
    workspace = labelled_study(tmp_path / "study", ["It goes left."])
    labels = workspace.tables.read(CONFABULATION, {})
    sample = labels["sample_id"][0]
    written(tmp_path, HEAD, *(f"{who},{sample},1,0,no,TRUE" for who in ("ann", "bob")))
    workspace.tables.write(CONFABULATION, {}, [], {})
    remedied(
        lambda: command("confabulation", "validate", path, "--workspace", workspace.root),
        "people.judge_validation.validate",
        lambda: workspace.tables.write(CONFABULATION, {}, labels, {}),
    )


# --- people -----------------------------------------------------------------------------------------------------------


def test_labels_are_read_once_their_file_is_restored_and_the_database_is_made_from_it(tmp_path: Path) -> None:
    store = LabelStore(tmp_path)
    for unit in ("u1", "u2"):
        store.show("jd", "abstention", unit, "plinko-0001")
        store.record("jd", "abstention", unit, {"abstained": True})
    path, kept = tmp_path / LABELS_FILE, tmp_path / "copy"
    shutil.copy(path, kept)
    path.write_bytes(path.read_bytes().replace(b'"u1"', b'"u9"', 1))
    lines = remedied(lambda: label_lines(tmp_path), "people.labels.label_lines", lambda: shutil.copy(kept, path))
    assert [line.unit for line in lines] == ["u1", "u2"]
    path.write_bytes(path.read_bytes() + b"nonsense\n")
    remedied(lambda: LabelStore(tmp_path), "servers.labelstore", lambda: shutil.copy(kept, path))
    for name in (f"{DATABASE}-wal", f"{DATABASE}-shm"):
        (tmp_path / name).unlink(missing_ok=True)
    (tmp_path / DATABASE).write_bytes(b"nonsense" * 1000)
    again = remedied(
        lambda: LabelStore(tmp_path), "servers.labelstore", lambda: (tmp_path / DATABASE).rename(tmp_path / "away")
    )
    assert again.labelled("jd", "abstention") == ["u1", "u2"]
