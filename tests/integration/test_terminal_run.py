"""A run at a slow server that fails now and then, as a person sees it in a real terminal."""

from __future__ import annotations

import re
import sys

import pytest

from tests.build.network import ITEMS, entry, experiment
from tests.conftest import Checkout
from tests.providers.server import Provider
from tests.terminals import run_in_terminal

pytestmark = pytest.mark.slow
FAULTS = {"rate_limited": 0.1, "server_error": 0.1, "cut": 0.05}


def test_calls_are_shown_below_all_else_while_they_are_made(unasked: Checkout, provider: Provider) -> None:
    study, columns, rows = unasked, 80, 24
    provider.configure(faults=FAULTS, only_first_attempts=2, latency_s=1.0)
    path = experiment(study, provider, [entry("image-model", "images")], regimes=["standard"], budget_usd=20.0)
    command = [sys.executable, "-m", "traps_pipeline.cli", "run", str(path), "--no-preflight", "--until", "votes"]
    code, screen = run_in_terminal(command, columns, rows, study.root, study.environment)
    assert code == 0, screen.text
    bottoms = [[line for line in frame if line][-3:] for frame in screen.frames if len(frame) > 2]
    live = [bottom for bottom in bottoms if bottom[0].startswith("responses ") and "p95" in bottom[1]]
    assert len(live) > 3  # it is drawn again and again
    assert all(f"/{ITEMS}" in bottom[2] for bottom in live)  # of the stage, and not of the cells that were begun
    assert any(re.search(r" \d+, \d+ s ", bottom[2]) for bottom in live)  # in flight, and the age of the oldest
    heading, _, row = live[-1]
    assert " of $20.00" in heading and " left" in heading
    assert row.startswith("image-model") and f"/{ITEMS}" in row
    assert max(len(line) for frame in screen.frames for line in frame if line.startswith("responses")) <= columns
    assert "p95" not in screen.text
    (line,) = (line for line in screen.text.splitlines() if line.startswith("responses: "))
    assert line.startswith(f"responses: 4 of 4 made, {ITEMS} asked, ") and "retried" in line
