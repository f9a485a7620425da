"""What nobody names any more is removed from a study's store, and nothing else is."""

from __future__ import annotations

import secrets
from collections.abc import Callable
from hashlib import sha256
from pathlib import Path
from typing import Any

import pytest

from tests.build.ledger import answer, write
from tests.objectstore import S3
from tests.postgres import Postgres
from tests.remedies.remedied import command, remedied
from tests.storage.test_compaction import finish, in_database
from traps_pipeline.cluster.bucket import Bucket, object_name
from traps_pipeline.cluster.objects import ObjectStore
from traps_pipeline.cluster.removal import ENDS_S
from traps_pipeline.cluster.unused import _tell, remove, unused
from traps_pipeline.cluster import unused as module
from traps_pipeline.storage.database import Session
from traps_pipeline.storage.shared_ledger import SharedLedger
from traps_pipeline.storage.study import Study
from traps_pipeline.storage.workspace import DATABASE, Workspace

Open = Callable[[str], ObjectStore]
OLD, NEW, LOST = b"an older table", b"the table", b"written, and its host died before it was named"


@pytest.fixture
def study(s3: S3) -> str:
    return f"study-{secrets.token_hex(4)}"


@pytest.fixture
def host(postgres: Postgres, study: str, tmp_path: Path) -> Open:
    """Opens the store of one study as the host of that name does."""

    def opened(name: str) -> ObjectStore:
        return ObjectStore(tmp_path / name, Bucket(f"s3://lab/{study}"), Session(postgres.address(), "DB", study))

    return opened


def digest(content: bytes) -> bytes:
    return sha256(content).digest()


def names(store: ObjectStore) -> set[str]:
    return {name for name, _, _ in store.bucket.names()}


def table(store: ObjectStore) -> Path:
    return store.root / "tables" / "a.parquet"


def clear(store: ObjectStore) -> set[bytes]:
    """Remove whatever nobody names at this moment, however young; what was removed."""
    return {one.digest for one in remove(store, unused(store, grace_days=0))}


def test_what_no_row_and_no_segment_names_is_removed_and_the_rest_stays(host: Open) -> None:
    store = host("one")
    store.write({table(store): OLD})
    store.write({table(store): NEW})
    store.bucket.put(object_name(digest(LOST)), LOST)
    store.bucket.put("study.yaml", b"name: study")
    ledger = SharedLedger(store.session, "answers", store)
    write(ledger, answer("k", "left"))
    finish(ledger)
    there, gone = names(store), {object_name(digest(OLD)), object_name(digest(LOST))}
    assert len(there) == 5  # these four and a segment

    assert unused(store) == []  # nothing is older than the grace period
    found = unused(store, grace_days=0)
    assert {object_name(one.digest): one.size for one in found} == {
        object_name(digest(one)): len(one) for one in (OLD, LOST)
    }
    assert names(store) == there  # it was only looked
    assert {object_name(one.digest) for one in remove(store, found)} == gone
    assert names(store) == there - gone
    other = host("two")
    assert other.here(table(other)).read_bytes() == NEW
    assert SharedLedger(other.session, "answers", other).read("m").rows["k"]["text"] == "left"


def test_what_is_named_after_it_was_found_stays(host: Open) -> None:
    one, two = host("one"), host("two")
    one.write({table(one): OLD})
    one.write({table(one): NEW})
    found = unused(one, grace_days=0)
    two.write({table(two): OLD})  # as when a correction is taken back
    assert [each.digest for each in found] == [digest(OLD)]
    assert remove(one, found) == []
    three = host("three")
    assert three.here(table(three)).read_bytes() == OLD


def test_what_is_removed_between_its_upload_and_its_row_is_brought_again(
    host: Open, monkeypatch: pytest.MonkeyPatch
) -> None:
    one, two = host("one"), host("two")
    one.write({table(one): NEW})
    put, cleared = two.bucket.put, list[set[bytes]]()

    def put_and_then(name: str, content: bytes) -> None:
        put(name, content)
        if not cleared:
            cleared.append(clear(one))

    monkeypatch.setattr(two.bucket, "put", put_and_then)
    two.write({table(two): OLD})
    assert cleared == [{digest(OLD)}]
    three = host("three")
    assert three.here(table(three)).read_bytes() == OLD


