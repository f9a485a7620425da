"""What runs on a cluster print, in the study's object store: Dagster's pages show it wherever they are opened.

A host captures what a run prints below its own scratch folder and brings it to the store when the run ends, and every
UPLOAD_S before, so that of a host that died all but the last moments is there. These are the only objects with names of
their own that change; nothing is decided from them.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from functools import cached_property
from pathlib import Path
from typing import IO, Any

from dagster import DagsterInstance, StringSource
from dagster._core.storage.cloud_storage_compute_log_manager import TruncatingCloudStorageComputeLogManager
from dagster._core.storage.compute_log_manager import ComputeIOType
from dagster._core.storage.local_compute_log_manager import IO_TYPE_EXTENSION, LocalComputeLogManager
from dagster._serdes import ConfigurableClass, ConfigurableClassData

from traps_pipeline.base.errors import TrapsError
from traps_pipeline.base.files import write_bytes
from traps_pipeline.cluster.bucket import Bucket
from traps_pipeline.storage.place import scratch_of

UPLOAD_S = 30
FOLDER = "logs"  # in the store, and below the scratch folder


class SharedLogs(TruncatingCloudStorageComputeLogManager[DagsterInstance], ConfigurableClass):
    """Named in `dagster.yaml`. place: the study's address; where its files are on this host, this host decides."""

    def __init__(self, place: str, inst_data: ConfigurableClassData | None = None) -> None:
        self._place, self._inst_data = place, inst_data
        self._folder = scratch_of(place) / FOLDER
        self._local = LocalComputeLogManager(str(self._folder))
        super().__init__()

    @property
    def inst_data(self) -> ConfigurableClassData | None:
        """See Dagster."""
        return self._inst_data

    @classmethod
    def config_type(cls) -> dict[str, Any]:
        """Fields in `dagster.yaml`."""
        return {"place": StringSource}

    @classmethod
    def from_config_value(cls, inst_data: ConfigurableClassData | None, config_value: Any) -> SharedLogs:
        """Dagster's way to make it."""
        return cls(config_value["place"], inst_data)

    @property
    def local_manager(self) -> LocalComputeLogManager:
        """Of the logs that are captured on this host."""
        return self._local

    @property
    def upload_interval(self) -> int:
        """Seconds after which what was printed so far is brought to the store."""
        return UPLOAD_S

    @cached_property
    def _bucket(self) -> Bucket:
        return Bucket(self._place)

    def _path(self, log_key: Sequence[str], io_type: ComputeIOType, partial: bool = False) -> Path:
        """Where a log is on this host. Raises ValueError where its key leads out of the folder."""
        return Path(self._local.get_captured_local_path(log_key, IO_TYPE_EXTENSION[io_type], partial=partial))

    def _name(self, log_key: Sequence[str], io_type: ComputeIOType, partial: bool = False) -> str:
        """The name of a log in the store. Raises ValueError as `_path` does."""
        path = self._path(log_key, io_type, partial)
        return f"{FOLDER}/{path.relative_to(self._folder.resolve()).as_posix()}"

    def _upload_file_obj(
        self, data: IO[bytes], log_key: Sequence[str], io_type: ComputeIOType, partial: bool = False
    ) -> None:
        if content := data.read():
            self._bucket.put(self._name(log_key, io_type, partial), content)
        elif not partial:  # an empty object says that nothing more comes
            self._bucket.put(self._name(log_key, io_type), b"")

    def on_progress(self, log_key: Sequence[str]) -> None:
        """Bring what was printed so far. A store that is away for a moment does not end a run, nor this."""
        try:
            super().on_progress(log_key)
        except TrapsError as error:
            print(f"what this run prints was not brought to the store: {error}", file=sys.stderr)

    def cloud_storage_has_logs(self, log_key: Sequence[str], io_type: ComputeIOType, partial: bool = False) -> bool:
        """Whether the store has a log, or what there was of it while the run went on. Raises TrapsError."""
        return self._bucket.size(self._name(log_key, io_type, partial)) is not None

    def download_from_cloud_storage(
        self, log_key: Sequence[str], io_type: ComputeIOType, partial: bool = False
    ) -> None:
        """Bring a log from the store to this host. Raises TrapsError."""
        content = self._bucket.get(self._name(log_key, io_type, partial))
        if content is not None:
            write_bytes(self._path(log_key, io_type, partial), content)

    def delete_logs(self, log_key: Sequence[str] | None = None, prefix: Sequence[str] | None = None) -> None:
        """Remove one log, or all of a run, as its page asks for it. Raises TrapsError."""
        self._local.delete_logs(log_key, prefix)
        if log_key:
            names = [self._name(log_key, io_type, partial) for io_type in ComputeIOType for partial in (False, True)]
        else:
            names = [name for name, *_ in self._bucket.names("/".join([FOLDER, *(prefix or [])]))]
        self._bucket.delete_all(names)

    def display_path_for_type(self, log_key: Sequence[str], io_type: ComputeIOType) -> str:
        """Where a log is, for people."""
        return f"{self._place}/{self._name(log_key, io_type)}"

    def download_url_for_type(self, log_key: Sequence[str], io_type: ComputeIOType) -> str:
        """Where the web server of the pages hands a log out."""
        return self._local.get_captured_log_download_url(log_key, io_type)
