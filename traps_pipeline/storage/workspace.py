"""Define a workspace, the folder or place in an object store of one study.

Code works with paths below `root`, a folder of this machine: the workspace itself, or a scratch folder for the files of
an object store (`storage/store.py`).
"""

from __future__ import annotations

import os
from collections.abc import Iterable
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import yaml

from traps_pipeline.base.errors import TrapsError
from traps_pipeline.base.files import write_text
from traps_pipeline.base.paths import ASSETS, WORKSPACES, require_history_path, require_root
from traps_pipeline.base.yamlfile import parse_yaml_model, read_yaml
from traps_pipeline.storage.parquet import TableStore
from traps_pipeline.storage.place import STUDY, Place, name_of, parse_place, scratch_of
from traps_pipeline.storage.several_hosts import several_hosts
from traps_pipeline.storage.store import FolderStore, Store
from traps_pipeline.storage.study import FORMAT, MechanismSettings, Study

if TYPE_CHECKING:
    from traps_pipeline.ledger.database import Database
    from traps_pipeline.ledger.ledger import Ledger
    from traps_pipeline.storage.media import MediaStore

VARIABLE = "TRAPS_WORKSPACE"
RAY = "TRAPS_RAY"  # environment variable: the address of Ray's head, http://HEAD:8265
RUN_CPUS, RUN_GPUS = "TRAPS_RUN_CPUS", "TRAPS_RUN_GPUS"  # for cluster runs that Dagster's pages launch
_GONE_STORAGE = "traps_pipeline.pipeline.event_storage"
DATABASE = "TRAPS_DATABASE"  # default variable for the database's address of a new study in a store


