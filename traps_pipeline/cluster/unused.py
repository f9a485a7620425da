"""Objects in a study's store that nobody names any more: what is found, and how it is removed.

The store's list only proposes. What is removed is named by no row of `traps.objects` or `traps.segments`, and is older
than a grace period; each removal is told first, for those who bring the same content again (`cluster/removal.py`).
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from typing import TYPE_CHECKING, Any

from traps_pipeline.base.errors import TrapsError
from traps_pipeline.cluster.bucket import object_name
from traps_pipeline.cluster.objects import ObjectStore
from traps_pipeline.cluster.removal import removal_lock, tell, tell_end
from traps_pipeline.storage.database import awake_s

if TYPE_CHECKING:
    from psycopg import Connection

GRACE_DAYS = 7.0
BATCH = 1000  # objects that are removed by one request
BEGINS_S = 30  # after it was told, a removal has begun, or is left; a process may have been stopped between
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
        store.session.run(lambda c, of=digests: tell_end(c, store.session.study_id, of))
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


def _tell(connection: Connection[Any], study: int, digests: Sequence[bytes]) -> list[bytes]:
    """Tell all that these objects are removed now, but for those that somebody names; which are left."""
    connection.execute("select pg_advisory_xact_lock(%s)", [removal_lock(study)])
    left = sorted({*digests} - _named(connection, study, digests))
    tell(connection, study, left)
    return left
