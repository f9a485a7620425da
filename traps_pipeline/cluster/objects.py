"""Store a study's files in an object store (S3, Google, Azure), for several hosts.

An object is written once, under the SHA-256 of its content, and never renamed; `object_names.py` maps paths to objects.
A host caches what it has fetched in its scratch folder, below `.objects` under the same digests, and links it to the
paths that people and code use. Size and digest of every read content are compared with its row.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from datetime import UTC, datetime, timedelta
from hashlib import sha256
from pathlib import Path
from typing import TypeVar

from traps_pipeline.base.errors import TrapsError
from traps_pipeline.base.files import is_same_file, link, write_bytes
from traps_pipeline.cluster.bucket import Bucket, object_name
from traps_pipeline.cluster.object_names import CurrentObject, ObjectNames
from traps_pipeline.ledger.postgres import PostgresDatabase
from traps_pipeline.storage.place import STUDY
from traps_pipeline.storage.store import GRACE_DAYS, Lease, Store, UnusedObject, is_hidden

T = TypeVar("T")
R = TypeVar("R")

OBJECTS = ".objects"  # in a scratch folder: contents by digest
AT_ONCE = 16  # concurrent transfers
BATCH = 1000  # objects removed per request
_OBJECT = re.compile(r"([0-9a-f]{2})/(\1[0-9a-f]{62})")


def lease(database: PostgresDatabase, name: str) -> Lease | None:
    """Take a lease as `Store.lease` says: an advisory lock, which this process keeps alive."""
    with ExitStack() as opened:
        opened.enter_context(database.writing())
        lock = database.try_lock(f"lease/{name}")
        if lock is None:
            return None
        opened.callback(lock.release)
        return Lease(opened.pop_all().close)


class ObjectStore(Store):
    """A study's files: names in its database, contents in a bucket; thread-safe.

    anchor: the content of the only object with a fixed name, which locates the study's database.
    """

    def __init__(self, root: Path, bucket: Bucket, database: PostgresDatabase, study: str, anchor: bytes) -> None:
        super().__init__(root)
        self.bucket, self._database, self._study, self._anchor = bucket, database, study, anchor
        self.names = ObjectNames(database, study)
        self._stored = set[tuple[bytes, int]]()  # digests of objects seen in the store, with `removals` at that time
        self._verified = set[bytes]()  # verified digests of contents in the scratch folder

    def look(self) -> None:
        """See `Store`."""
        self.names.look()

    def _name(self, path: Path) -> str:
        return path.relative_to(self.root).as_posix()

    def _known(self, paths: Iterable[Path]) -> dict[Path, CurrentObject]:
        names = {path: self._name(path) for path in paths}
        current = self.names.current({*names.values()})
        return {path: current[name] for path, name in names.items() if name in current}

    def _current(self, path: Path) -> CurrentObject | None:
        return self._known([path]).get(path)

    def _change(self, changed: Mapping[Path, CurrentObject | None], removals: int) -> None:
        named = {self._name(path): row for path, row in changed.items()}
        while (now := self.names.change(named, removals)) != removals:
            removals = now
            for row in changed.values():
                if row is not None:
                    self.bucket.put(object_name(row.digest), self._cached(row.digest).read_bytes())

    def _withdraw(self, lost: Iterable[bytes]) -> None:
        """Remove the names of lost or altered objects, so that dependents are rebuilt."""
        lost_digests = {*lost}
        self._stored = {entry for entry in self._stored if entry[0] not in lost_digests}
        named = self.names.naming(lost_digests)
        self._change({self.root / name: None for name in named}, self.names.removals)

    # --- contents ---------------------------------------------------------------------------------------------------

    def _cached(self, digest: bytes) -> Path:
        return self.root / OBJECTS / object_name(digest)

    def _is_cached(self, digest: bytes) -> bool:
        path = self._cached(digest)
        if digest not in self._verified and path.is_file() and sha256(path.read_bytes()).digest() == digest:
            self._verified.add(digest)
        return digest in self._verified and path.is_file()

    def _cache(self, digest: bytes, content: bytes, *, durable: bool = False) -> Path:
        if not self._is_cached(digest):
            write_bytes(self._cached(digest), content, durable=durable)
            self._verified.add(digest)
        return self._cached(digest)

    def _is_stored(self, digest: bytes) -> bool:
        return (digest, self.names.removals) in self._stored

    def _put(self, content: bytes, row: CurrentObject | None, removals: int) -> bytes:
        """Upload a content unless current and still stored; return its digest."""
        digest = sha256(content).digest()
        is_current = row is not None and row.digest == digest
        if not (is_current and (self._is_stored(digest) or self.bucket.size(object_name(digest)) == len(content))):
            self.bucket.put(object_name(digest), content)
        self._stored.add((digest, removals))
        return digest

    def _fetched(self, row: CurrentObject, path: Path) -> Path:
        """Return an object's local file. Raises TrapsError if it is lost or altered."""
        if self._is_cached(row.digest):
            return self._cached(row.digest)
        removals, content = self.names.removals, self.bucket.get(object_name(row.digest))
        if content is not None and len(content) == row.size and sha256(content).digest() == row.digest:
            self._stored.add((row.digest, removals))
            return self._cache(row.digest, content)
        self._withdraw([row.digest])
        wrong = "is gone from the store" if content is None else "is not what was written (it was altered)"
        raise TrapsError(f"{self.bucket.address}/{self._name(path)}: {wrong}; materialize it again")

    def here(self, path: Path) -> Path:
        """See `Store`."""
        row = self._current(path)
        if row is None:
            raise FileNotFoundError(f"{self.bucket.address}/{self._name(path)}")
        return self._fetched(row, path)

    def bring(self, paths: Iterable[Path]) -> None:
        """See `Store`; a local file stays if the store has lost its object."""

        def one(known: tuple[Path, CurrentObject]) -> None:
            path, row = known
            cached = self._cached(row.digest)
            if not self._is_cached(row.digest) and path.is_file() and sha256(path.read_bytes()).digest() == row.digest:
                link(path, cached)
            try:
                if not (self._is_cached(row.digest) and is_same_file(path, cached)):
                    link(self._fetched(row, path), path)
            except TrapsError:
                if self._current(path) is not None:
                    raise  # the store is unreachable, so a missing object cannot be told from a lost one

        _side_by_side(one, self._known(path for path in paths if path.is_relative_to(self.root)).items())

    def keep(self, paths: Iterable[Path]) -> None:
        """See `Store`."""
        names = {*paths}
        current, removals = self._known(names), self.names.removals

        def one(path: Path) -> tuple[Path, CurrentObject] | None:
            row = current.get(path)
            if row is not None and self._is_stored(row.digest) and is_same_file(path, self._cached(row.digest)):
                return None
            content = path.read_bytes()
            digest = self._put(content, row, removals)
            link(path, self._cached(digest))
            self._verified.add(digest)
            return None if row is not None and row.digest == digest else (path, CurrentObject(digest, len(content)))

        self._change(dict(pair for pair in _side_by_side(one, names) if pair is not None), removals)

    def write(self, files: Mapping[Path, bytes], *, note: str | None = None, durable: bool = False) -> None:
        """See `Store`."""
        current, removals = self._known(files), self.names.removals

        def one(path: Path) -> tuple[Path, CurrentObject]:
            digest = self._put(files[path], current.get(path), removals)
            self._cache(digest, files[path], durable=durable)
            return path, CurrentObject(digest, len(files[path]), note)

        self._change(dict(_side_by_side(one, files)), removals)
        self.bring(files)
        if self.root / STUDY in files:
            self.bucket.put(STUDY, self._anchor)  # last, so that it vouches for the study

    def remove(self, paths: Iterable[Path]) -> None:
        """See `Store`."""
        named = self._known(paths)
        self._change(dict.fromkeys(named), self.names.removals)
        for path in named:
            path.unlink(missing_ok=True)

    # --- what there is ----------------------------------------------------------------------------------------------

    def has(self, path: Path) -> bool:
        """See `Store`."""
        return self._current(path) is not None

    def sizes(self, paths: Iterable[Path]) -> dict[Path, int]:
        """See `Store`; each object is checked in the store, once per process."""
        rows, removals = self._known(paths), self.names.removals
        unseen = {row.digest: row for row in rows.values() if not self._is_stored(row.digest)}
        sizes = dict(_side_by_side(lambda digest: (digest, self.bucket.size(object_name(digest))), unseen))
        lost = {digest for digest, size in sizes.items() if size != unseen[digest].size}
        self._stored |= {(digest, removals) for digest in sizes.keys() - lost}
        if lost:
            self.bucket.get(object_name(next(iter(lost))))  # tells a missing bucket from one without this object
            self._withdraw(lost)
        return {path: row.size for path, row in rows.items() if row.digest not in lost}

    def there(self, paths: Iterable[Path]) -> set[Path]:
        """See `Store`."""
        return {*self._known(paths)}

    def digests(self, paths: Iterable[Path]) -> dict[Path, str]:
        """See `Store`; the digests are those of the rows."""
        return {path: row.digest.hex() for path, row in self._known(paths).items()}

    def below(self, folder: Path, pattern: str = "**/*") -> list[Path]:
        """See `Store`."""
        start = f"{self._name(folder)}/"
        matches = re.compile(_regex(pattern)).fullmatch
        inside = (name.removeprefix(start) for name in self.names.below(self._name(folder)))
        return [folder / name for name in inside if matches(name) and not is_hidden(Path(name))]

    def note(self, path: Path) -> str | None:
        """See `Store`."""
        row = self._current(path)
        return None if row is None else row.note

    def changed_ns(self, path: Path) -> int:
        """See `Store`."""
        row = self._current(path)
        return 0 if row is None else row.at_ns

    def lease(self, name: str) -> Lease | None:
        """See `Store`."""
        return lease(self._database, name)

    def unused(self, *, is_removed: bool = False, grace_days: float | None = None) -> list[UnusedObject]:
        """See `Store`."""
        before = datetime.now(UTC) - timedelta(days=GRACE_DAYS if grace_days is None else grace_days)
        objects = {
            bytes.fromhex(match[2]): UnusedObject(name, size, modified)
            for name, size, modified in self.bucket.names()
            if (match := _OBJECT.fullmatch(name))
        }
        named = {*self.names.naming().values()}
        if objects and not objects.keys() & named:
            raise TrapsError(
                f"{self.bucket.address}: holds objects ({len(objects):,}), and the database names none for the "
                f"study {self._study}; see that its variable has the address of the study's own database: nothing was "
                "removed"
            )
        unnamed = (digest for digest, content in objects.items() if digest not in named and content.at < before)
        old = sorted(unnamed, key=lambda digest: objects[digest].at)
        if is_removed:
            batches = [old[first : first + BATCH] for first in range(0, len(old), BATCH)]
            delete = lambda digests: self.bucket.delete([object_name(digest) for digest in digests])  # noqa: E731
            old = [digest for batch in batches for digest in self.names.remove(batch, delete)]
        return [objects[digest] for digest in old]


def _regex(pattern: str) -> str:
    """Translate a `pathlib` pattern of `*` and `**/` into a regular expression."""
    return re.escape(pattern).replace(r"\*\*/", "(?:[^/]+/)*").replace(r"\*", "[^/]*")


def _side_by_side(work: Callable[[T], R], of: Iterable[T]) -> list[R]:
    """Return the results of `work` for each element, computed concurrently."""
    each = list(of)
    if len(each) < 2:
        return [work(item) for item in each]
    with ThreadPoolExecutor(min(AT_ONCE, len(each))) as pool:
        return list(pool.map(work, each))