class Workspace:
    """Paths and stores of one study; use `Workspace.open` or `Workspace.create`."""

    def __init__(self, root: Path, study: Study, address: str = "") -> None:
        self.root, self.study, self._address = root, study, address

    @property
    def place(self) -> Place:
        """The study's place as users name it: its folder, or its address in a store."""
        return self._address or self.root

    @property
    def is_shared(self) -> bool:
        """Whether its files lie in an object store, which several hosts see."""
        return bool(self._address)

    @staticmethod
    def default_place() -> Place:
        """Return `$TRAPS_WORKSPACE`, else `.workspaces/default` of the checkout or cwd."""
        return parse_place(os.environ.get(VARIABLE) or str(WORKSPACES / "default"))

    @staticmethod
    def is_there(place: Place) -> bool:
        """Return whether a place holds a study. Raises TrapsError if a store fails."""
        if isinstance(place, str):
            return several_hosts().open_store(place, scratch_of(place)) is not None
        return (place / STUDY).is_file()

    @staticmethod
    def file_of(place: Place, name: str) -> Path | None:
        """Return a study's top-level file, if any, without opening the study.

        Raises TrapsError if an object store cannot be used.
        """
        if isinstance(place, str):
            root = scratch_of(place)
            store = several_hosts().open_store(place, root)
            if store is None:
                return None
            store.look()
            return store.here(root / name) if store.has(root / name) else None
        return place.absolute() / name if (place / name).is_file() else None

    @classmethod
    def create(cls, place: Place, study: Study) -> Workspace:
        """Create a workspace, or open one of the same benchmark (else raise TrapsError)."""
        require_root()
        if cls.is_there(place):
            workspace = cls.open(place)
            for field in ("benchmark", "scenarios", "per_family"):
                old, new = getattr(workspace.study, field), getattr(study, field)
                if old != new:
                    raise TrapsError(
                        f"{place}/study.yaml: {field} is {old!r}, this study wants {new!r}; a workspace keeps its "
                        f"benchmark: choose another folder with {VARIABLE} or --workspace"
                    )
            return workspace
        study = study.model_copy(update={"name": study.name or name_of(place)})
        require_history_path(Path(os.environ.get("DAGSTER_HOME") or ("." if isinstance(place, str) else place)))
        if isinstance(place, str):
            study = study.model_copy(update={"database": study.database or DATABASE})
            workspace = cls(scratch_of(place), study, place)
            workspace._make_folders()
            workspace.save_study()
            return workspace
        workspace = cls(place.absolute(), study)
        workspace._make_folders()
        workspace.save_study()
        return workspace

    def _make_folders(self) -> None:
        for folder in ("tables", "clips", "trajectories", "ledger", "reports", "dagster"):
            (self.root / folder).mkdir(parents=True, exist_ok=True)

    def save_study(self) -> None:
        """Write `study.yaml`, which every run in this workspace reads."""
        study = {name: value for name, value in self.study.model_dump(mode="json").items() if value is not None}
        # Nested nulls are written: `mechanism.steering: null` requests no steering, a missing key requests all.
        self.store.write({self.root / STUDY: yaml.safe_dump(study, sort_keys=False).encode()})

    @property
    def mechanism(self) -> MechanismSettings:
        """The study's mechanistic settings. Raises TrapsError if it has none."""
        if self.study.mechanism is None:
            raise TrapsError(
                f"{self.root}/study.yaml: asks nothing inside models; run an experiment with a `mechanism:` section "
                "(docs/mechanism.md), e.g. `traps run mechanism`"
            )
        return self.study.mechanism

    def allow(self, **changes: Any) -> Workspace:
        """Return the workspace with changed fields of its study, such as budgets."""
        changed = Workspace(self.root, self.study.model_copy(update=changes), self._address)
        changed.save_study()
        return changed

    @classmethod
    def open(cls, place: Place | None = None) -> Workspace:
        """Open the workspace at a place (default: `default_place()`). Raises TrapsError."""
        place = place or cls.default_place()
        path = cls.file_of(place, STUDY)
        if path is None:
            raise TrapsError(
                f"{place}/{STUDY}: no such workspace; make one with `traps init` or `traps run demo`, or set {VARIABLE}"
            )
        data = read_yaml(path)
        if not isinstance(data, dict) or data.get("format") != FORMAT:
            its_format = data.get("format") if isinstance(data, dict) else data
            raise TrapsError(
                f"{path}: workspace format {its_format!r}, this version reads {FORMAT}; use the version that made it, "
                "or start a new workspace (its ledger folder can be copied over: answers keep their keys)"
            )
        study = parse_yaml_model(Study, data, path)
        return cls(scratch_of(place), study, place) if isinstance(place, str) else cls(place.absolute(), study)

    def copy_dagster_yaml(self, home: Path | None = None) -> None:
        """Copy `assets/dagster.yaml` to Dagster's folder (default: the workspace's) if it has none.

        A study's own `dagster.yaml` may name another storage. That of version 0.3.0 names a class that is no more;
        Dagster's own storage reads its files.
        """
        own = (home or self.dagster_home) / "dagster.yaml"
        if own.is_symlink() or not own.exists() or _GONE_STORAGE in own.read_text(encoding="utf-8"):
            write_text(own, (ASSETS / "dagster.yaml").read_text(encoding="utf-8"))

    @property
    def is_on_cluster(self) -> bool:
        """Whether runs may go to other hosts, so that the history is in the database."""
        return bool(self.study.database and os.environ.get(RAY))

    @property
    def dagster_home(self) -> Path:
        """Dagster's folder (DAGSTER_HOME).

        If several hosts share the study and its runs do not go to a cluster, each host has its own: SQLite does not
        work on network file systems.
        """
        if self.is_on_cluster:
            return self.root / "cluster"
        return (scratch_of(str(self.root)) if self.study.database and not self._address else self.root) / "dagster"

    @property
    def reports(self) -> Path:
        """The folder of pages and figures for people."""
        return self.root / "reports"

    @property
    def labels(self) -> Path:
        """The folder of people's labels: the pages' database and the file for stages."""
        return self.root / "labels"

    @property
    def trajectories(self) -> Path:
        """The folder of trajectories simulated again for corrected parameters."""
        return self.root / "trajectories"

    @property
    def ledger_folder(self) -> Path:
        """The folder of the ledger of a study on one machine, and of its locks."""
        return self.root / "ledger"

    @property
    def locks(self) -> Path:
        """The folder of lock files for stages that must not run concurrently."""
        return self.ledger_folder / "locks"

    @cached_property
    def store(self) -> Store:
        """The place of the study's files: a folder or a bucket."""
        if not self.study.database:
            return FolderStore(self.root)
        store = several_hosts().open_store(self.place, self.root, self.study)
        assert store is not None, "the study is given"
        return store

    @cached_property
    def tables(self) -> TableStore:
        """The study's Parquet tables, to read and write by partition."""
        return TableStore(self.root / "tables", self.store)

    @cached_property
    def media(self) -> MediaStore:
        """Clips as they are sent to models."""
        from traps_pipeline.storage.media import MediaStore

        return MediaStore(self.root / "media", self.store)

    @cached_property
    def answers(self) -> Ledger:
        """The ledger of all paid answers."""
        from traps_pipeline.ledger.ledger import Ledger

        return Ledger(self.ledger, "answers")

    @cached_property
    def votes(self) -> Ledger:
        """The ledger of all paid votes."""
        from traps_pipeline.ledger.ledger import Ledger

        return Ledger(self.ledger, "votes")

    @cached_property
    def ledger(self) -> Database:
        """The database of answers, votes and money. Raises TrapsError with a remedy."""
        from traps_pipeline.ledger.sqlite import SqliteDatabase

        if self.study.database:
            return several_hosts().open_ledger(self.study.database, self.study.name)
        return SqliteDatabase(self.ledger_folder)

    def failed_check(self, stage: str, check: str, key: str | None) -> Path:
        """Return the file that exists, with the details, while a partition's check fails."""
        return self.root / "checks" / stage / check / f"{key or stage}.json"

    def failed_checks(self, stage: str) -> dict[str | None, list[str]]:
        """Return the names of the failed checks of a stage's partitions, by key."""
        failed: dict[str | None, list[str]] = {}
        for path in self.store.below(self.root / "checks" / stage, "*/*.json"):
            failed.setdefault(path.stem if path.stem != stage else None, []).append(path.parent.name)
        return failed

    def failure(self, stage: str, check: str, key: str | None) -> str:
        """Return the details of a failed check, as JSON."""
        return self.store.here(self.failed_check(stage, check, key)).read_text(encoding="utf-8")

    def clip(self, scenario_id: str, side: str, scene_hash: str) -> Path:
        """Return a clip's path; its scene hash keeps corrections from overwriting it."""
        return self.root / "clips" / scenario_id / f"{side}-{scene_hash[:16]}.mp4"

    def relative(self, path: Path) -> str:
        """Return a path as tables store it."""
        return path.relative_to(self.root).as_posix()

    def resolve(self, relative: str) -> Path:
        """Return the local file of a path that `relative` returned, if there is one."""
        self.store.bring([self.root / relative])
        return self.root / relative

    def bring(self, relatives: Iterable[str]) -> Path:
        """Fetch existing files; return their local root folder. Raises TrapsError."""
        self.store.bring(self.root / relative for relative in relatives)
        return self.root

    def bring_folder(self, folder: Path) -> Path:
        """Fetch a folder's files and return the folder. Raises TrapsError."""
        self.store.bring(self.store.below(folder))
        return folder

    def sizes(self, relatives: Iterable[str]) -> dict[str, int]:
        """Return the sizes, in bytes, of the files that exist, wherever they lie."""
        size_of = self.store.sizes(self.root / relative for relative in relatives)
        return {self.relative(path): size for path, size in size_of.items()}
