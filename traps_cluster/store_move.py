"""Move a study's rows and spending to a database, its files to an object store.

Nothing is asked, rendered or extracted again. Until everything is there, the address is empty and the folder is the
study; a killed move is repeated. Afterwards the folder is no longer a study, so that nobody pays twice; its files stay.
"""

import shutil
from itertools import islice
from pathlib import Path

from traps_pipeline.base import progress
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.base.wording import count_noun
from traps_pipeline.ledger.row_transfer import copy_ledger
from traps_pipeline.storage.parquet import partition_note
from traps_pipeline.storage.place import STUDY, Place, scratch_of
from traps_pipeline.storage.workspace import DATABASE, Workspace

# Dagster's history, lock files, reports and labels belong to a machine, and the ledger is moved separately.
LOCAL_NAMES = ("dagster", "ledger", "reports", "labels", STUDY)
AT_ONCE = 500  # files of one change
MOVED_STUDY = "study.moved.yaml"  # the new name of the folder's study.yaml


def move_to_store(workspace: Workspace, address: Place) -> int:
    """Move a study to s3://BUCKET/STUDY; return its ledger's row count.

    Raises TrapsError, also while another process writes to the ledger.
    """
    if not isinstance(address, str):
        raise TrapsError(f"{address}: is a folder; --store names an address in an object store, s3://BUCKET/STUDY")
    if workspace.is_shared or workspace.study.database:
        destination = workspace.place if workspace.is_shared else "a database"
        raise TrapsError(
            f"{workspace.place}: the study's ledger lies in {destination}, and not in a folder; export it first "
            "(`traps study export-ledger`), take `database` from study.yaml, and import it again"
        )
    if Workspace.is_there(address):
        raise TrapsError(
            f"{address}: a study lies there already; name another address. If it is this one, and a move was stopped "
            f"at its very end, rename {workspace.root / STUDY}: what it holds was moved"
        )
    study = workspace.study.model_copy(update={"database": DATABASE})
    target = Workspace(scratch_of(address), study, address)

    def settle() -> None:
        _move_files(workspace, target)
        target.save_study()  # last: it makes the address a study
        (workspace.root / STUDY).rename(workspace.root / MOVED_STUDY)

    def lost(fault: str) -> None:
        raise TrapsError(fault)

    return copy_ledger(workspace.ledger, target.ledger, lost, settle)


def _move_files(workspace: Workspace, target: Workspace) -> None:
    files = iter(
        [p for p in workspace.store.below(workspace.root) if p.relative_to(workspace.root).parts[0] not in LOCAL_NAMES]
    )
    count = 0
    while chunk := list(islice(files, AT_ONCE)):
        moved_paths = list[Path]()
        for path in chunk:
            destination = target.root / path.relative_to(workspace.root)
            if path.is_relative_to(workspace.tables.root):
                try:
                    target.store.write({destination: path.read_bytes()}, note=partition_note(path))
                except TrapsError as error:
                    progress.current().note(f"{error}; it is left, and made anew")
                continue
            destination.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(path, destination)
            moved_paths.append(destination)
        target.store.keep(moved_paths)
        count += len(chunk)
        progress.current().note(f"{count_noun(count, 'file')} copied to {target.place}")
