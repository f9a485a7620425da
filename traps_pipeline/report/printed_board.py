"""Store the leaderboard as `traps run` prints it, for a run with nothing to do."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict

from traps_pipeline.base.terminal import TextTable
from traps_pipeline.storage.workspace import Workspace

BOARD_FILE = ".state/leaderboard.json"  # in the folder `reports`, beside the report's versions
NO_BOARD = "no leaderboard: neither pairs nor two events were asked; the report has the tables of what was"


def board_bytes(tables: Sequence[TextTable]) -> bytes:
    """Return a study's leaderboard tables as JSON, from which the terminal prints them."""
    return json.dumps([asdict(table) for table in tables], ensure_ascii=False).encode()


def stored_leaderboard_text(workspace: Workspace) -> str:
    """Return a study's leaderboard for standard output, from its stored report or else its tables."""
    path = workspace.reports / BOARD_FILE
    if workspace.store.has(path):
        tables = [TextTable(**table) for table in json.loads(workspace.store.here(path).read_bytes())]
    else:  # somebody has cleared the folder
        tables = board_tables(workspace)
    text = "\n".join(table.text() for table in tables) or NO_BOARD
    earlier = _asked_earlier(workspace)
    return f"{text}\nof earlier runs: {earlier}, which no experiment in study.yaml asks any more\n" if earlier else text


def _asked_earlier(workspace: Workspace) -> str:
    """Return models, or models and regimes, with verdicts that no experiment of the study asks for."""
    from traps_pipeline.judging.judging_rows import VERDICTS

    asked = [(model, each.regimes) for each in workspace.study.experiments.values() for model in each.models]
    models = {model for model, _ in asked}
    entries = {(model, regime) for model, regimes in asked for regime in regimes}
    judged = {(cell["model"], cell["regime"]) for cell in workspace.tables.partitions(VERDICTS)}
    left = {f"{model} ({regime})" if model in models else model for model, regime in judged - entries}
    return ", ".join(sorted(left))


def board_tables(workspace: Workspace) -> list[TextTable]:
    """Return the study's leaderboard as texts: a table per panel, or that of two events alone; none without scores."""
    from traps_pipeline.people.human_score_rows import HUMAN_ROW, PANEL_ERRORS
    from traps_pipeline.people.recorded_certificates import certification_note
    from traps_pipeline.report.leaderboard_page import leaderboard_tables
    from traps_pipeline.report.tables.human_tables import people_notes
    from traps_pipeline.report.tables.two_way_table import two_way_table
    from traps_pipeline.report.writing import table_text
    from traps_pipeline.scoring.score_rows import LEADERBOARD, TWO_WAY

    board, events = (workspace.tables.read_all(table) for table in (LEADERBOARD, TWO_WAY))
    if board.empty:
        return [table_text(two_way_table(events))] if len(events) else []
    tables = workspace.tables
    notes = people_notes(tables.read_all(HUMAN_ROW), tables.read_all(PANEL_ERRORS), certification_note(tables))
    return leaderboard_tables(board, events, notes)
