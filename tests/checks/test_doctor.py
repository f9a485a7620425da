"""`traps doctor --verify` names every damaged file of a study, and nothing else."""

from __future__ import annotations

import json
import os
import sqlite3
import sys
import time
from contextlib import closing
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest

from tests.build.ledger import answer, write
from tests.conftest import Checkout
from traps_pipeline.base.digests import file_digest
from traps_pipeline.cli import main
from traps_pipeline.scoring.score_rows import LEADERBOARD
from traps_pipeline.storage.media import MediaSpec
from traps_pipeline.storage.parquet import write_sealed
from traps_pipeline.storage.study import Study
from traps_pipeline.storage.workspace import Workspace
from traps_pipeline.video.encode import encode


def test_each_damaged_file_is_named_by_itself(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    workspace = Workspace.create(tmp_path, Study())
    workspace.tables.write(LEADERBOARD, {}, [], {})
    write(workspace.answers, answer("a", "x" * 3000))
    clip = workspace.clip("plinko-0001", "void", "0" * 64)
    clip.parent.mkdir(parents=True)
    clip.write_bytes(b"a clip")
    note = {"file_sha256": file_digest(clip), "size_bytes": 6, "frames_sha256": "", "n_frames": 1, "fps": 10}
    clip.with_suffix(".json").write_text(json.dumps(note | {"leaked_pixels": 0}))

    def verified() -> tuple[int, str]:
        return main(["doctor", "--verify", "--workspace", str(tmp_path)]), capsys.readouterr().out

    code, told = verified()
    assert code == 0 and told.count("ok  ") == 7, told
    files = [path for kind in ("*.parquet", "*.sqlite", "*.mp4") for path in tmp_path.rglob(kind)]
    assert len(files) == 3
    for path in files:
        written = path.read_bytes()
        flipped = bytearray(written)
        flipped[written.rindex(b"xxxx") if path.suffix == ".sqlite" else len(flipped) // 2] ^= 4
        path.write_bytes(flipped)
        code, told = verified()
        assert code == 1 and told.count("FAIL") == 1 and str(path) in told, told
        path.write_bytes(written)


def test_a_damaged_note_file_and_history_are_named_and_what_killed_runs_left_is_removed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    workspace = Workspace.create(tmp_path / "study", Study())
    clip = tmp_path / "clip.mp4"
    encode([np.full((360, 480, 3), shade, np.uint8) for shade in (40, 80, 120)], clip, fps=10)
    media = workspace.media.prepare(clip, file_digest(clip), MediaSpec(profile="images", fps=5, most=25))
    assert media.path is not None
    history = workspace.dagster_home / "history" / "runs.db"
    history.parent.mkdir(parents=True)
    with closing(sqlite3.connect(history)) as opened:
        opened.execute("create table runs (id integer primary key, body text)")
        opened.executemany("insert into runs (body) values (?)", [("x" * 200,)] * 200)
        opened.commit()
    old, young = (workspace.reports / f".page.html.{name}.part" for name in ("old", "young"))
    for path, age_s in ((old, 2 * 24 * 3600), (young, 60)):
        path.write_bytes(b"<html>")
        os.utime(path, (time.time() - age_s,) * 2)

    def verified() -> tuple[int, str]:
        return main(["doctor", "--verify", "--workspace", str(workspace.root)]), capsys.readouterr().out

    code, told = verified()
    assert code == 0 and "unfinished: 1 " in told, told
    assert (old.exists(), young.exists()) == (False, True)
    states = workspace.root / "states" / "m" / "standard" / "occlusion" / "shard-00000.parquet"
    write_sealed(states, pa.table({"item_id": ["a" * 300]}), {})
    for path in (media.path, media.path.with_suffix(".json"), history, states):
        written = path.read_bytes()
        place = 100 if path == history else len(written) // 2  # of a history the first page, not the text of a row
        path.write_bytes(written[:place] + b"\0" * 100 + written[place + 100 :])
        code, told = verified()
        assert code == 1 and told.count("FAIL") == 1 and str(path.with_suffix("")) in told, told
        path.write_bytes(written)


@pytest.mark.slow
@pytest.mark.skipif(os.geteuid() != 0, reason="only root becomes another user")
@pytest.mark.parametrize("is_log_left", [False, True])
def test_a_user_who_may_only_read_verifies_a_study(study: Checkout, is_log_left: bool) -> None:
    """A killed process leaves SQLite's log beside a file of the history or the ledger."""
    old = study.workspace / "reports" / ".page.html.old.part"
    old.write_bytes(b"<html>")
    os.utime(old, (time.time() - 2 * 24 * 3600,) * 2)
    databases = [study.workspace / "ledger" / "ledger.sqlite", *study.workspace.rglob("index.db")]
    held = [sqlite3.connect(path) for path in databases if is_log_left]
    for connection in held:
        connection.execute("pragma journal_mode=wal")
        connection.execute("pragma user_version=7")
    before = {path: path.stat().st_mtime_ns for path in study.workspace.rglob("*")}
    for folder in (study.workspace, *study.workspace.parents):
        folder.chmod(folder.stat().st_mode | 0o055)
    nobody = ["setpriv", "--reuid", "65534", "--regid", "65534", "--clear-groups"]
    verify = [sys.executable, "-m", "traps_pipeline.cli", "doctor", "--verify", "--json"]
    told = study.run(*nobody, *verify, "--workspace", study.workspace)
    assert told.code == 0, told.out + told.err
    assert {path: path.stat().st_mtime_ns for path in study.workspace.rglob("*")} == before
    [leaderboard] = (study.workspace / "tables" / "leaderboard").glob("*.parquet")
    leaderboard.chmod(0o600)
    told = study.run(*nobody, *verify, "--workspace", study.workspace)
    failing = [finding for finding in json.loads(told.out) if not finding["ok"]]
    assert [finding["what"] for finding in failing] == ["tables"] and str(leaderboard) in failing[0]["detail"]
    for connection in held:
        connection.close()
