"""What nobody names any more is removed from a study's store, and nothing else is."""

from __future__ import annotations

import secrets
from collections.abc import Callable
from hashlib import sha256
from pathlib import Path
from typing import Any

import pytest

from tests.objectstore import S3
from tests.postgres import Postgres
from tests.remedies.remedied import command, remedied
from traps_cluster import objects
from traps_cluster.bucket import Bucket, object_name
from traps_cluster.objects import ObjectStore
from traps_cluster.postgres import PostgresDatabase
from traps_pipeline.storage.study import Study
from traps_pipeline.storage.workspace import DATABASE, Workspace

Open = Callable[[str], ObjectStore]
OLD, NEW, LOST = b"an older table", b"the table", b"written, and its host died before it was named"


def opened_store(postgres: Postgres, root: Path, bucket: str, study: str) -> ObjectStore:
    """A host's store of a study, in the bucket of one that may be another."""
    database = PostgresDatabase(postgres.address(), "DB", study)
    return ObjectStore(root, Bucket(f"s3://lab/{bucket}"), database)


@pytest.fixture
def study(s3: S3) -> str:
    return f"study-{secrets.token_hex(4)}"


@pytest.fixture
def host(postgres: Postgres, study: str, tmp_path: Path) -> Open:
    """Opens the store of one study as the host of that name does."""

    def opened(name: str) -> ObjectStore:
        return opened_store(postgres, tmp_path / name, study, study)

    return opened


def digest(content: bytes) -> bytes:
    return sha256(content).digest()


def names(store: ObjectStore) -> set[str]:
    return {name for name, _, _ in store.bucket.names()}


def table(store: ObjectStore) -> Path:
    return store.root / "tables" / "a.parquet"


def clear(store: ObjectStore) -> set[str]:
    """Remove whatever nobody names at this moment, however young; return its names."""
    return {one.name for one in store.unused(is_removed=True, grace_days=0)}


def test_what_no_row_names_is_removed_and_the_rest_stays(host: Open) -> None:
    store = host("one")
    store.write({table(store): OLD})
    store.write({table(store): NEW})
    store.bucket.put(object_name(digest(LOST)), LOST)
    store.bucket.put("study.yaml", b"name: study")
    there, gone = names(store), {object_name(digest(OLD)), object_name(digest(LOST))}
    assert len(there) == 4

    assert store.unused() == []  # nothing is older than the grace period
    sizes = {one.name: one.size for one in store.unused(grace_days=0)}
    assert sizes == {object_name(digest(one)): len(one) for one in (OLD, LOST)}
    assert names(store) == there  # it was only looked
    assert clear(store) == gone
    assert names(store) == there - gone
    other = host("two")
    assert other.here(table(other)).read_bytes() == NEW


def test_what_is_named_while_it_is_removed_stays(host: Open, monkeypatch: pytest.MonkeyPatch) -> None:
    one, two = host("one"), host("two")
    one.write({table(one): OLD})
    one.write({table(one): NEW})
    remove, old = one.names.remove, object_name(digest(OLD))

    def name_it_and_remove(*arguments: Any) -> Any:
        two.write({table(two): OLD})  # as when a correction is taken back
        return remove(*arguments)

    monkeypatch.setattr(one.names, "remove", name_it_and_remove)
    assert [each.name for each in one.unused(grace_days=0)] == [old]
    assert old not in clear(one)
    three = host("three")
    assert three.here(table(three)).read_bytes() == OLD


def test_what_is_removed_between_its_upload_and_its_row_is_brought_again(
    host: Open, monkeypatch: pytest.MonkeyPatch
) -> None:
    one, two = host("one"), host("two")
    one.write({table(one): NEW})
    put, cleared = two.bucket.put, list[set[str]]()

    def put_and_then(name: str, content: bytes) -> None:
        put(name, content)
        if not cleared:
            cleared.append(clear(one))
            two.look()  # as another thread of the process does

    monkeypatch.setattr(two.bucket, "put", put_and_then)
    two.write({table(two): OLD})
    assert cleared == [{object_name(digest(OLD))}]
    three = host("three")
    assert three.here(table(three)).read_bytes() == OLD


def test_what_was_seen_before_it_was_removed_is_brought_again(host: Open) -> None:
    one, two = host("one"), host("two")
    one.write({table(one): OLD})
    two.look()
    assert two.sizes([table(two)])  # it has seen the object
    one.write({table(one): NEW})
    assert clear(one) == {object_name(digest(OLD))}
    two.look()
    two.write({table(two): OLD})
    three = host("three")
    assert three.here(table(three)).read_bytes() == OLD


def test_a_database_that_names_nothing_of_the_store_is_refused(
    host: Open, postgres: Postgres, study: str, tmp_path: Path
) -> None:
    store = host("one")
    store.write({table(store): NEW})
    other = opened_store(postgres, tmp_path / "other", study, f"{study}-other")
    found = remedied(
        lambda: other.unused(grace_days=0),
        "traps_cluster.objects.ObjectStore.unused",
        again=lambda: host("one").unused(grace_days=0),
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
        "checks.doctor.examine_unused",
        again=lambda: command("doctor", "--unused", "--workspace", address),
    )
    assert "`traps doctor --unused remove`" in capsys.readouterr().out
    command("doctor", "--unused", "remove", "--workspace", address)
    assert "0 objects" in capsys.readouterr().out  # it is younger than the grace period
    monkeypatch.setattr(objects, "GRACE_DAYS", 0.0)
    command("doctor", "--unused", "show", "--workspace", address)
    shown = capsys.readouterr().out
    assert "1 object" in shown and object_name(digest(LOST)) in shown
    command("doctor", "--unused", "remove", "--workspace", address)
    assert object_name(digest(LOST)) in capsys.readouterr().out
    assert store.bucket.get(object_name(digest(LOST))) is None
