"""Dagster's page of a run holds the progress that a terminal shows."""

from __future__ import annotations

import pytest

from tests.conftest import Checkout
from traps_pipeline.pipeline.run import dagster_history
from traps_pipeline.storage.workspace import Workspace


def test_a_runs_log_says_what_each_stage_has_done(small: Checkout, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DAGSTER_HOME", str(small.workspace / "dagster"))
    with dagster_history(Workspace.open(small.workspace)) as history:
        messages = [entry.user_message for run in history.get_runs() for entry in history.all_logs(run.run_id)]
    assert [text for text in messages if text.startswith("responses: 24 of 24 made, 288 asked, ")]
