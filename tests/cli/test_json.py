"""`--json`: what a command prints, for a program that reads it."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from tests.conftest import EXPERIMENT, Checkout
from traps_pipeline.cli import main
from traps_pipeline.cli.command import print_json

ITEM = "occlusion:domino_chain-0001:void"


@dataclass
class Pair:
    """Two values."""

    first: Any
    second: Any


def read(study: Checkout, *arguments: str) -> Any:
    """Return the JSON that a command prints."""
    finished = study.traps(*arguments, "--json").ok()
    return json.loads(finished.out)


def test_what_is_missing_is_null_and_tables_are_lists_of_rows(capsys: pytest.CaptureFixture[str]) -> None:
    frame = pd.DataFrame({"model": ["a", "b"], "pecs": [0.5, math.nan]})
    print_json({"board": frame, 3: Pair(np.int64(7), Path("/x")), "inf": math.inf, "set": {1}})
    assert json.loads(capsys.readouterr().out) == {
        "board": [{"model": "a", "pecs": 0.5}, {"model": "b", "pecs": None}],
        "3": {"first": 7, "second": "/x"},
        "inf": None,
        "set": [1],
    }


def test_a_study_is_read_without_its_tables(
    small: Checkout, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    plan = read(small, "plan", EXPERIMENT)
    assert plan["plan"]["calls"]["oracle"][0] == {"wanted": 96, "known": 96}
    why = read(small, "why", ITEM)
    assert why["item"] == ITEM and {"evaluation", "state", "answers", "votes"} == {*why["evaluations"][0]}
    run = read(small, "run", EXPERIMENT)
    assert {row["model"] for row in run["leaderboard"]} == {"oracle", "random-50", "prior"}
    assert run["run"]["problems"] == []
    status = read(small, "status", EXPERIMENT)
    assert status["checks"] == [] and status["command"] == f"traps run {EXPERIMENT}"
    assert not any(row["stale"] or row["missing"] for row in status["stages"])
    elsewhere = read(small, "status", EXPERIMENT, "--workspace", str(small.workspace))
    assert elsewhere["command"] == f"traps run {EXPERIMENT} --workspace {small.workspace}"
    # The study does not say where the file of its experiment lies.
    job = "dagster job execute -m traps_pipeline.definitions -j everything"
    assert read(small, "status")["command"] == job and status["ledger"] == []
    monkeypatch.chdir(tmp_path)
    (tmp_path / "small.yaml").touch()  # the current folder may hold it
    assert main(["status", "--json", "--workspace", str(small.workspace)]) == 0
    assert json.loads(capsys.readouterr().out)["command"] == f"traps run small.yaml --workspace {small.workspace}"


def test_a_site_says_what_it_holds(small: Checkout, tmp_path: Path) -> None:
    site = read(small, "site", str(tmp_path / "site"), "--without-clips")
    assert (site["answers"], site["clips"]) == (288, 0) and site["folder"] == str(tmp_path / "site")


def test_differences_are_rows(small: Checkout) -> None:
    difference = read(small, "results", "compare", str(small.workspace))[0]
    assert difference["difference"] == 0.0
