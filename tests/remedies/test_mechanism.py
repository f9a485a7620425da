"""What errors about states say to do lets them be read."""

from __future__ import annotations

import shutil
from collections.abc import Callable

import pytest

from tests.build.mechanism import STANDARD, entry, own, patch, study
from tests.remedies.remedied import remedied
from traps_pipeline.mechanism import stages
from traps_pipeline.mechanism.mechanism_rows import HIDDEN_STATES
from traps_pipeline.mechanism.stored_states import StoredStates
from traps_pipeline.protocol.cells import StatesCell
from traps_pipeline.storage.workspace import Workspace

pytestmark = pytest.mark.slow
__all__ = ["entry", "own", "patch", "study"]  # fixtures
CHAOTIC = StatesCell("chaotic", STANDARD)


def extracted(workspace: Workspace, cell: StatesCell = CHAOTIC) -> Callable[[], None]:
    """The stage hidden_states of a partition, materialized."""

    def make() -> None:
        rows, _ = stages.extract_states(workspace, cell)
        workspace.tables.write(HIDDEN_STATES, cell.partition, rows, {})

    return make


def test_states_that_are_missing_or_damaged_are_extracted_again(own: Workspace) -> None:
    folder = own.root / "states" / "tiny" / "standard" / "chaotic"

    def read() -> object:
        return StoredStates.of(own, STANDARD).read("chaotic", 2)

    shutil.rmtree(folder)
    remedied(read, "mechanism.hidden_states", extracted(own))
    shard = next(folder.glob("shard-*.safetensors"))
    shard.write_bytes(shard.read_bytes()[:100])

    def deleted_and_run() -> None:
        shard.unlink()
        extracted(own)()

    remedied(read, "mechanism.hidden_states", deleted_and_run)
    rows = own.tables.read(HIDDEN_STATES, CHAOTIC.partition)
    own.tables.write(HIDDEN_STATES, CHAOTIC.partition, rows.assign(states_key="another"), {})
    remedied(read, "mechanism.stored_states.StoredStates.read", extracted(own))
