"""What errors about clips, prepared media, tables and ledgers say to do lets the same call succeed."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.build.media import IMAGES, VIDEO, write_clip
from tests.build.video_rows import PARTITION, clip
from tests.postgres import Postgres
from tests.remedies.remedied import refused, remedied
from tests.storage.conftest import VARIABLE
from traps_pipeline.benchmark.tables import VIDEOS
from traps_pipeline.scenes.picture.encode import DamagedClip, count_frames, decode, decode_first
from traps_pipeline.scenes.worlds.clips import check_clip
from traps_pipeline.storage import media
from traps_pipeline.storage.database import Session, session_of
from traps_pipeline.storage.media import MediaStore, payload
from traps_pipeline.storage.parquet import TableStore
from traps_pipeline.storage.place import place_of
from traps_pipeline.storage.purse import Purse
from traps_pipeline.storage.segments import SegmentLedger
from traps_pipeline.storage.study import Study
from traps_pipeline.storage.workspace import Workspace
from traps_pipeline.study.ledger_move import move_back, move_to_database


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

    remedied(
        lambda: looks(path),
        "scenes.picture.encode",
        made_again,
        error=DamagedClip,
    )


def test_media_are_prepared_of_a_clip_that_was_made_again(tmp_path: Path, store: MediaStore) -> None:
    path, digest = write_clip(tmp_path / "clip.mp4", 5)

    def made_again() -> None:
        path.unlink(missing_ok=True)
        write_clip(path, 5)

    path.unlink()
    remedied(
        lambda: store.prepare(path, digest, IMAGES),
        "storage.media._require",
        made_again,
        error=DamagedClip,
    )
    halve(path)
    remedied(
        lambda: store.prepare(path, digest, VIDEO),
        "storage.media._require",
        made_again,
        error=DamagedClip,
    )
    size = path.stat().st_size
    halve(path)
    remedied(
        lambda: check_clip(path, digest, size),
        "scenes.worlds.clips.check_clip",
        made_again,
        error=DamagedClip,
    )


def test_prepared_media_that_are_deleted_are_prepared_anew(tmp_path: Path, store: MediaStore) -> None:
    path, digest = write_clip(tmp_path / "clip.mp4", 5)
    for damage in (halve, Path.unlink):
        made = store.prepare(path, digest, IMAGES)
        assert made.path is not None
        damage(made.path)

        def sent() -> list[bytes]:
            return payload(MediaStore(store.folder).prepare(path, digest, IMAGES))

        damaged = made
        refused(
            lambda damaged=damaged: payload(damaged),
            "storage.media.payload",
            error=DamagedClip,
        )
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


def test_media_are_prepared_once_their_folder_can_be_made(tmp_path: Path) -> None:
    clip_at = write_clip(tmp_path / "clip.mp4", 4)
    (tmp_path / "media").write_text("a file")
    remedied(
        lambda: MediaStore(tmp_path / "media").prepare(*clip_at, IMAGES),
        "storage.media._alone",
        lambda: (tmp_path / "media").rename(tmp_path / "away"),
    )


# --- tables -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("damage", "by"),
    [
        (lambda path: path.unlink(), "storage.parquet.TableStore._load"),
        (
            lambda path: path.write_bytes(b"PAR1 no table"),
            "storage.parquet._sound_bytes",
        ),
        (
            lambda path: path.write_bytes(path.read_bytes().replace(b"plinko-0001", b"plinko-0002")),
            "storage.parquet._sound_bytes",
        ),
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


def test_a_study_lies_in_a_folder_or_an_object_store(tmp_path: Path) -> None:
    for place in (str(tmp_path), "s3://bucket/study"):
        remedied(
            lambda: place_of("http://bucket/study"),
            "storage.place.place_of",
            again=lambda place=place: place_of(place),
        )


# --- ledgers ----------------------------------------------------------------------------------------------------------


def test_a_ledger_is_read_once_the_line_is_removed_and_its_answer_alone_is_missing(tmp_path: Path) -> None:
    ledger = SegmentLedger(tmp_path, "answers")
    ledger.folder("m").mkdir(parents=True)
    segment = ledger.folder("m") / "20261101T000000.jsonl"
    segment.write_text('{"key": "a"}\n{not json\n{"key": "c"}\n')
    known = remedied(
        lambda: ledger.read("m"),
        "storage.segments._read_segment",
        lambda: segment.write_text('{"key": "a"}\n{"key": "c"}\n'),
    )
    assert list(known.rows) == ["a", "c"]


def test_a_ledger_on_a_full_disk_goes_on_once_there_is_space(tiny_disk: Path) -> None:
    ledger, kept = SegmentLedger(tiny_disk, "answers"), list[str]()
    filler = tiny_disk / "filler"
    filler.write_bytes(b"0" * 57_000)

    def ask() -> None:
        with ledger.writer("m") as writer:
            for n in range(60):
                if f"k{n}" not in kept:
                    writer.append({"key": f"k{n}", "outcome": "answer", "text": "x" * 300})
                    kept.append(f"k{n}")

    remedied(
        ask,
        "storage.segments._writing",
        filler.unlink,
    )
    assert set(ledger.read("m").rows) == {f"k{n}" for n in range(60)}


def shared(root: Path, name: str = "") -> Workspace:
    workspace = Workspace.create(root, Study(name=name or root.name))
    with workspace.answers.writer("m__standard__run1") as writer:
        writer.append({"key": "a", "outcome": "answer", "text": "left", "cost_usd": 0.5})
    return workspace


def test_an_address_that_is_exported_and_right_leads_to_the_database(
    postgres: Postgres, monkeypatch: pytest.MonkeyPatch
) -> None:
    def export(address: str) -> Callable[[], None]:
        return lambda: monkeypatch.setenv(VARIABLE, address)

    def call() -> Session:
        return session_of(VARIABLE, "remedied")

    monkeypatch.delenv(VARIABLE, raising=False)
    refused(call, "storage.database.session_of")
    export("postgresql://[half")()
    refused(call, "storage.database.Session._connected")
    export(postgres.address(password="wrong"))()
    session = remedied(
        call,
        "storage.database.Session.run",
        export(postgres.address()),
    )
    assert session.study == "remedied"


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

    session = remedied(
        lambda: Session(late, VARIABLE, "clocks"),
        "storage.database.Session._compare_clocks",
        set_clock,
    )
    assert session.study_id > 0


def test_a_ledger_moves_once_what_stands_in_the_way_is_done_as_told(
    postgres: Postgres, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(VARIABLE, postgres.address())
    monkeypatch.setenv("ANOTHER", postgres.address())
    study = shared(tmp_path / "one")
    where = VARIABLE
    remedied(
        lambda: move_to_database(study, "postgresql://traps@127.0.0.1/postgres"),
        "study.ledger_move.move_to_database",
        again=lambda: move_to_database(study, where),
    )
    remedied(
        lambda: move_to_database(Workspace.open(study.root), "ANOTHER"),
        "study.ledger_move.move_to_database",
        lambda: move_back(Workspace.open(study.root)),
    )
    other = shared(tmp_path / "other", study.study.name)
    remedied(
        lambda: move_to_database(Workspace.open(other.root), where),
        "study.ledger_move._fill",
        lambda: other.allow(name="other-2"),
    )
    assert Workspace.open(other.root).answers.read("m__standard__run1").rows["a"]["text"] == "left"

    async def while_asking() -> None:
        async with Workspace.open(other.root).answers.writing("m__standard__run1", print):
            await asyncio.to_thread(
                lambda: refused(lambda: move_back(Workspace.open(other.root)), "study.ledger_move._nobody_asks")
            )

    asyncio.run(while_asking())
    spender = Session(postgres.address(), VARIABLE, "other-2")
    purse = Purse(spender)
    purse.open()
    purse.grant("m", 0.0, 0.5, 0.5, {None: 1.0})
    remedied(
        lambda: move_back(Workspace.open(other.root)),
        "study.ledger_move._move_out",
        lambda: (purse.give_back({"m": 0.0}, {}), purse.close(), spender.close()),
    )
    move_to_database(Workspace.open(other.root), where)
    assert move_back(Workspace.open(other.root)).rows == 1
