"""A study's files: the same tests for a folder and for an object store, and what several hosts of one store see."""

from __future__ import annotations

import secrets
import socket
import subprocess
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import pytest

from tests.build.errors import raises
from tests.build.stores import database, opened, where
from tests.build.video_rows import clip
from tests.conftest import ROOT
from tests.objectstore import S3
from tests.postgres import Postgres
from traps_cluster.bucket import object_name
from traps_cluster.objects import OBJECTS, ObjectStore
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.storage.benchmark_tables import VIDEOS
from traps_pipeline.storage.leases import hold_lease, leased_ranges
from traps_pipeline.storage.parquet import TableStore
from traps_pipeline.storage.store import LEASES, FolderStore, Store

__all__ = ["where"]  # a fixture
PLINKO = {"category": "plinko"}


@dataclass(frozen=True)
class Hosts:
    """Hosts of one study. open: its files, as the host of that name sees them."""

    open: Callable[[str], Store]


@pytest.fixture(params=["folder", *(pytest.param(kind, marks=pytest.mark.slow) for kind in ("shared", "objects"))])
def hosts(request: pytest.FixtureRequest, tmp_path: Path) -> Hosts:
    """Processes that share a folder, and hosts that share a folder and a database, or a bucket."""
    if request.param == "folder":
        return Hosts(lambda name: FolderStore(tmp_path / "study"))
    if request.param == "shared":
        address, study = request.getfixturevalue("postgres").address(), f"study-{secrets.token_hex(4)}"
        return Hosts(lambda name: FolderStore(tmp_path / "study", database(address, study).lease))
    return request.getfixturevalue("bucket_hosts")


@pytest.fixture
def bucket_hosts(s3: S3, postgres: Postgres, tmp_path: Path) -> Hosts:
    study = f"study-{secrets.token_hex(4)}"
    return Hosts(lambda name: opened(str(tmp_path), postgres.address(), study, name))


def put(store: Store, name: str, content: bytes) -> Path:
    """Make a file and hand it over."""
    path = store.root / name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.unlink(missing_ok=True)
    path.write_bytes(content)
    store.keep([path])
    return path


def test_what_is_kept_on_one_host_is_brought_to_another(hosts: Hosts) -> None:
    one, other = hosts.open("one"), hosts.open("other")
    put(one, "clips/a/void.mp4", b"frames")
    there = other.root / "clips/a/void.mp4"
    other.look()
    assert other.has(there) and other.sizes([there]) == {there: 6}
    other.bring([there, other.root / "clips/a/none.mp4"])
    assert there.read_bytes() == other.here(there).read_bytes() == b"frames"


def test_the_newest_content_is_current_everywhere(hosts: Hosts) -> None:
    one, other = hosts.open("one"), hosts.open("other")
    path = other.root / "study.yaml"
    for content in (b"first", b"second", b"first"):
        one.write({one.root / "study.yaml": content})
        other.look()
        other.bring([path])
        assert other.here(path).read_bytes() == path.read_bytes() == content


def test_what_is_removed_is_nowhere(hosts: Hosts) -> None:
    one, other = hosts.open("one"), hosts.open("other")
    path = put(one, "checks/items/labels/plinko.json", b"1")
    one.remove([path, one.root / "checks/none.json"])
    other.look()
    for store in (one, other):
        path = store.root / "checks/items/labels/plinko.json"
        assert not store.has(path) and store.below(store.root / "checks") == [] and store.changed_ns(path) == 0
        with pytest.raises(FileNotFoundError):
            store.here(path).read_bytes()


def test_files_below_a_folder_are_found_by_pattern(hosts: Hosts) -> None:
    store = hosts.open("one")
    for name in ("tables/a/x=1/part.parquet", "tables/a/x=2/part.parquet", "tables/a/.hidden", "tables/ab/x=1/p", "b"):
        put(store, name, b"1")

    def found(folder: str, pattern: str = "**/*") -> list[str]:
        return [path.relative_to(store.root).as_posix() for path in store.below(store.root / folder, pattern)]

    assert found("tables/a") == ["tables/a/x=1/part.parquet", "tables/a/x=2/part.parquet"]
    assert found("tables") == [*found("tables/a"), "tables/ab/x=1/p"]
    assert found("tables/a", "x=*/part.parquet") == found("tables/a")
    assert found("tables/a", "x=2/part.parquet") == ["tables/a/x=2/part.parquet"]
    assert found("tables", "*") == found("none") == []


