"""`traps doctor --verify` names every damaged file of a study, and nothing else."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from traps_pipeline.cli import main
from traps_pipeline.digests import file_digest
from traps_pipeline.models.budget import Journal
from traps_pipeline.scoring.tables import LEADERBOARD
from traps_pipeline.storage.study import Study
from traps_pipeline.storage.workspace import Workspace


def test_each_damaged_file_is_named_by_itself(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    workspace = Workspace.create(tmp_path, Study())
    workspace.tables.write(LEADERBOARD, {}, [], {})
    with workspace.answers.writer("m__standard__run1") as writer:
        writer.append({"key": "a", "outcome": "answer"}, {"reasoning": "It rolls left."})
    journal = Journal(workspace.root / "ledger" / "in_flight.jsonl")
    journal.add("m", 0.5)
    journal.close()
    clip = workspace.clip("plinko-0001", "void", "0" * 64)
    clip.parent.mkdir(parents=True)
    clip.write_bytes(b"a clip")
    note = {"file_sha256": file_digest(clip), "size_bytes": 6, "frames_sha256": "", "n_frames": 1, "fps": 10}
    clip.with_suffix(".json").write_text(json.dumps(note | {"leaked_pixels": 0}))

    def verified() -> tuple[int, str]:
        return main(["doctor", "--verify", "--workspace", str(tmp_path)]), capsys.readouterr().out

    code, told = verified()
    assert code == 0 and told.count("ok  ") == 3, told
    files = [path for kind in ("*.parquet", "*.jsonl*", "*.mp4") for path in tmp_path.rglob(kind)]
    assert len(files) == 5
    for path in files:
        written = path.read_bytes()
        flipped = bytearray(written)
        flipped[len(flipped) // 2] ^= 4
        path.write_bytes(flipped)
        code, told = verified()
        assert code == 1 and told.count("FAIL") == 1 and str(path) in told, told
        path.write_bytes(written)