def test_a_segment_that_is_removed_before_its_rows_leave_the_database_takes_none_of_them_along(
    host: Open, monkeypatch: pytest.MonkeyPatch
) -> None:
    one, two = host("one"), host("two")
    one.write({table(one): NEW})
    ledger = SharedLedger(two.session, "answers", two)
    write(ledger, answer("k", "left"))
    get, cleared = two.bucket.get, list[set[bytes]]()

    def get_and_then(name: str) -> bytes | None:
        content = get(name)
        cleared.append(clear(one))
        return content

    with monkeypatch.context() as between:
        between.setattr(two.bucket, "get", get_and_then)
        finish(ledger)
    assert [len(some) for some in cleared] == [1]
    assert in_database(ledger) == 1
    finish(ledger)  # the same rows, and so the same object
    assert in_database(ledger) == 0
    other = host("three")
    assert SharedLedger(other.session, "answers", other).read("m").rows["k"]["text"] == "left"


def test_an_object_whose_removal_broke_off_may_be_written_once_it_surely_ended(host: Open) -> None:
    store = host("one")
    store.write({table(store): NEW})
    store.session.run(lambda c: _tell(c, store.session.study_id, [digest(OLD)]))  # and then its process was killed

    def later() -> None:
        sql = "update traps.removed set at = at - make_interval(secs => %s) where study = %s"
        store.session.run(lambda c: c.execute(sql, [ENDS_S, store.session.study_id]))

    remedied(
        lambda: store.write({table(store): OLD}),
        "cluster.removal.forget",
        later,
    )
    assert store.bucket.get(object_name(digest(OLD))) == OLD


def test_a_database_that_names_nothing_of_the_store_is_refused(
    host: Open, postgres: Postgres, study: str, tmp_path: Path
) -> None:
    store = host("one")
    store.write({table(store): NEW})
    address = Bucket(f"s3://lab/{study}")
    other = ObjectStore(tmp_path / "other", address, Session(postgres.address(), "DB", f"{study}-other"))
    found = remedied(
        lambda: unused(other, grace_days=0),
        "cluster.unused.unused",
        again=lambda: unused(host("one"), grace_days=0),
    )
    assert found == [] and names(store) == {object_name(digest(NEW))}


def test_the_command_shows_and_removes_what_is_old_enough(
    s3: S3, postgres: Postgres, study: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Any
) -> None:
    monkeypatch.setenv(DATABASE, postgres.address())
    monkeypatch.setenv("TRAPS_SCRATCH", str(tmp_path / "scratch"))
    folder, address = tmp_path / "study", f"s3://lab/{study}"
    Workspace.create(folder, Study())
    workspace = Workspace.create(address, Study())
    store = workspace.store
    assert isinstance(store, ObjectStore)
    store.bucket.put(object_name(digest(LOST)), LOST)
    remedied(
        lambda: command("doctor", "--unused", "--workspace", folder),
        "study.doctor.examine_unused",
        again=lambda: command("doctor", "--unused", "--workspace", address),
    )
    assert "would be removed by `traps doctor --unused remove`" in capsys.readouterr().out
    command("doctor", "--unused", "remove", "--workspace", address)
    assert "0 objects" in capsys.readouterr().out  # it is younger than the grace period
    monkeypatch.setattr(module, "GRACE_DAYS", 0.0)
    command("doctor", "--unused", "show", "--workspace", address)
    assert "1 objects (0.0 MB), the oldest of" in capsys.readouterr().out
    command("doctor", "--unused", "remove", "--workspace", address)
    assert object_name(digest(LOST)) in capsys.readouterr().out
    assert store.bucket.get(object_name(digest(LOST))) is None
