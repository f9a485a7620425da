"""What errors about clips, prepared media, tables and ledgers say to do lets the same call succeed."""

from __future__ import annotations

import os
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.build.ledger import answer, local, write
from tests.build.media import IMAGES, VIDEO, write_clip
from tests.build.video_rows import PARTITION, clip
from tests.ledger.conftest import VARIABLE
from tests.postgres import Postgres
from tests.remedies.remedied import refused, remedied
from traps_pipeline.ledger.postgres import PostgresDatabase, postgres_of
from traps_pipeline.ledger.transfer import export_ledger, import_ledger
from traps_pipeline.scenes.worlds.clips import check_clip
from traps_pipeline.storage import media
from traps_pipeline.storage.benchmark_tables import VIDEOS
from traps_pipeline.storage.media import MediaStore, payload
from traps_pipeline.storage.parquet import TableStore
from traps_pipeline.video.encode import DamagedClip, count_frames, decode, decode_first


@pytest.fixture
def store(tmp_path: Path) -> MediaStore:
    return MediaStore(tmp_path / "media")


def halve(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


@pytest.mark.parametrize("looks", [decode, count_frames, decode_first])
def test_a_clip_that_is_made_again_is_decoded(tmp_path: Path, looks: Callable[[Path], object]) -> None:
    path, _ = write_clip(tmp_path / "clip.mp4", 5)
    path.write_bytes(path.read_bytes()[:20])

    def made_again() -> None:
        path.unlink()
        write_clip(path, 5)

    remedied(lambda: looks(path), "video.encode", made_again, error=DamagedClip)


def test_media_are_prepared_of_a_clip_that_was_made_again(tmp_path: Path, store: MediaStore) -> None:
    path, digest = write_clip(tmp_path / "clip.mp4", 5)

    def made_again() -> None:
        path.unlink(missing_ok=True)
        write_clip(path, 5)

    path.unlink()
    remedied(lambda: store.prepare(path, digest, IMAGES), "storage.media", made_again, error=DamagedClip)
    halve(path)
    remedied(lambda: store.prepare(path, digest, VIDEO), "storage.media", made_again, error=DamagedClip)
    size = path.stat().st_size
    halve(path)
    remedied(lambda: check_clip(path, digest, size), "scenes.worlds.clips.check_clip", made_again, error=DamagedClip)


def test_prepared_media_that_are_deleted_are_prepared_anew(tmp_path: Path, store: MediaStore) -> None:
    path, digest = write_clip(tmp_path / "clip.mp4", 5)
    for damage in (halve, Path.unlink):
        made = store.prepare(path, digest, IMAGES)
        assert made.path is not None
        damage(made.path)

        def sent() -> list[bytes]:
            return payload(MediaStore(store.folder).prepare(path, digest, IMAGES))

        damaged = made
        refused(lambda damaged=damaged: payload(damaged), "storage.media.payload", error=DamagedClip)
        made.path.unlink(missing_ok=True)
        assert len(sent()) == made.n_frames
    note = next(store.folder.rglob("*.json"))
    note.write_text("{}")
    remedied(
        lambda: media.read_note(note),
        "storage.media.read_note",
        lambda: (note.unlink(), MediaStore(store.folder).prepare(path, digest, IMAGES)),
        error=ValueError,
    )


# --- tables -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("damage", "by"),
    [
        (lambda path: path.unlink(), "storage.parquet"),
        (lambda path: path.write_bytes(b"PAR1 no table"), "storage.parquet"),
        (lambda path: path.write_bytes(path.read_bytes().replace(b"plinko-0001", b"plinko-0002")), "storage.parquet"),
    ],
)
def test_a_table_that_is_made_again_is_read(tmp_path: Path, damage: Callable[[Path], object], by: str) -> None:
    store = TableStore(tmp_path)

    def made() -> None:
        store.path(VIDEOS, PARTITION).unlink(missing_ok=True)
        store.write(VIDEOS, PARTITION, [clip("plinko-0001")], {})

    made()
    damage(store.path(VIDEOS, PARTITION))
    assert list(remedied(lambda: store.read(VIDEOS, PARTITION), by, made)["scenario_id"]) == ["plinko-0001"]


# --- ledgers ----------------------------------------------------------------------------------------------------------


def test_a_ledger_on_a_full_disk_goes_on_once_there_is_space(tiny_disk: Path) -> None:
    subprocess.run(["mount", "-o", "remount,size=256k", str(tiny_disk)], check=True)  # the tables alone take 64 KiB
    filler = tiny_disk / "filler"
    write(local(tiny_disk), answer("k", "left"))
    filler.write_bytes(b"0" * os.statvfs(tiny_disk).f_bavail * os.statvfs(tiny_disk).f_bsize)
    rows = [answer(f"k{n}", "x" * 300) for n in range(20)]
    remedied(lambda: write(local(tiny_disk), *rows), "ledger.database.sentence", filler.unlink)
    assert set(local(tiny_disk).read("m").rows) == {"k", *(row["key"] for row in rows)}


def test_an_address_that_is_exported_and_right_leads_to_the_database(
    postgres: Postgres, monkeypatch: pytest.MonkeyPatch
) -> None:
    def export(address: str) -> Callable[[], None]:
        return lambda: monkeypatch.setenv(VARIABLE, address)

    def call() -> PostgresDatabase:
        return postgres_of(VARIABLE, "remedied")

    monkeypatch.delenv(VARIABLE, raising=False)
    refused(call, "ledger.postgres.postgres_of")
    export("postgresql://[half")()
    refused(call, "ledger.postgres")
    export(postgres.address(password="wrong"))()
    session = remedied(call, "ledger.postgres", export(postgres.address()))
    assert session.study_name == "remedied"


def test_a_host_whose_clock_is_an_hour_off_works_once_it_is_set(postgres: Postgres) -> None:
    """The database's clock is altered: nobody may set this machine's."""
    psycopg = pytest.importorskip("psycopg")
    with psycopg.connect(postgres.address(), autocommit=True) as connection:
        connection.execute("create database late")
        connection.execute("alter database late set search_path = altered, pg_catalog")
    late = postgres.address(database="late")
    with psycopg.connect(late, autocommit=True) as connection:
        connection.execute("create schema altered")
        connection.execute(
            """create function altered.clock_timestamp() returns timestamptz language sql
               as $$ select pg_catalog.clock_timestamp() + interval '1 hour' $$"""
        )

    def set_clock() -> None:
        with psycopg.connect(late, autocommit=True) as connection:
            connection.execute("drop function altered.clock_timestamp()")

    session = remedied(lambda: PostgresDatabase(late, VARIABLE, "clocks"), "ledger.postgres", set_clock)
    assert session.exists()


def test_a_ledger_is_exported_and_imported_once_what_stands_in_the_way_is_gone(tmp_path: Path) -> None:
    one, two = local(tmp_path / "one").database, local(tmp_path / "two").database
    write(local(tmp_path / "one"), answer("a", "left"))
    file = tmp_path / "file.sqlite"
    file.touch()
    remedied(lambda: export_ledger(one, file), "ledger.transfer.export_ledger", file.unlink)
    remedied(
        lambda: import_ledger(tmp_path / "none.sqlite", two),
        "ledger.transfer.import_ledger",
        again=lambda: import_ledger(file, two),
    )
    assert [*local(tmp_path / "two").read("m").rows] == ["a"]
