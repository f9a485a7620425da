"""A workspace: one folder that holds one study. Every path in it is made here, so that storage may move later."""

from __future__ import annotations

import os
import re
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import yaml

from traps_pipeline.digests import digest
from traps_pipeline.errors import TrapsError
from traps_pipeline.files import write_text
from traps_pipeline.paths import ROOT, WORKSPACES, require_root
from traps_pipeline.storage.database import Session, session_of
from traps_pipeline.storage.ledger import Ledger
from traps_pipeline.storage.parquet import TableStore
from traps_pipeline.storage.segments import SegmentLedger
from traps_pipeline.storage.shared_ledger import SharedLedger
from traps_pipeline.storage.study import FORMAT, MechanismSettings, Study
from traps_pipeline.yamlfile import parse_yaml_model, read_yaml

if TYPE_CHECKING:
    from traps_pipeline.storage.media import MediaStore

VARIABLE = "TRAPS_WORKSPACE"


def _name_of(root: Path) -> str:
    """A name that no study elsewhere has: the folder's, and a digest of where it was made."""
    plain = re.sub(r"[^a-z0-9]+", "-", root.name.lower()).strip("-")
    return f"{plain}-{digest(str(root))[:8]}".lstrip("-")


class Workspace:
    """Paths and stores of one study. Open with `Workspace.open`, make with `Workspace.create`."""

    def __init__(self, root: Path, study: Study) -> None:
        self.root, self.study = root, study

    @staticmethod
    def default_root() -> Path:
        """`$TRAPS_WORKSPACE`, else `.workspaces/default` in the checkout, or, without one, in the current folder."""
        return Path(os.environ.get(VARIABLE) or WORKSPACES / "default").absolute()

    @classmethod
    def create(cls, root: Path, study: Study) -> Workspace:
        """Make a workspace, or open it when it is there with the same benchmark. Raises TrapsError when it differs."""
        require_root()
        root = root.absolute()
        if (root / "study.yaml").exists():
            workspace = cls.open(root)
            for field in ("benchmark", "scenarios", "per_family"):
                old, new = getattr(workspace.study, field), getattr(study, field)
                if old != new:
                    raise TrapsError(
                        f"{root}/study.yaml: {field} is {old!r}, this study wants {new!r}; a workspace keeps its "
                        f"benchmark: choose another folder with {VARIABLE} or --workspace"
                    )
            return workspace
        for folder in ("tables", "clips", "trajectories", "ledger", "reports", "dagster"):
            (root / folder).mkdir(parents=True, exist_ok=True)
        workspace = cls(root, study.model_copy(update={"name": study.name or _name_of(root)}))
        workspace.save_study()
        return workspace

    def save_study(self) -> None:
        """Write `study.yaml`, which every run in this workspace reads, whoever starts it."""
        study = self.study.model_dump(mode="json", exclude_none=True)
        write_text(self.root / "study.yaml", yaml.safe_dump(study, sort_keys=False))

    @property
    def mechanism(self) -> MechanismSettings:
        """What the study asks inside local models. Raises TrapsError when it asks nothing."""
        if self.study.mechanism is None:
            raise TrapsError(
                f"{self.root}/study.yaml: asks nothing inside models; run an experiment with a `mechanism:` section "
                "(docs/mechanism.md), e.g. `traps run mechanism`"
            )
        return self.study.mechanism

    def allow(self, **changes: Any) -> Workspace:
        """The workspace with other values of fields that may change: budgets, prices, mechanism, experiments."""
        changed = Workspace(self.root, self.study.model_copy(update=changes))
        changed.save_study()
        return changed

    @classmethod
    def open(cls, root: Path | None = None) -> Workspace:
        """The workspace at `root` (default: `default_root()`). Raises TrapsError naming the file and the remedy."""
        root = (root or cls.default_root()).absolute()
        path = root / "study.yaml"
        if not path.is_file():
            raise TrapsError(
                f"{path}: no such workspace; make one with `traps init` or `traps run demo`, or set {VARIABLE}"
            )
        data = read_yaml(path)
        if not isinstance(data, dict) or data.get("format") != FORMAT:
            found = data.get("format") if isinstance(data, dict) else data
            raise TrapsError(
                f"{path}: workspace format {found!r}, this version reads {FORMAT}; use the version that made it, "
                "or start a new workspace (its ledger folder can be copied over: answers keep their keys)"
            )
        return cls(root, parse_yaml_model(Study, data, path))

    def copy_dagster_yaml(self, home: Path | None = None) -> None:
        """Give Dagster's folder (default: the workspace's) the checkout's `dagster.yaml`, unless it has one of its own
        (another storage, say)."""
        own = (home or self.dagster_home) / "dagster.yaml"
        if own.is_symlink() or not own.exists():
            write_text(own, (ROOT / "dagster.yaml").read_text(encoding="utf-8"))

    @property
    def dagster_home(self) -> Path:
        """Dagster's own history (DAGSTER_HOME)."""
        return self.root / "dagster"

    @property
    def reports(self) -> Path:
        """Pages and figures for people."""
        return self.root / "reports"

    @property
    def labels(self) -> Path:
        """What people labelled: the database of the pages, and the append-only file that stages read."""
        return self.root / "labels"

    @property
    def trajectories(self) -> Path:
        """Trajectories simulated here because a correction changed parameters."""
        return self.root / "trajectories"

    @property
    def ledger_folder(self) -> Path:
        """The ledgers of a study that is on one machine, their locks and the journal of calls in flight."""
        return self.root / "ledger"

    @property
    def locks(self) -> Path:
        """Lock files of stages that must not run twice at once."""
        return self.ledger_folder / "locks"

    @cached_property
    def tables(self) -> TableStore:
        """The Parquet tables."""
        return TableStore(self.root / "tables")

    @cached_property
    def media(self) -> MediaStore:
        """Clips as they are sent to models."""
        from traps_pipeline.storage.media import MediaStore

        return MediaStore(self.root / "media")

    @cached_property
    def answers(self) -> Ledger:
        """Every answer ever paid for."""
        return self._ledger("answers")

    @cached_property
    def votes(self) -> Ledger:
        """Every vote ever paid for."""
        return self._ledger("votes")

    def _ledger(self, kind: str) -> Ledger:
        shared = self.session
        return SegmentLedger(self.ledger_folder, kind) if shared is None else SharedLedger(shared, kind)

    @property
    def session(self) -> Session | None:
        """The connection to the database with the study's ledger and budget; None where they lie in its folder. Raises
        TrapsError naming the variable and the remedy."""
        return session_of(self.study.database, self.study.name) if self.study.database else None

    def failed_check(self, stage: str, check: str, key: str | None) -> Path:
        """File that exists while a check of a partition does not pass; it holds the details."""
        return self.root / "checks" / stage / check / f"{key or stage}.json"

    def failed_checks(self, stage: str, key: str | None) -> list[str]:
        """Names of the checks of a partition that do not pass."""
        return sorted(path.parent.name for path in (self.root / "checks" / stage).glob(f"*/{key or stage}.json"))

    def clip(self, scenario_id: str, side: str, scene_hash: str) -> Path:
        """Path of a clip; its name holds the scene hash, so a corrected scene never overwrites what was judged."""
        return self.root / "clips" / scenario_id / f"{side}-{scene_hash[:16]}.mp4"

    def relative(self, path: Path) -> str:
        """A path as tables store it."""
        return path.relative_to(self.root).as_posix()

    def resolve(self, relative: str) -> Path:
        """Inverse of `relative`."""
        return self.root / relative
