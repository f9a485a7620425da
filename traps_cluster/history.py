"""Share Dagster's history, and what runs print, among the hosts of a study.

The history lies in the PostgreSQL database of the study's ledger, in dagster-postgres's own storage. A run's output is
in the study's folder if all hosts see that. Otherwise its node captures it in a folder of its own, and uploads it every
UPLOAD_S and when the run ends, so that of a dead host only the last moments are lost; the head fetches it. These are
the only objects with names of their own that change; no decision depends on them.
"""

from __future__ import annotations

import os
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from sqlalchemy import URL
from sqlalchemy.dialects import plugins
from sqlalchemy.engine import CreateEnginePlugin

from traps_cluster.bucket import Bucket
from traps_cluster.postgres import KEEPALIVE
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.base.files import write_bytes
from traps_pipeline.base.keys import check_key
from traps_pipeline.storage.workspace import RAY, Workspace

HISTORY = "TRAPS_HISTORY"  # process variable: the database's address in the form of Dagster's driver; in no file
LOGS = "TRAPS_LOGS"  # process variable: this host's folder for runs' output
AT_ONCE = 40  # runs; Ray keeps a process of some 85 MB for each on the head
MONITOR_S, RESUMES = 15, 3
START_S = 24 * 3600  # maximum wait for a host; a lost run ends sooner (`sensors.py`)
UPLOAD_S = 30.0
PREFIX = "logs"  # prefix in the store
_PLUGIN = "traps_kept"


def dagster_yaml(workspace: Workspace) -> dict[str, Any]:
    """See `SeveralHosts`."""
    export(workspace)
    return {
        "telemetry": {"enabled": False},
        "nux": {"enabled": False},
        "storage": {"postgres": {"postgres_url": {"env": HISTORY}}},
        "run_launcher": {
            "module": "traps_cluster.launcher",
            "class": "ClusterLauncher",
            "config": {"ray": {"address": os.environ[RAY], "num_cpus": 1}},
        },
        "compute_logs": {
            "module": "dagster._core.storage.local_compute_log_manager",  # as in Dagster's documentation
            "class": "LocalComputeLogManager",
            "config": {"base_dir": {"env": LOGS}},
        },
        "run_monitoring": {
            "enabled": True,
            "poll_interval_seconds": MONITOR_S,
            "max_resume_run_attempts": RESUMES,
            "start_timeout_seconds": START_S,
        },
        "sensors": {"use_threads": True, "num_workers": 4},  # so that a slow sensor of a large study delays no other
        "concurrency": {"runs": {"max_concurrent_runs": AT_ONCE}},
    }


def export(workspace: Workspace, *, is_kept: bool = False) -> None:
    """Set the variables that `dagster.yaml` names, for this process and its children.

    is_kept: whether this process keeps its connections (`KeptConnections`), as a process that executes a run does.
    """
    variable = str(workspace.study.database)
    address = os.environ[variable]
    check_key(variable, address)
    # SQLAlchemy 2.1 takes psycopg 3 for a plain postgresql://, and dagster-postgres's NOTIFY fails with it.
    url = "postgresql+psycopg2://" + address.partition("://")[2]
    if is_kept:
        plugins.register(_PLUGIN, __name__, KeptConnections.__name__)
        url += f"{'&' if '?' in url else '?'}plugin={_PLUGIN}"
    os.environ[HISTORY] = url
    os.environ[LOGS] = str(logs_folder(workspace))


class KeptConnections(CreateEnginePlugin):
    """A SQLAlchemy plugin that keeps one connection per engine.

    By default dagster-postgres opens one for each statement: two fifths of the time of a run with small cells.
    """

    def __init__(self, url: URL, kwargs: dict[str, Any]) -> None:
        """Create the dialect; called by SQLAlchemy for an address that names this plugin."""
        super().__init__(url, kwargs)
        kwargs.pop("poolclass", None)
        kwargs |= {"pool_size": 1, "max_overflow": -1, "pool_pre_ping": True, "connect_args": KEEPALIVE}

    def update_url(self, url: URL) -> URL:
        """Return the address as the driver wants it."""
        return url.difference_update_query(["plugin"])


def logs_folder(workspace: Workspace) -> Path:
    """Return this host's folder for runs' output."""
    return workspace.root / "cluster" / "logs"


@contextmanager
def uploading(workspace: Workspace, run_id: str) -> Iterator[None]:
    """Upload a run's output to the study's store, within the block and at its end."""
    if not isinstance(workspace.place, str):
        yield  # all hosts see the folder
        return
    bucket, folder, sizes = Bucket(workspace.place), logs_folder(workspace), dict[Path, int]()
    is_over = threading.Event()

    def work() -> None:
        while not is_over.wait(UPLOAD_S):
            upload(bucket, folder, run_id, sizes)

    thread = threading.Thread(target=work, daemon=True)
    thread.start()
    try:
        yield
    finally:
        is_over.set()
        thread.join()
        upload(bucket, folder, run_id, sizes)


def upload(bucket: Bucket, folder: Path, run_id: str, sizes: dict[Path, int]) -> None:
    """Upload a run's grown logs (sizes: bytes by file); report an unreachable store."""
    try:
        for path in (folder / run_id).rglob("*.*"):
            content = path.read_bytes()
            if sizes.get(path) != len(content):
                bucket.put(f"{PREFIX}/{path.relative_to(folder).as_posix()}", content)
                sizes[path] = len(content)
    except TrapsError as error:
        print(f"what this run prints was not brought to the store: {error}", file=sys.stderr)


def fetch(bucket: Bucket, folder: Path) -> None:
    """Fetch missing and incomplete logs into a folder. Raises TrapsError."""
    for name, size, _ in bucket.names(PREFIX):
        path = folder / Path(name).relative_to(PREFIX)
        is_inside = path.resolve().is_relative_to(folder.resolve())
        is_new = not path.exists() or path.stat().st_size != size
        if is_inside and is_new and (content := bucket.get(name)) is not None:
            write_bytes(path, content)
