"""Share the history and logs of runs on Ray; export `dagster.yaml`'s variables.

The history lies in the PostgreSQL database of the study's ledger, in dagster-postgres's own storage. Runs' output lies
in a folder of each host: that of the study if all hosts see it, else one below the scratch folder (`cluster/logs.py`).
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

from sqlalchemy import URL
from sqlalchemy.dialects import plugins
from sqlalchemy.engine import CreateEnginePlugin

from traps_pipeline.base.keys import check_key
from traps_pipeline.storage.workspace import RAY, Workspace

HISTORY = "TRAPS_HISTORY"  # process variable: the database's address in the form of Dagster's driver; in no file
LOGS = "TRAPS_LOGS"  # process variable: this host's folder for runs' output
AT_ONCE = 40  # runs; Ray keeps a process of some 85 MB for each on the head
MONITOR_S, RESUMES = 15, 3
START_S = 24 * 3600  # maximum wait for a host; a lost run ends sooner (`lost_runs.py`)
_PLUGIN = "traps_kept"


def dagster_yaml(workspace: Workspace) -> dict[str, Any]:
    """Return `dagster.yaml` for runs on Ray, and export the variables that it names."""
    export(workspace)
    return {
        "telemetry": {"enabled": False},
        "nux": {"enabled": False},
        "storage": {"postgres": {"postgres_url": {"env": HISTORY}}},
        "run_launcher": {
            "module": "traps_pipeline.cluster.launcher",
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
    address = os.environ[variable]  # the ledger was opened with it
    check_key(variable, address)
    # SQLAlchemy 2.1 takes psycopg 3 for a plain postgresql://, and dagster-postgres's NOTIFY fails with it.
    url = "postgresql+psycopg2://" + address.partition("://")[2]
    if is_kept:
        plugins.register(_PLUGIN, __name__, KeptConnections.__name__)
        url += f"{'&' if '?' in url else '?'}plugin={_PLUGIN}"
    os.environ[HISTORY] = url
    os.environ[LOGS] = str(logs_folder(workspace))


def logs_folder(workspace: Workspace) -> Path:
    """Return this host's folder for runs' output."""
    return workspace.root / "cluster" / "logs"


class KeptConnections(CreateEnginePlugin):
    """A SQLAlchemy plugin that keeps one connection per engine.

    By default dagster-postgres opens one for each statement, which takes two fifths of the time of a run with small
    cells.
    """

    def __init__(self, url: URL, kwargs: dict[str, Any]) -> None:
        """Create the dialect; called by SQLAlchemy for an address that names this plugin."""
        super().__init__(url, kwargs)
        kwargs.pop("poolclass", None)
        alive = {"keepalives_idle": 5, "keepalives_interval": 5, "keepalives_count": 3, "tcp_user_timeout": 15_000}
        kwargs |= {"pool_size": 1, "max_overflow": -1, "pool_pre_ping": True, "connect_args": alive}

    def update_url(self, url: URL) -> URL:
        """Return the address as the driver wants it."""
        return url.difference_update_query(["plugin"])
