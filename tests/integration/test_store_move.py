"""A finished study of one machine goes into an object store: it is the same study there, and nothing is paid again."""

from __future__ import annotations

import re
import shutil
import sys
from pathlib import Path

import pytest

from bench.equality import main as compare
from tests.build.errors import raises
from tests.conftest import SMALL, Checkout, copy_of
from tests.objectstore import S3
from tests.postgres import Postgres
from tests.remedies.remedied import remedied
from traps_cluster.store_move import MOVED_STUDY, move_to_store
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.storage.workspace import DATABASE, Workspace

pytestmark = pytest.mark.slow
EXPERIMENT, ADDRESS = SMALL.with_name("one_regime.yaml"), "s3://lab/moved"
NOTHING = {"answers": 0, "votes": 0, "frames": 0}


def test_a_finished_study_moves_into_a_store_where_nothing_is_asked_or_made_again(
    one_regime: Checkout, s3: S3, postgres: Postgres, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(DATABASE, postgres.address())
    monkeypatch.setenv("TRAPS_SCRATCH", str(tmp_path / "scratch"))
    study = copy_of(one_regime, tmp_path)
    with monkeypatch.context() as patched:  # killed once all is there, before it counts

        def killed(*_: object) -> None:
            raise KeyboardInterrupt

        patched.setattr("traps_pipeline.storage.workspace.Workspace.save_study", killed)
        with pytest.raises(KeyboardInterrupt):
            move_to_store(Workspace.open(study.workspace), ADDRESS)
    assert not Workspace.is_there(ADDRESS) and Workspace.open(study.workspace).answers.evaluations()

    assert f"export TRAPS_WORKSPACE={ADDRESS}" in study.traps("study", "move", "--store", ADDRESS).ok().out
    shutil.rmtree(tmp_path / "scratch")  # another host has none of it
    monkeypatch.setenv("TRAPS_WORKSPACE", ADDRESS)
    command = [sys.executable, "-m", "traps_pipeline.cli", "run", EXPERIMENT, "--until", "leaderboard"]
    again = study.run("env", "-u", "DAGSTER_HOME", *command, "--workspace", ADDRESS)
    assert (again.code, again.counts()) == (0, NOTHING), again.out + again.err
    workspace = Workspace.open(ADDRESS)
    workspace.bring_folder(workspace.tables.root)
    assert compare(one_regime.workspace, workspace.root) == 0

    left = study.traps("status")
    assert (left.code, left.raised) == (1, "storage.workspace.Workspace.open")
    assert (study.workspace / MOVED_STUDY).is_file()
    with raises(TrapsError, "traps_cluster.store_move.move_to_store", ADDRESS, "`traps study export-ledger`"):
        move_to_store(workspace, "s3://lab/elsewhere")
    other = copy_of(one_regime, tmp_path / "other")
    named = other.workspace / "study.yaml"
    named.write_text(re.sub(r"(?m)^name: .*$", "name: another", named.read_text()))
    remedied(
        lambda: move_to_store(Workspace.open(other.workspace), ADDRESS),
        "traps_cluster.store_move.move_to_store",
        again=lambda: move_to_store(Workspace.open(other.workspace), "s3://lab/moved-too"),
    )
