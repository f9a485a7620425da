"""Objects in a study's store that nobody names any more: what is found, and how it is removed.

The store's list only proposes. What is removed is named by no row of `traps.objects` or `traps.segments`, and is older
than a grace period. A host may bring the same content to the store again at that moment, so each removal is told first:
a row of `traps.removed` is written under a lock that whoever names an object holds too (`removed`). Who finds one
brings the content once more, after the removal has ended.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from typing import TYPE_CHECKING, Any

from traps_pipeline.errors import TrapsError
from traps_pipeline.storage.bucket import object_name
from traps_pipeline.storage.database import awake_s, lock_number

if TYPE_CHECKING:
    from psycopg import Connection

    from traps_pipeline.storage.objects import ObjectStore

GRACE_DAYS = 7.0
BATCH = 1000  # objects that are removed by one request
BEGINS_S = 30  # after it was told, a removal has begun, or is left; a process may have been stopped between
ENDS_S = 600  # so long after it was told no removal acts any more, even if its process died
TOLD_DAYS = 90  # for so long it is remembered what was removed
SCHEMA = """create table if not exists traps.removed (
    study int not null references traps.studies, digest bytea not null, at timestamptz not null default now(),
    is_over boolean not null default false, primary key (study, digest))"""
_OBJECT = re.compile(r"([0-9a-f]{2})/(\1[0-9a-f]{62})")


@dataclass(frozen=True)
class Unused:
    """An object that nobody names. size: in bytes; at: when it was written, by the store's clock."""

    digest: bytes
    size: int
    at: datetime


def unused(store: ObjectStore, grace_days: float | None = None) -> list[Unused]:
    """Objects older than the grace period (None: GRACE_DAYS) that no row names, the oldest first. Raises TrapsError
    where the store cannot be used, or where the database names none of its objects: it is another study's, then."""
    before = datetime.now(UTC) - timedelta(days=GRACE_DAYS if grace_days is None else grace_days)
    found = [
        Unused(bytes.fromhex(match[2]), size, at)
        for name, size, at in store.bucket.names()
        if (match := _OBJECT.fullmatch(name))
    ]
    named = store.session.run(lambda c: _named(c, store.session.study_id, None))
    if found and not any(one.digest in named for one in found):
        raise TrapsError(
            f"{store.bucket.address}: holds {len(found)} objects, and the database at {store.session.host} names none "
            f"of them for the study {store.session.study}; see that its variable has the address of the study's own "
            "database: nothing was removed"
        )
    return sorted((one for one in found if one.digest not in named and one.at < before), key=lambda one: one.at)


def remove(store: ObjectStore, found: Sequence[Unused]) -> list[Unused]:
    """Remove such objects, but for those that somebody names by now; what was removed. Raises TrapsError."""
    done = list[Unused]()
    for first in range(0, len(found), BATCH):
        batch = {one.digest: one for one in found[first : first + BATCH]}
        began = awake_s()
        digests = store.session.run(lambda c, of=[*batch]: _tell(c, store.session.study_id, of))
        if awake_s() - began > BEGINS_S:
            continue  # this process was stopped: others may have brought them again by now
        store.bucket.delete_all([object_name(digest) for digest in digests])
        store.session.run(lambda c, of=digests: _over(c, store.session.study_id, of))
        done += [batch[digest] for digest in digests]
    return done


def _named(connection: Connection[Any], study: int, of: Sequence[bytes] | None) -> set[bytes]:
    """The digests that rows of the study name (of these)."""
    sql = """select digest from traps.objects where study = %s and digest is not null
             and (%s::bytea[] is null or digest = any(%s))
             union select s.digest from traps.segments s join traps.evaluations e on e.id = s.evaluation
             where e.study = %s and (%s::bytea[] is null or s.digest = any(%s))"""
    mine = None if of is None else [*of]
    values = [study, mine, mine, study, mine, mine]
    return {bytes(digest) for (digest,) in connection.execute(sql, values).fetchall()}


def _lock(study: int) -> int:
    return lock_number(f"objects of {study}")


def _tell(connection: Connection[Any], study: int, digests: Sequence[bytes]) -> list[bytes]:
    """Tell all that these objects are removed now, but for those that somebody names; which are left."""
    connection.execute("select pg_advisory_xact_lock(%s)", [_lock(study)])
    left = sorted({*digests} - _named(connection, study, digests))
    connection.execute(
        """insert into traps.removed (study, digest) select %s, * from unnest(%s::bytea[])
           on conflict (study, digest) do update set at = now(), is_over = false""",
        [study, left],
    )
    old = "delete from traps.removed where study = %s and at < now() - make_interval(days => %s)"
    connection.execute(old, [study, TOLD_DAYS])
    return left


def _over(connection: Connection[Any], study: int, digests: Sequence[bytes]) -> None:
    sql = "update traps.removed set is_over = true where study = %s and digest = any(%s)"
    connection.execute(sql, [study, [*digests]])


def removed(connection: Connection[Any], study: int, digests: Sequence[bytes]) -> list[bytes]:
    """Those of these objects that are being removed, or were, since somebody brought them to the store: they may not
    be named before they are brought again. Until the transaction ends no removal begins."""
    connection.execute("select pg_advisory_xact_lock_shared(%s)", [_lock(study)])
    sql = "select digest from traps.removed where study = %s and digest = any(%s)"
    return [bytes(digest) for (digest,) in connection.execute(sql, [study, [*digests]]).fetchall()]


def forget(store: ObjectStore, digests: Sequence[bytes]) -> None:
    """To be called before objects that were removed are brought to the store again. Raises TrapsError where a removal
    goes on."""
    study = store.session.study_id

    def work(connection: Connection[Any]) -> list[bytes]:
        sql = """delete from traps.removed where study = %s and digest = any(%s)
                 and (is_over or at < now() - make_interval(secs => %s))"""
        connection.execute(sql, [study, [*digests], ENDS_S])
        return removed(connection, study, digests)

    if left := store.session.run(work):
        raise TrapsError(
            f"{store.bucket.address}/{object_name(left[0])}: is being removed at this moment by `traps doctor --unused "
            f"remove` of the study {store.session.study}; run the same command again in {ENDS_S // 60} minutes: what "
            "is finished is kept"
        )
