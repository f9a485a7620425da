"""What errors about clips, prepared media, tables and ledgers say to do lets the same call succeed."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import pytest
from pydantic import ValidationError

from tests.postgres import Postgres
from tests.remedies.remedied import refused, remedied
from tests.storage.conftest import VARIABLE
from tests.storage.test_ledger import answer, write
from tests.storage.test_media import IMAGES, VIDEO, drawn, write_clip
from tests.storage.test_parquet import PARTITION, clip
from tests.storage.test_shared_ledger import _claimed, _lose_connection, two_of
from traps_pipeline.benchmark.tables import VIDEOS
from traps_pipeline.scenes.clips import check_clip
from traps_pipeline.scenes.encode import DamagedClip, count_frames, decode, decode_first
from traps_pipeline.storage import media
from traps_pipeline.storage.database import FORMAT, Session, session_of
from traps_pipeline.storage.media import MediaSpec, MediaStore, payload
from traps_pipeline.storage.parquet import TableStore
from traps_pipeline.storage.place import place_of
from traps_pipeline.storage.purse import Purse
from traps_pipeline.storage.segments import SegmentLedger
from traps_pipeline.storage.shared_ledger import SharedLedger
from traps_pipeline.storage.stream import Stream, encoded
from traps_pipeline.storage.study import Study
from traps_pipeline.storage.tables import Table
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
        "scenes/encode.py | {}: cannot be decoded ({}); delete the file and materialize videos again",
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
        "storage/media.py | {}: cannot be read ({}); materialize videos again",
        made_again,
        error=DamagedClip,
    )
    halve(path)
    remedied(
        lambda: store.prepare(path, digest, VIDEO),
        "is not the clip that was rendered (digest {}, not {}); delete the file and materialize videos again",
        made_again,
        error=DamagedClip,
    )
    size = path.stat().st_size
    halve(path)
    remedied(
        lambda: check_clip(path, digest, size),
        "truncated or altered); delete it and run again: it is rendered anew",
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
            "is not what was prepared ({}); delete it and run again: it is prepared anew",
            error=DamagedClip,
        )
        made.path.unlink(missing_ok=True)
        assert len(sent()) == made.n_frames
    note = next(store.folder.rglob("*.json"))
    note.write_text("{}")
    remedied(
        lambda: media.read_note(note),
        "storage/media.py | {}: {}; delete it and run again: it is prepared anew",
        lambda: (note.unlink(), MediaStore(store.folder).prepare(path, digest, IMAGES)),
        error=ValueError,
    )


def test_a_profile_is_sent_once_it_is_one_that_can_be(tmp_path: Path, store: MediaStore) -> None:
    remedied(
        lambda: MediaSpec.model_validate({"profile": "frames", "fps": 2, "uniform": 16}),
        "give fps or uniform, {}",
        again=lambda: MediaSpec.model_validate({"profile": "frames", "uniform": 16}),
        error=ValidationError,
    )
    clip_at = write_clip(tmp_path / "clip.mp4", 5)
    frames = store.prepare(*clip_at, MediaSpec(profile="frames", uniform=4))
    for spec in (VIDEO, IMAGES):
        remedied(
            lambda: payload(frames),
            "media.profile frames is not sent as bytes; use video or images for a model behind an API",
            again=lambda spec=spec: payload(store.prepare(*clip_at, spec)),
        )


def test_a_clip_whose_rate_no_video_can_have_is_sent_as_images(
    tmp_path: Path, store: MediaStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    clip_at = write_clip(tmp_path / "clip.mp4", 4)
    monkeypatch.setattr(media, "decode", lambda _: (np.stack(drawn(4)), np.arange(4) / 2.5))
    remedied(
        lambda: store.prepare(*clip_at, VIDEO),
        "a video can be sent at a whole number only: use profile images",
        again=lambda: store.prepare(*clip_at, IMAGES),
    )


def test_media_are_prepared_once_their_folder_can_be_made(tmp_path: Path) -> None:
    clip_at = write_clip(tmp_path / "clip.mp4", 4)
    (tmp_path / "media").write_text("a file")
    remedied(
        lambda: MediaStore(tmp_path / "media").prepare(*clip_at, IMAGES),
        "storage/media.py | {}: cannot be written ({}); {} and run again",
        lambda: (tmp_path / "media").rename(tmp_path / "away"),
    )


# --- tables -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("damage", "sentence"),
    [
        (lambda path: path.unlink(), "not there yet; materialize {} for this partition first"),
        (
            lambda path: path.write_bytes(b"PAR1 no table"),
            "not a readable {} table ({}); delete it and materialize again",
        ),
        (
            lambda path: path.write_bytes(path.read_bytes().replace(b"plinko-0001", b"plinko-0002")),
            "is not what was written (it was altered); run again, and it is made anew",
        ),
    ],
)
def test_a_table_that_is_made_again_is_read(tmp_path: Path, damage: Callable[[Path], object], sentence: str) -> None:
    store = TableStore(tmp_path)

    def made() -> None:
        store.path(VIDEOS, PARTITION).unlink(missing_ok=True)
        store.write(VIDEOS, PARTITION, [clip("plinko-0001")], {})

    made()
    damage(store.path(VIDEOS, PARTITION))
    assert list(remedied(lambda: store.read(VIDEOS, PARTITION), sentence, made)["scenario_id"]) == ["plinko-0001"]


@dataclass
class Plain:
    size: int


@dataclass
class Told:
    size: Annotated[int, "in metres"]


def test_a_column_that_says_its_meaning_is_a_column() -> None:
    columns = remedied(
        lambda: Table("plain", Plain, partition_by=(), key=("size",)).columns,
        "{}.{}: write Annotated[type, meaning and unit in words]",
        again=lambda: Table("told", Told, partition_by=(), key=("size",)).columns,
        error=TypeError,
    )
    assert [column.doc for column in columns] == ["in metres"]


def test_a_study_lies_in_a_folder_or_an_object_store(tmp_path: Path) -> None:
    for place in (str(tmp_path), "s3://bucket/study"):
        remedied(
            lambda: place_of("http://bucket/study"),
            "{}: is no place for a study; name a folder, or {}, and give keys in the environment",
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
        "not a ledger row ({}); remove that line and run again: its answer will be asked anew, all others are kept",
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
        "everything answered before is kept, only what was in flight is asked again",
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
    refused(call, "with the study's ledger; export {}=postgresql://USER:PASSWORD@HOST:5432/DATABASE")
    export("postgresql://[half")()
    refused(call, "is no address of a PostgreSQL database; write it as postgresql://USER:PASSWORD@HOST:5432/DATABASE")
    export(postgres.address(password="wrong"))()
    session = remedied(
        call,
        'See that the server runs and that address, user and password are right (`psql "${}"` tries them), then run',
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
        "and hosts of the study {} may be {} s apart; set the clocks of both by NTP, then run the same command again",
        set_clock,
    )
    assert session.study_id > 0


def test_tables_of_another_format_are_left_for_another_database(postgres: Postgres) -> None:
    session = Session(postgres.address(), VARIABLE, "formats")
    psycopg = pytest.importorskip("psycopg")
    with psycopg.connect(postgres.address(), autocommit=True) as connection:
        connection.execute("create database another")
    try:
        session.run(lambda connection: connection.execute("update traps.format set version = 99"))
        remedied(
            lambda: Session(postgres.address(), VARIABLE, "formats-2"),
            "this version reads {}; use the version that made them, or another database (study {})",
            again=lambda: Session(postgres.address(database="another"), VARIABLE, "formats-2"),
        )
    finally:
        session.run(lambda connection: connection.execute("update traps.format set version = %s", [FORMAT]))


def test_a_ledger_moves_once_what_stands_in_the_way_is_done_as_told(
    postgres: Postgres, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(VARIABLE, postgres.address())
    monkeypatch.setenv("ANOTHER", postgres.address())
    study = shared(tmp_path / "one")
    where = VARIABLE
    remedied(
        lambda: move_to_database(study, "postgresql://traps@127.0.0.1/postgres"),
        "--to: give the name of a variable of the environment, in capitals (LAB_DATABASE), that holds the address",
        again=lambda: move_to_database(study, where),
    )
    remedied(
        lambda: move_to_database(Workspace.open(study.root), "ANOTHER"),
        "the ledger lies in a database already ({}); move it back first (`traps ledger move --back`)",
        lambda: move_back(Workspace.open(study.root)),
    )
    other = shared(tmp_path / "other", study.study.name)
    remedied(
        lambda: move_to_database(Workspace.open(other.root), where),
        "which another folder uses; give this study another `name` in its study.yaml, or use another database",
        lambda: other.allow(name="other-2"),
    )
    assert Workspace.open(other.root).answers.read("m__standard__run1").rows["a"]["text"] == "left"

    async def while_asking() -> None:
        async with Workspace.open(other.root).answers.writing("m__standard__run1", print):
            await asyncio.to_thread(
                lambda: refused(
                    lambda: move_back(Workspace.open(other.root)), "{}; nothing was moved. Wait, then move the ledger"
                )
            )

    asyncio.run(while_asking())
    spender = Session(postgres.address(), VARIABLE, "other-2")
    purse = Purse(spender)
    purse.open()
    purse.grant("m", 0.0, 0.5, 0.5, {None: 1.0})
    remedied(
        lambda: move_back(Workspace.open(other.root)),
        "another process spends from the budget of {}; wait for it to finish",
        lambda: (purse.give_back({"m": 0.0}, {}), purse.close(), spender.close()),
    )
    move_to_database(Workspace.open(other.root), where)
    assert move_back(Workspace.open(other.root)).rows == 1


def test_what_a_silent_writer_had_not_stored_is_stored_by_the_same_command(postgres: Postgres) -> None:
    one, two = two_of(postgres)
    old, stream = _claimed(one), Stream(one.session)
    kept = stream.put(old, "answers", encoded((answer("a", "left"), {})))
    stream.store()
    kept.result()

    def store_late() -> None:
        late = stream.put(old, "answers", encoded((answer("b", "left"), {})))
        stream.store()
        late.result()

    _lose_connection(one, two)
    until = time.monotonic() + 540
    while isinstance(taken := two._try_claim("m"), str):  # a server that was just started may bring the holder back
        assert time.monotonic() < until
        time.sleep(0.2)
    assert taken.number == old.number + 1
    refused(
        store_late, "for too long. Nothing more is sent, and what it had not stored is refused. Run the same command"
    )
    _lose_connection(two, one)
    third = SharedLedger(Session(postgres.address(), VARIABLE, two.session.study), "answers")
    write(third, answer("b", "left"))
    assert list(third.read("m").rows) == ["a", "b"]
