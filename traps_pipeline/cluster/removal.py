"""Objects that are being removed from a study's store, or were: who brings the same content again must be told.

A removal (`cluster/unused.py`) is told before it begins, in rows of `traps.removed`, under a lock that whoever names an
object holds as well (`removed`). Who finds one brings the content once more, after the removal has ended (`forget`).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from traps_pipeline.base.errors import TrapsError
from traps_pipeline.cluster.bucket import object_name
from traps_pipeline.storage.database import Session, lock_number

if TYPE_CHECKING:
    from psycopg import Connection

ENDS_S = 600  # so long after it was told no removal acts any more, even if its process died
TOLD_DAYS = 90  # for so long it is remembered what was removed
SCHEMA = """create table if not exists traps.removed (
    study int not null references traps.studies, digest bytea not null, at timestamptz not null default now(),
    is_over boolean not null default false, primary key (study, digest))"""


def removal_lock(study: int) -> int:
    """The number of the lock between those that name objects of a study and one that removes some."""
    return lock_number(f"objects of {study}")


def tell(connection: Connection[Any], study: int, digests: Sequence[bytes]) -> None:
    """Tell that these objects are removed from now on. The lock is held."""
    connection.execute(
        """insert into traps.removed (study, digest) select %s, * from unnest(%s::bytea[])
           on conflict (study, digest) do update set at = now(), is_over = false""",
        [study, [*digests]],
    )
    old = "delete from traps.removed where study = %s and at < now() - make_interval(days => %s)"
    connection.execute(old, [study, TOLD_DAYS])


def tell_end(connection: Connection[Any], study: int, digests: Sequence[bytes]) -> None:
    """Tell that these objects are removed."""
    sql = "update traps.removed set is_over = true where study = %s and digest = any(%s)"
    connection.execute(sql, [study, [*digests]])


def removed(connection: Connection[Any], study: int, digests: Sequence[bytes]) -> list[bytes]:
    """Those of these objects that are being removed, or were, since somebody brought them to the store: they may not
    be named before they are brought again. Until the transaction ends no removal begins."""
    connection.execute("select pg_advisory_xact_lock_shared(%s)", [removal_lock(study)])
    sql = "select digest from traps.removed where study = %s and digest = any(%s)"
    return [bytes(digest) for (digest,) in connection.execute(sql, [study, [*digests]]).fetchall()]


def forget(session: Session, address: str, digests: Sequence[bytes]) -> None:
    """To be called before objects that were removed are brought to the store at an address again. Raises TrapsError
    where a removal goes on."""
    study = session.study_id

    def work(connection: Connection[Any]) -> list[bytes]:
        sql = """delete from traps.removed where study = %s and digest = any(%s)
                 and (is_over or at < now() - make_interval(secs => %s))"""
        connection.execute(sql, [study, [*digests], ENDS_S])
        return removed(connection, study, digests)

    if left := session.run(work):
        raise TrapsError(
            f"{address}/{object_name(left[0])}: is being removed at this moment by `traps doctor --unused "
            f"remove` of the study {session.study}; run the same command again in {ENDS_S // 60} minutes: what "
            "is finished is kept"
        )