def test_a_table_of_one_host_is_read_on_another(hosts: Hosts) -> None:
    one, other = (TableStore(store.root / "tables", store) for store in (hosts.open("one"), hosts.open("other")))
    version = one.write(VIDEOS, PLINKO, [clip("plinko-0001")], {"scene_specs/plinko": "abc"}, failed=2, code="7")
    state = other.state(VIDEOS, PLINKO)
    assert state is not None and (state.version, state.failed, state.code, state.rows) == (version, 2, "7", 1)
    assert state.inputs == {"scene_specs/plinko": "abc"} and other.damage(VIDEOS, PLINKO, thorough=True) == ""
    assert other.partitions(VIDEOS) == [PLINKO]
    every = other.read(VIDEOS, PLINKO), other.read_all(VIDEOS), other.read_all(VIDEOS, category=("plinko", "dice"))
    assert [list(frame["scenario_id"]) for frame in every] == [["plinko-0001"]] * 3


def test_what_is_there_and_its_digests_are_known_without_its_contents(hosts: Hosts) -> None:
    one, other = hosts.open("one"), hosts.open("other")
    put(one, "clips/a/void.mp4", b"frames")
    other.look()
    there, none = other.root / "clips/a/void.mp4", other.root / "clips/a/none.mp4"
    assert other.there([there, none]) == {there}
    # printf frames | sha256sum
    assert other.digests([there, none]) == {there: "594cfd2607d4f09e1ce6241203e418cacfed545063792bc5eab7afaadbf0c4e0"}
    assert other.root == one.root or not there.exists()


def test_a_piece_of_work_is_one_processs_until_it_is_given_back(hosts: Hosts) -> None:
    one, other = hosts.open("one"), hosts.open("other")
    lease = one.lease("videos/plinko/000001")
    assert lease is not None and one.lease("videos/plinko/000001") is other.lease("videos/plinko/000001") is None
    beside = other.lease("videos/plinko/000002")
    assert beside is not None
    lease.close()
    again = other.lease("videos/plinko/000001")
    assert again is not None and one.lease("videos/plinko/000001") is None
    for held in (beside, again):
        held.close()
    assert not (one.root / LEASES).exists()


HOLDING = """
import os, sys, time
from pathlib import Path
from tests.build.stores import opened
store = opened(*sys.argv[1:])
lease = store.lease("work")
print("held" if lease else "not held", flush=True)
sys.stdin.read()
"""


