"""Store a study's files in an object store (S3, Google, Azure), for several hosts.

An object is written once, under the SHA-256 of its content, and never renamed; `object_names.py` maps paths to objects.
A host caches what it has fetched in its scratch folder, below `.objects` under the same digests, and links it to the
paths that people and code use. The digest of every content that is read is compared with its row.
"""

from __future__ import annotations

import os
import re
import secrets
from collections.abc import Callable, Collection, Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from datetime import UTC, datetime, timedelta
from functools import cache
from hashlib import sha256
from pathlib import Path
from typing import Any

import yaml
from typing_extensions import override

from traps_cluster.bucket import Bucket, object_name
from traps_cluster.object_names import CurrentObject, ObjectNames
from traps_cluster.postgres import PostgresDatabase, open_ledger
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.base.files import write_bytes
from traps_pipeline.storage.place import STUDY, Place
from traps_pipeline.storage.store import GRACE_DAYS, FolderStore, Store, UnusedObject, is_hidden
from traps_pipeline.storage.study import FORMAT, Study

OBJECTS = ".objects"  # in a scratch folder: contents by digest
AT_ONCE = 16  # concurrent transfers
BATCH = 1000  # objects removed per request
_HEAD = "# A study of TRAPSBench. Its own study.yaml, and the names of its files, lie in the database.\n"
_OBJECT = re.compile(r"([0-9a-f]{2})/(\1[0-9a-f]{62})")


class ObjectStore(Store):
    """A study's files: names in its database, contents in a bucket; thread-safe."""

    def __init__(self, root: Path, bucket: Bucket, database: PostgresDatabase) -> None:
        super().__init__(root, database.lease)
        self.bucket, self._database = bucket, database
        self.names = ObjectNames(database)
        self._stored = set[bytes]()  # digests of current objects that this process has seen in the store
        self._verified = set[bytes]()  # digests of contents that it has found whole in the scratch folder

    @override
    def look(self) -> None:
        self.names.look()

    def _name(self, path: Path) -> str:
        return path.relative_to(self.root).as_posix()

    def _known(self, paths: Iterable[Path]) -> dict[Path, CurrentObject]:
        names = {path: self._name(path) for path in paths}
        current = self.names.current({*names.values()})
        return {path: current[name] for path, name in names.items() if name in current}

    def _change(self, changed: Mapping[Path, CurrentObject | None], removals: int) -> None:
        def again() -> None:
            for row in filter(None, changed.values()):
                self.bucket.put(object_name(row.digest), self._cached(row.digest).read_bytes())

        self.names.change({self._name(path): row for path, row in changed.items()}, removals, again)

    def _withdraw(self, lost: Collection[bytes]) -> None:
        """Remove the names of lost or altered objects, so that dependents are rebuilt."""
        self._stored -= {*lost}
        self._change({self.root / name: None for name in self.names.naming(lost)}, self.names.removals)

    # --- contents ---------------------------------------------------------------------------------------------------

    def _cached(self, digest: bytes) -> Path:
        return self.root / OBJECTS / object_name(digest)

    def _is_cached(self, digest: bytes) -> bool:
        path = self._cached(digest)
        if digest not in self._verified and path.is_file() and sha256(path.read_bytes()).digest() == digest:
            self._verified.add(digest)
        return digest in self._verified and path.is_file()

    def _cache(self, digest: bytes, content: bytes) -> Path:
        if not self._is_cached(digest):
            write_bytes(self._cached(digest), content)
            self._verified.add(digest)
        return self._cached(digest)

    def _fetched(self, row: CurrentObject) -> Path | None:
        """Return an object's local file; None if it is lost or altered, and so no longer named."""
        if self._is_cached(row.digest):
            return self._cached(row.digest)
        content = self.bucket.get(object_name(row.digest))
        if content is None or sha256(content).digest() != row.digest:
            self._withdraw([row.digest])
            return None
        self._stored.add(row.digest)
        return self._cache(row.digest, content)

    @override
    def here(self, path: Path) -> Path:
        row = self._known([path]).get(path)
        if row is None:
            raise FileNotFoundError(f"{self.bucket.address}/{self._name(path)}")
        if (cached := self._fetched(row)) is None:
            raise TrapsError(
                f"{self.bucket.address}/{self._name(path)}: is not what was written, or is gone from the store; "
                "materialize it again"
            )
        return cached

    @override
    def bring(self, paths: Iterable[Path]) -> None:
        """A local file stays if the store has lost its object."""

        def one(known: tuple[Path, CurrentObject]) -> None:
            path, row = known
            cached = self._fetched(row)
            if cached is not None and not _is_same_file(path, cached):
                _replace_by_link(cached, path)

        _side_by_side(one, self._known(path for path in paths if path.is_relative_to(self.root)).items())

    @override
    def keep(self, paths: Iterable[Path]) -> None:
        names, removals = {*paths}, self.names.removals
        current = self._known(names)

        def one(path: Path) -> tuple[Path, CurrentObject]:
            content, row = path.read_bytes(), current.get(path)
            if row is not None and row.digest == sha256(content).digest():
                return path, row
            return path, self._put(path, content)

        kept = dict(_side_by_side(one, names))
        self._change({path: row for path, row in kept.items() if row is not current.get(path)}, removals)

    @override
    def write(self, files: Mapping[Path, bytes], *, note: str | None = None, durable: bool = False) -> None:
        """A scratch folder needs nothing durable."""
        removals = self.names.removals
        put = _side_by_side(lambda path: self._put(path, files[path], note), files)
        self._change(dict(zip(files, put, strict=True)), removals)
        if self.root / STUDY in files:  # last, so that it vouches for the study
            found_by = {"format": FORMAT, "name": self._database.study_name, "database": self._database.variable}
            self.bucket.put(STUDY, (_HEAD + yaml.safe_dump(found_by, sort_keys=False)).encode())

    def _put(self, path: Path, content: bytes, note: str | None = None) -> CurrentObject:
        """Upload a content, and link it to its path; return its object, which is not yet named."""
        new = CurrentObject(sha256(content).digest(), len(content), note)
        _replace_by_link(self._cache(new.digest, content), path)
        self.bucket.put(object_name(new.digest), content)
        self._stored.add(new.digest)
        return new

    @override
    def remove(self, paths: Iterable[Path]) -> None:
        named = self._known(paths)
        self._change(dict.fromkeys(named), self.names.removals)
        for path in named:
            path.unlink(missing_ok=True)

    # --- what there is ----------------------------------------------------------------------------------------------

    @override
    def sizes(self, paths: Iterable[Path]) -> dict[Path, int]:
        """Each object is checked in the store, once per process."""
        rows = self._known(paths)
        unseen = {row.digest: row.size for row in rows.values() if row.digest not in self._stored}
        sizes = dict(_side_by_side(lambda digest: (digest, self.bucket.size(object_name(digest))), unseen))
        lost = {digest for digest, size in sizes.items() if size != unseen[digest]}
        self._stored |= sizes.keys() - lost
        if lost:
            self.bucket.get(object_name(next(iter(lost))))  # tells a missing bucket from one without this object
            self._withdraw(lost)
        return {path: row.size for path, row in rows.items() if row.digest not in lost}

    @override
    def there(self, paths: Iterable[Path]) -> set[Path]:
        return {*self._known(paths)}

    @override
    def digests(self, paths: Iterable[Path]) -> dict[Path, str]:
        """The digests are those of the rows."""
        return {path: row.digest.hex() for path, row in self._known(paths).items()}

    @override
    def below(self, folder: Path, pattern: str = "**/*") -> list[Path]:
        start = f"{self._name(folder)}/"
        # `**/` is any number of folders, `*` is within one name, as in `pathlib`. # own text: names of a study's files
        matches = re.compile(re.escape(pattern).replace(r"\*\*/", "(?:[^/]+/)*").replace(r"\*", "[^/]*")).fullmatch
        inside = (name.removeprefix(start) for name in self.names.below(self._name(folder)))
        return [folder / name for name in inside if matches(name) and not is_hidden(Path(name))]

    @override
    def note(self, path: Path) -> str | None:
        return next((row.note for row in self._known([path]).values()), None)

    @override
    def changed_ns(self, path: Path) -> int:
        return next((row.at_ns for row in self._known([path]).values()), 0)

    @override
    def unused(self, *, is_removed: bool = False, grace_days: float | None = None) -> list[UnusedObject]:
        before = datetime.now(UTC) - timedelta(days=GRACE_DAYS if grace_days is None else grace_days)
        objects = {
            bytes.fromhex(match[2]): UnusedObject(name, size, modified)
            for name, size, modified in self.bucket.names()
            if (match := _OBJECT.fullmatch(name))
        }
        named = {row.digest for row in self.names.naming().values()}
        if objects and not objects.keys() & named:
            raise TrapsError(
                f"{self.bucket.address}: holds objects ({len(objects):,}), and the database names none for the study "
                f"{self._database.study_name}; see that {self._database.variable} has the address of the study's own "
                "database: nothing was removed"
            )
        unnamed = (digest for digest, content in objects.items() if digest not in named and content.at < before)
        old = sorted(unnamed, key=lambda digest: objects[digest].at)
        if is_removed:
            batches = [old[first : first + BATCH] for first in range(0, len(old), BATCH)]
            delete = lambda digests: self.bucket.delete([object_name(digest) for digest in digests])  # noqa: E731
            old = [digest for batch in batches for digest in self.names.remove(batch, delete)]
        return [objects[digest] for digest in old]


