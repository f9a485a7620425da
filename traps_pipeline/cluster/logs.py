"""Upload what runs print to the object store, from which Dagster's pages show it.

A node captures the output in a local folder and uploads it every UPLOAD_S and when the run ends, so that of a dead host
only the last moments are lost. The head fetches it. These are the only objects with names of their own that change; no
decision depends on them.
"""

from __future__ import annotations

import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from traps_pipeline.base.errors import TrapsError
from traps_pipeline.base.files import write_bytes
from traps_pipeline.cluster.bucket import Bucket
from traps_pipeline.cluster.shared_history import logs_folder
from traps_pipeline.storage.workspace import Workspace

UPLOAD_S = 30.0
PREFIX = "logs"  # prefix in the store


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
        if path.resolve().is_relative_to(folder.resolve()) and (not path.exists() or path.stat().st_size != size):
            content = bucket.get(name)
            if content is not None:
                write_bytes(path, content)