def test_what_a_killed_process_held_is_free_again(where: Sequence[str]) -> None:
    store = opened(*where, "other")
    command = [sys.executable, "-c", HOLDING, *where, "one"]
    with subprocess.Popen(command, cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None and process.stdout.readline() == "held\n"
        assert store.lease("work") is None
        process.kill()
        process.wait()
        with hold_lease(store, "work"):
            assert store.lease("work") is None


def test_ranges_are_shared_and_those_that_others_have_come_last(hosts: Hosts) -> None:
    one, other = hosts.open("one"), hosts.open("other")
    theirs = leased_ranges(other, "items", 10, 4)
    assert next(theirs) == range(4)
    mine = leased_ranges(one, "items", 10, 4)
    assert [next(mine), next(mine)] == [range(4, 8), range(8, 10)]
    theirs.close()
    assert [*mine] == [range(4)]


# --- of an object store alone -----------------------------------------------------------------------------------------


def test_a_reader_keeps_the_content_that_it_began_to_read(bucket_hosts: Hosts) -> None:
    store = bucket_hosts.open("one")
    path = put(store, "tables/t/part.parquet", b"old")
    began = store.here(path)
    store.write({path: b"new"})
    assert began.read_bytes() == b"old" and store.here(path).read_bytes() == b"new"


def test_equal_contents_are_one_object_named_by_its_digest(bucket_hosts: Hosts, s3: S3) -> None:
    store = bucket_hosts.open("one")
    assert isinstance(store, ObjectStore)
    for name in ("clips/a.mp4", "clips/b.mp4"):
        put(store, name, b"frames")
    digest = "594cfd2607d4f09e1ce6241203e418cacfed545063792bc5eab7afaadbf0c4e0"  # printf frames | sha256sum
    folder = store.bucket.address.removeprefix("s3://lab/")
    assert [name for name in s3.names() if name.startswith(folder)] == [f"{folder}/{digest[:2]}/{digest}"]


def test_what_is_gone_from_the_store_is_current_no_more_and_can_be_made_again(bucket_hosts: Hosts, s3: S3) -> None:
    one, other = bucket_hosts.open("one"), bucket_hosts.open("other")
    put(one, "clips/a.mp4", b"frames")
    s3.empty()
    s3.make_bucket()
    other.look()
    path = other.root / "clips/a.mp4"
    assert other.sizes([path]) == {} and not other.has(path)
    one.look()
    put(one, "clips/a.mp4", b"frames")  # the same digest, uploaded again though this host had seen it there
    other.look()
    assert other.sizes([path]) == {path: 6}


def test_an_object_that_was_altered_is_named_and_nothing_is_read_from_it(bucket_hosts: Hosts) -> None:
    one, other = bucket_hosts.open("one"), bucket_hosts.open("other")
    assert isinstance(one, ObjectStore)
    path = put(one, "tables/t/part.parquet", b"whole")
    (row,) = one._known([path]).values()
    for altered in (b"whale", b"who"):
        one.bucket.put(object_name(row.digest), altered)
        other.look()
        there = other.root / "tables/t/part.parquet"
        with raises(TrapsError, "traps_cluster.objects.ObjectStore.here", "tables/t/part.parquet"):
            other.here(there)
        assert not other.has(there)
        one.look()
        one._stored.clear()
        put(one, "tables/t/part.parquet", b"whole")
    other.look()
    assert other.here(there).read_bytes() == b"whole"


@pytest.mark.parametrize("in_place", [False, True])  # in place also under the path, which is a link to the content
def test_a_scratch_folder_may_be_lost_or_altered_at_any_time(bucket_hosts: Hosts, in_place: bool) -> None:
    one, other = bucket_hosts.open("one"), bucket_hosts.open("other")
    put(one, "clips/a.mp4", b"frames")
    there = other.root / "clips/a.mp4"
    other.look()
    other.bring([there])
    for cached in (path for path in (other.root / OBJECTS).rglob("*") if path.is_file()):
        if not in_place:
            cached.unlink()
        cached.write_bytes(b"rotten")
    later = bucket_hosts.open("other")
    later.bring([there])
    assert later.here(there).read_bytes() == there.read_bytes() == b"frames"


def test_a_bucket_that_is_gone_is_no_reason_to_forget_its_files(bucket_hosts: Hosts, s3: S3) -> None:
    one, other = bucket_hosts.open("one"), bucket_hosts.open("other")
    path = put(one, "clips/a.mp4", b"frames")
    s3.empty()
    try:
        other.look()
        for look in (lambda: other.here(other.root / "clips/a.mp4"), lambda: other.sizes([other.root / "clips/a.mp4"])):
            with raises(TrapsError, "traps_cluster.bucket.Bucket._used", "s3://lab/study-", socket.gethostname()):
                look()
        assert other.has(other.root / "clips/a.mp4") and one.has(path)
    finally:
        s3.make_bucket()


def test_more_names_are_looked_up_at_once_than_a_statement_takes_values(bucket_hosts: Hosts) -> None:
    store = bucket_hosts.open("one")
    path = put(store, "clips/a.mp4", b"frames")
    others = [store.root / "clips" / f"{number}.mp4" for number in range(70_000)]  # PostgreSQL takes 65,535
    assert store.there([path, *others]) == {path}


def test_changes_of_hosts_at_once_are_all_seen(bucket_hosts: Hosts) -> None:
    from concurrent.futures import ThreadPoolExecutor

    stores = [bucket_hosts.open(f"host{number}") for number in range(4)]

    def write(number: int) -> None:
        for turn in range(10):
            stores[number].write({stores[number].root / f"tables/{number}/{turn}": f"{number} {turn}".encode()})

    with ThreadPoolExecutor(4) as pool:
        list(pool.map(write, range(4)))
    for store in stores:
        store.look()
        assert len(store.below(store.root / "tables")) == 40
