"""Finished evaluations leave the database: their rows become immutable segments in the object store.

A segment is a Parquet file of rows as the database had them, under the SHA-256 of its content. A row of
`traps.segments` names it, and is written in the transaction that deletes the rows; until then the object is one that
nobody refers to. Segments and rows are read as one ledger (`storage/shared_ledger.py`).
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path
from typing import TYPE_CHECKING, Any

from traps_pipeline.base.errors import TrapsError
from traps_pipeline.storage.database import Claim, Session
from traps_pipeline.storage.ledger import ASIDES

if TYPE_CHECKING:
    from psycopg import Connection


FETCHED = 2000  # rows of a ledger that are held at once while it is read
SEGMENT = 20_000  # rows of a segment at most
COLUMNS = ("line", *ASIDES)


@dataclass(frozen=True)
class Segment:
    """Rows of an evaluation in the store. size: of the object, in bytes."""

    id: int
    digest: bytes
    size: int
    rows: int


def segments_of(connection: Connection[Any], slot: Sequence[Any]) -> list[Segment]:
    """The segments of an evaluation, the oldest first. slot: study, kind and name."""
    sql = """select s.id, s.digest, s.size, s.rows from traps.segments s join traps.evaluations e on e.id = s.evaluation
             where e.study = %s and e.kind = %s and e.name = %s order by s.id"""
    return [Segment(number, bytes(digest), *its) for number, digest, *its in connection.execute(sql, slot).fetchall()]


class Segments:
    """The segments of a study's ledger. store: None where the study lies in a folder, and has none."""

    def __init__(self, session: Session, store: Any, kind: str) -> None:
        self._session, self._store, self._kind = session, store, kind

    def rows(
        self, segment: Segment, evaluation: str, columns: Sequence[str], wanted: Collection[str] | None = None
    ) -> Iterator[Sequence[Any]]:
        """Number, key and columns of the rows of a segment (of the wanted keys), the oldest first. Raises TrapsError
        where it is gone or altered: nothing of it is believed."""
        import pyarrow as pa
        import pyarrow.compute as pc
        import pyarrow.parquet as pq

        path, wrong = self._content(segment, evaluation)
        if path is None:
            raise TrapsError(wrong)
        keys = None if wanted is None else pa.array([*wanted], pa.string())
        with pq.ParquetFile(path) as file:
            for batch in file.iter_batches(FETCHED, columns=["id", "key", *columns]):
                mine = batch if keys is None else batch.filter(pc.is_in(batch["key"], value_set=keys))  # pyright: ignore
                yield from zip(*(mine[name].to_pylist() for name in ("id", "key", *columns)), strict=True)

    def damage(self, segment: Segment, evaluation: str) -> str:
        """What is wrong with a segment, in a sentence; empty where it is what was written."""
        return self._content(segment, evaluation)[1]

    def _content(self, segment: Segment, evaluation: str) -> tuple[Path | None, str]:
        what = f"{segment.rows} {self._kind} of {evaluation}"
        if self._store is None:
            return None, (
                f"{self._session.host}: {what} lie in the object store of the study {self._session.study}; open the "
                "study at its address (TRAPS_WORKSPACE=s3://BUCKET/STUDY)"
            )
        path, wrong = self._store.content(segment.digest, segment.size)
        return path, wrong and (
            f"{self._store.bucket.address}/{segment.digest.hex()}: holds {what}, which were paid for, and "
            f"{wrong}; put it back from a copy (a host that has read it has one below .objects in its scratch folder) "
            "and run the same command again: none of them is asked meanwhile"
        )

    def compact(self, claim: Claim) -> int:
        """Let all rows of an evaluation whose writer this process is become segments; how many. Raises TrapsError where
        the store cannot be used, or another process has taken over."""
        count, study = 0, self._session.study_id
        while self._store is not None and (written := self._encoded(claim)) is not None:
            content, first, last, rows = written
            digest = self._store.put(content)
            if (kept := self._store.bucket.get(digest.hex())) is None or sha256(kept).digest() != digest:
                return count  # the store does not give back what it took; the rows stay where they are
            segment = Segment(0, digest, len(content), rows)
            if not self._session.run(lambda c, s=segment, f=first, n=last: _release(c, study, claim, s, f, n)):
                return count
            count += rows
        return count

    def _encoded(self, claim: Claim) -> tuple[bytes, int, int, int] | None:
        """The oldest rows of an evaluation as a segment: its content, the first and last number, how many. None where
        there are none."""
        import pyarrow as pa
        import pyarrow.parquet as pq

        names = ["id", "key", *COLUMNS]
        schema = pa.schema([("id", pa.int64()), ("key", pa.string()), *((name, pa.binary()) for name in COLUMNS)])
        numbers, buffer = list[int](), pa.BufferOutputStream()
        with pq.ParquetWriter(buffer, schema, compression="zstd", use_dictionary=False) as writer:
            while len(numbers) < SEGMENT and (page := self._page(claim, numbers[-1] if numbers else 0)):
                writer.write_table(pa.table(dict(zip(names, map(list, zip(*page, strict=True)), strict=True)), schema))
                numbers += [row[0] for row in page]
        return (buffer.getvalue().to_pybytes(), numbers[0], numbers[-1], len(numbers)) if numbers else None

    def _page(self, claim: Claim, last: int) -> list[Any]:
        sql = """select id, key, line, reasoning, raw from traps.rows where evaluation = %s and id > %s
                 order by id limit %s"""
        return self._session.run(lambda c: c.execute(sql, [claim.evaluation, last, FETCHED]).fetchall())


def _release(connection: Connection[Any], study: int, claim: Claim, segment: Segment, first: int, last: int) -> bool:
    """Put a segment in the place of its rows, unless another process is the evaluation's writer by now, or its object
    is being removed; whether it is there. What was committed when the connection broke is not done again."""
    sql = "select number from traps.evaluations where id = %s for update"
    if connection.execute(sql, [claim.evaluation]).fetchone() != (claim.number,):
        claim.lost = True
        return False
    sql = """insert into traps.segments (evaluation, digest, size, rows) values (%s, %s, %s, %s)
             on conflict do nothing returning id"""
    values = [claim.evaluation, segment.digest, segment.size, segment.rows]
    if connection.execute(sql, values).fetchall():
        sql = "delete from traps.rows where evaluation = %s and id between %s and %s"
        deleted = connection.execute(sql, [claim.evaluation, first, last]).rowcount
        assert deleted == segment.rows, f"{claim.name}: {deleted} rows in the place of {segment.rows}"
    return True
