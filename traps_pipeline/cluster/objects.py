"""A study's files in an object store (S3, Google, Azure), for several hosts.

An object is written once, under the SHA-256 of its content, and never renamed. Which object is current under a path is
a row in PostgreSQL; rows change in one transaction, and the store is never listed. A host keeps what it has fetched in
its scratch folder, below `.objects` under the same digests, and links it to the paths that people and code know. What
is read has the size and the digest that the row says.
"""

from __future__ import annotations

import re
import threading
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path
from typing import TYPE_CHECKING, Any, LiteralString, TypeVar

from traps_pipeline.base.errors import TrapsError
from traps_pipeline.base.files import is_same_file, link, write_bytes
from traps_pipeline.cluster.bucket import Bucket, object_name
from traps_pipeline.cluster.removal import SCHEMA, forget, removed
from traps_pipeline.storage.database import Session, lock_number
from traps_pipeline.storage.store import Lease, Store, is_hidden
from traps_pipeline.storage.stream import stream_of

if TYPE_CHECKING:
    from psycopg import Connection

T = TypeVar("T")
R = TypeVar("R")

OBJECTS = ".objects"  # in a scratch folder: contents by digest
AT_ONCE = 16  # transfers side by side
MANY = ("clips/", "media/")  # of which a process knows only what it has asked for: there may be millions
_FEW: LiteralString = "number >= 0 and name not like all (%s)"
_LIKE = ([f"{folder}%" for folder in MANY],)
FRESH_S = 0.5  # a look at the rows that is younger is not repeated
TRIES = 2  # to read an object before it counts as altered
_SCHEMA = """
create table if not exists traps.changes (study int primary key references traps.studies, number bigint not null);
create table if not exists traps.objects (
    study int not null references traps.studies, name text not null,
    digest bytea, size bigint, note text,  -- of the object that is current; no digest: none is any more
    number bigint not null,  -- of the change; a later commit has a higher one, so that nobody overlooks it
    at timestamptz not null default clock_timestamp(), primary key (study, name));
create index if not exists objects_number on traps.objects (study, number);
"""


@dataclass(frozen=True, slots=True)
class Current:
    """What is current under a path: the object's digest and size, the note, and when it was written (ns since 1970)."""

    digest: bytes
    size: int
    note: str | None
    at_ns: int