def _side_by_side(work: Callable[[Any], Any], of: Iterable[Any]) -> list[Any]:
    """Return the results of `work` for each element, computed concurrently."""
    with ThreadPoolExecutor(AT_ONCE) as pool:
        return [*pool.map(work, of)]


_bucket, _store = cache(Bucket), cache(ObjectStore)  # kept by the process: reopening does not read everything


def open_store(place: Place, root: Path, study: Study | None = None) -> Store | None:
    """See `SeveralHosts`.

    In an object store, the only object with a fixed name identifies the study, and names the variable that holds the
    address of its database.
    """
    if study is not None:
        name, variable = study.name, str(study.database)
    else:
        content = _bucket(str(place)).get(STUDY)
        if content is None:
            return None
        try:
            parsed = yaml.safe_load(content)
            name, variable = str(parsed["name"]), str(parsed["database"])
        except (yaml.YAMLError, KeyError, TypeError) as error:
            raise TrapsError(f"{place}/{STUDY}: is not what `traps init` wrote ({error})") from None
    ledger = open_ledger(variable, name)
    return FolderStore(root, ledger.lease) if isinstance(place, Path) else _store(root, _bucket(place), ledger)


def _is_same_file(first: Path, second: Path) -> bool:
    """Return whether two paths name one existing file."""
    try:
        return first.samefile(second)
    except FileNotFoundError:
        return False


def _replace_by_link(existing: Path, path: Path) -> None:
    """Hard-link a file to `path`, replacing any there (safe: files are never edited)."""
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(f".{path.name}.{secrets.token_hex(4)}.part")
    try:
        os.link(existing, part)
        part.replace(path)
    finally:
        part.unlink(missing_ok=True)
