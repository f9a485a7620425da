"""What a run prints on a node is read on the head, from the study's object store."""

from __future__ import annotations

import secrets
import time
from pathlib import Path

import pytest

from tests.objectstore import S3
from traps_cluster import history
from traps_cluster.bucket import Bucket
from traps_cluster.history import fetch, upload, uploading
from traps_pipeline.storage.study import Study
from traps_pipeline.storage.workspace import Workspace

LOG = Path("run-1") / "compute_logs" / "votes.out"  # as Dagster's own log manager has it below its folder


@pytest.fixture
def place(s3: S3) -> str:
    return f"s3://lab/{secrets.token_hex(4)}"


def printed(folder: Path, text: str) -> None:
    (folder / LOG).parent.mkdir(parents=True, exist_ok=True)
    (folder / LOG).write_text(text)


def test_what_a_run_prints_is_read_elsewhere_while_it_goes_on_and_when_it_ended(place: str, tmp_path: Path) -> None:
    node, head, sizes = tmp_path / "node", tmp_path / "head", dict[Path, int]()
    bucket = Bucket(place)
    for text in ("made on this host\n", "made on this host\nand ended\n"):
        printed(node, text)
        printed(node / "another", "of a run that this process does not execute\n")
        upload(bucket, node, "run-1", sizes)
        fetch(bucket, head)
        assert (head / LOG).read_text() == text
    assert [name for name, *_ in bucket.names()] == [f"logs/{LOG.as_posix()}"]


def test_a_run_brings_what_it_prints_before_its_end_and_at_it(
    place: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(history, "UPLOAD_S", 0.05)
    workspace, bucket, name = Workspace(tmp_path, Study(name="lab"), place), Bucket(place), f"logs/{LOG.as_posix()}"
    with uploading(workspace, "run-1"):
        printed(tmp_path / "cluster" / "logs", "begun\n")
        while bucket.get(name) != b"begun\n":
            time.sleep(0.01)
        printed(tmp_path / "cluster" / "logs", "begun\nended\n")
    assert bucket.get(name) == b"begun\nended\n"


def test_a_run_goes_on_where_the_store_does_not_take_what_it_prints(
    place: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    printed(tmp_path, "made on this host\n")
    upload(Bucket(place.replace("lab", "no-such-bucket")), tmp_path, "run-1", {})
    assert "s3://no-such-bucket/" in capsys.readouterr().err


def test_the_head_writes_no_file_outside_the_logs(place: str, tmp_path: Path) -> None:
    bucket = Bucket(place)
    bucket.put("logs/run-1/a.out", b"a")
    head = tmp_path / "head" / "logs"
    head.mkdir(parents=True)
    (head / "run-1").symlink_to(tmp_path)
    fetch(bucket, head)
    assert not (tmp_path / "a.out").exists()