class ObjectStore(Store):
    """Files of a study whose contents lie in a bucket and whose names lie in PostgreSQL. Threads may share it."""

    def __init__(self, root: Path, bucket: Bucket, session: Session) -> None:
        super().__init__(root)
        self.bucket, self.session = bucket, session
        self._rows: dict[str, Current] = {}
        self._names: dict[tuple[str, ...], set[str]] = {}  # by the folder that they lie below, at most two deep
        self._asked = set[str]()  # names in MANY that were looked up; of what changes later every host hears anyhow
        self._number, self._looked_at = -1, float("-inf")
        self._guard = threading.RLock()
        self._there = set[bytes]()  # digests of objects that this process has seen in the store
        self._whole = set[bytes]()  # digests of contents in the scratch folder that it has compared with their digest
        session.run(_prepare)

    # --- names ------------------------------------------------------------------------------------------------------

    def look(self) -> None:
        """See `Store`."""
        self._refresh(0.0)

    def _refresh(self, age_s: float = FRESH_S) -> None:
        with self._guard:
            if time.monotonic() - self._looked_at <= age_s:
                return
            began, study = time.monotonic(), self.session.study_id

            def work(connection: Connection[Any]) -> tuple[int, list[Any]]:
                # The number first: what is committed after it is seen, or seen once more the next time.
                found = connection.execute("select number from traps.changes where study = %s", [study]).fetchone()
                if self._number < 0:
                    return found[0] if found else 0, self._read(connection, _FEW, *_LIKE)
                newer = self._read(connection, "number > %s", self._number)
                return max([self._number, *(row[-1] for row in newer)]), newer

            self._number, rows = self.session.run(work)
            self._take(rows)
            self._looked_at = began

    def _read(self, connection: Connection[Any], condition: LiteralString, *values: Any) -> list[Any]:
        sql: LiteralString = """select name, digest, size, note, (extract(epoch from at) * 1e9)::bigint, number
                                from traps.objects where study = %s and """
        return connection.execute(sql + condition, [self.session.study_id, *values]).fetchall()

    def _take(self, rows: Iterable[Any]) -> None:
        for name, digest, size, note, at_ns, _ in rows:
            if digest is None:
                self._rows.pop(name, None)
                self._names.get(_group(name), set()).discard(name)
            else:
                self._names.setdefault(_group(name), set()).add(name)
                self._rows[name] = Current(bytes(digest), size, note, at_ns)

    def _ask(self, paths: Iterable[Path]) -> None:
        """Look up those of these names that are in MANY and were not looked up before."""
        names = {name for name in map(self._name, paths) if name.startswith(MANY)}
        with self._guard:
            if new := sorted(names - self._asked):
                self._refresh()  # from here on, of what changes everybody hears
                self._take(self.session.run(lambda c: self._read(c, "name = any(%s)", new)))
                self._asked |= {*new}

    def _name(self, path: Path) -> str:
        return path.relative_to(self.root).as_posix()

    def _current(self, path: Path) -> Current | None:
        self._refresh()
        self._ask([path])
        return self._rows.get(self._name(path))

    def _change(self, rows: Sequence[tuple[str, bytes | None, int | None, str | None]]) -> None:
        """Let other objects be current, all in one transaction. The row of the study's changes is locked until then,
        so that changes are numbered in the order in which they are seen."""
        study = self.session.study_id
        columns = [list(column) for column in zip(*rows, strict=True)]
        digests = [digest for _, digest, *_ in rows if digest is not None]

        def work(connection: Connection[Any]) -> list[bytes]:
            if gone := removed(connection, study, digests):
                return gone
            ((number,),) = connection.execute(
                """insert into traps.changes (study, number) values (%s, 1)
                   on conflict (study) do update set number = traps.changes.number + 1 returning number""",
                [study],
            ).fetchall()
            connection.execute(
                """insert into traps.objects (study, name, digest, size, note, number)
                   select %s, o.name, o.digest, o.size, o.note, %s
                   from unnest(%s::text[], %s::bytea[], %s::bigint[], %s::text[]) as o (name, digest, size, note)
                   on conflict (study, name) do update set digest = excluded.digest, size = excluded.size,
                       note = excluded.note, number = excluded.number, at = excluded.at""",
                [study, number, *columns],
            )
            return []

        if rows:
            while gone := self.session.run(work):
                forget(self.session, self.bucket.address, gone)
                _side_by_side(lambda d: self.bucket.put(object_name(d), self._cached(d).read_bytes()), gone)
            self.look()

    def _withdraw(self, lost: Iterable[bytes]) -> None:
        """Objects that are gone, or not what was written, are current no more: what needs them is made again."""
        gone = {*lost}
        with self._guard:
            self._there -= gone
            rows = self.session.run(lambda c: self._read(c, "digest = any(%s)", [*gone]))
            self._change([(row[0], None, None, None) for row in rows])

    # --- contents ---------------------------------------------------------------------------------------------------

    def _cached(self, digest: bytes) -> Path:
        return self.root / OBJECTS / object_name(digest)

    def _is_cached(self, digest: bytes) -> bool:
        path = self._cached(digest)
        if digest not in self._whole:
            try:
                if sha256(path.read_bytes()).digest() != digest:
                    return False
            except FileNotFoundError:
                return False
            self._whole.add(digest)
        return path.is_file()

    def content(self, digest: bytes, size: int) -> tuple[Path | None, str]:
        """The content of an object in the scratch folder, or what is wrong with it. Raises TrapsError where the store
        cannot be used."""
        path, wrong = self._cached(digest), ""
        if self._is_cached(digest):
            return path, ""
        for _ in range(TRIES):
            found = self.bucket.get(object_name(digest))
            if found is not None and len(found) == size and sha256(found).digest() == digest:
                write_bytes(path, found)
                self._whole.add(digest)
                self._there.add(digest)
                return path, ""
            wrong = "is gone from the store" if found is None else "is not what was written (it was altered)"
        return None, wrong

    def put(self, content: bytes) -> bytes:
        """Write an object that has no path; its digest. Raises TrapsError."""
        forget(self.session, self.bucket.address, [sha256(content).digest()])
        return self._put(content, None)

    def _fetched(self, row: Current, name: str) -> Path:
        """The content of an object in the scratch folder. Raises TrapsError where it is gone or altered."""
        path, wrong = self.content(row.digest, row.size)
        if path is not None:
            return path
        self._withdraw([row.digest])
        raise TrapsError(f"{self.bucket.address}/{name}: {wrong}; run again, and it is made anew")

    def here(self, path: Path) -> Path:
        """See `Store`."""
        row = self._current(path)
        if row is None:
            raise FileNotFoundError(f"{self.bucket.address}/{self._name(path)}")
        return self._fetched(row, self._name(path))

    def bring(self, paths: Iterable[Path]) -> None:
        """See `Store`. What is gone from the store and lies at its path still is left there."""

        def one(path: Path) -> None:
            row = self._current(path)
            if row is None or (is_same_file(path, self._cached(row.digest)) and self._is_cached(row.digest)):
                return
            if not self._is_cached(row.digest) and path.is_file() and sha256(path.read_bytes()).digest() == row.digest:
                link(path, self._cached(row.digest))
                return
            try:
                link(self._fetched(row, self._name(path)), path)
            except TrapsError:
                if self._current(path) is not None:
                    raise  # the store cannot be reached; where it has no such object, nobody has

        mine = {path for path in paths if path.is_relative_to(self.root)}
        self._ask(mine)
        _side_by_side(one, mine)

    def keep(self, paths: Iterable[Path]) -> None:
        """See `Store`."""

        def one(path: Path) -> tuple[str, bytes | None, int | None, str | None] | None:
            row = self._current(path)
            if row is not None and row.digest in self._there and is_same_file(path, self._cached(row.digest)):
                return None
            content = path.read_bytes()
            digest = self._put(content, None if row is None else row.digest)
            link(path, self._cached(digest))
            self._whole.add(digest)
            is_known = row is not None and row.digest == digest
            return None if is_known else (self._name(path), digest, len(content), None)

        kept = {*paths}
        self._ask(kept)
        self._change([row for row in _side_by_side(one, kept) if row is not None])

    def _put(self, content: bytes, current: bytes | None) -> bytes:
        """Bring a content to the store, unless it is what is current and is seen there; its digest. What is current no
        more may be gone from the store, whatever this process has seen."""
        digest = sha256(content).digest()
        name = object_name(digest)
        if digest != current or (digest not in self._there and self.bucket.size(name) != len(content)):
            self.bucket.put(name, content)
        self._there.add(digest)
        return digest

    def write(self, files: Mapping[Path, bytes], *, note: str | None = None, durable: bool = False) -> None:
        """See `Store`."""

        def one(path: Path) -> tuple[str, bytes | None, int | None, str | None]:
            content, row = files[path], self._current(path)
            digest = self._put(content, None if row is None else row.digest)
            if digest not in self._whole:
                write_bytes(self._cached(digest), content, durable=durable)
                self._whole.add(digest)
            return self._name(path), digest, len(content), note

        self._change(_side_by_side(one, {*files}))
        self.bring(files)

    def remove(self, paths: Iterable[Path]) -> None:
        """See `Store`."""
        named = [path for path in paths if self._current(path) is not None]
        self._change([(self._name(path), None, None, None) for path in named])
        for path in named:
            path.unlink(missing_ok=True)

    # --- what there is ----------------------------------------------------------------------------------------------

    def has(self, path: Path) -> bool:
        """See `Store`."""
        return self._current(path) is not None

    def sizes(self, paths: Iterable[Path]) -> dict[Path, int]:
        """See `Store`. Each object is looked for in the store, once a process."""
        rows = self._known(paths)
        unseen = {row.digest: row for row in rows.values() if row.digest not in self._there}
        found = dict(_side_by_side(lambda digest: (digest, self.bucket.size(object_name(digest))), {*unseen}))
        lost = {digest for digest, size in found.items() if size != unseen[digest].size}
        self._there |= found.keys() - lost
        if lost:
            self.bucket.get(object_name(next(iter(lost))))  # tells a bucket that is gone from one without this object
            self._withdraw(lost)
        return {path: row.size for path, row in rows.items() if row.digest not in lost}

    def there(self, paths: Iterable[Path]) -> set[Path]:
        """See `Store`."""
        return {*self._known(paths)}

    def digests(self, paths: Iterable[Path]) -> dict[Path, str]:
        """See `Store`. They are those of the rows."""
        return {path: row.digest.hex() for path, row in self._known(paths).items()}

    def _known(self, paths: Iterable[Path]) -> dict[Path, Current]:
        wanted = {*paths}
        self._ask(wanted)
        self._refresh()
        return {path: row for path in wanted if (row := self._rows.get(self._name(path))) is not None}

    def lease(self, name: str) -> Lease | None:
        """See `Store`. An advisory lock of this process's session."""
        lock = lock_number(f"{self.session.study}/lease/{name}")
        if not self.session.take(lock):
            return None
        stream_of(self.session).start()  # whose thread keeps the session alive while something is held
        return Lease(lambda: self.session.give_back(lock))

    def below(self, folder: Path, pattern: str = "**/*") -> list[Path]:
        """See `Store`."""
        self._refresh()
        if "*" not in pattern:
            return [folder / pattern] if self.has(folder / pattern) else []
        if f"{self._name(folder)}/".startswith(MANY):
            prefix = f"{self._name(folder)}/"
            self._take(self.session.run(lambda c: self._read(c, "starts_with(name, %s)", prefix)))
        start, group = f"{self._name(folder)}/", self._name(folder).split("/")[:2]
        with self._guard:
            near = [names for key, names in self._names.items() if list(key[: len(group)]) == group[: len(key)]]
            names = [name for of in near for name in of if name.startswith(start)]
        matches = re.compile(_regex(pattern)).fullmatch
        inside = {name.removeprefix(start) for name in names}
        return sorted(folder / name for name in inside if matches(name) and not is_hidden(Path(name)))

    def note(self, path: Path) -> str | None:
        """See `Store`."""
        row = self._current(path)
        return None if row is None else row.note

    def changed_ns(self, path: Path) -> int:
        """See `Store`."""
        row = self._current(path)
        return 0 if row is None else row.at_ns


def _group(name: str) -> tuple[str, ...]:
    return tuple(name.split("/")[:-1][:2])


def _regex(pattern: str) -> str:
    """What a pattern of `pathlib` means, as far as it is used here: `*` within a name, `**/` for any folders."""
    made = re.escape(pattern).replace(r"\*\*/", "(?:[^/]+/)*")
    return made.replace(r"\*", "[^/]*")


def _prepare(connection: Connection[Any]) -> None:
    """Make the tables if there are none."""
    connection.execute("select pg_advisory_xact_lock(%s)", [lock_number("schema")])
    for statement in _SCHEMA.split(";\n"):
        if statement.strip():
            connection.execute(statement)
    connection.execute(SCHEMA)


def _side_by_side(work: Callable[[T], R], of: Iterable[T]) -> list[R]:
    """What `work` returns of each, several at once."""
    each = list(of)
    if len(each) < 2:
        return [work(one) for one in each]
    with ThreadPoolExecutor(min(AT_ONCE, len(each))) as pool:
        return list(pool.map(work, each))
