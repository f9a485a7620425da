"""What errors about states, probes and directions say to do lets the same stage, fit or hook succeed."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.build.directions import origin, pair_states
from tests.build.mechanism import STANDARD, entry, own, patch, study
from tests.remedies.remedied import remedied
from traps_pipeline.mechanism import stages
from traps_pipeline.mechanism.directions import extract_directions, load_directions, save_directions
from traps_pipeline.mechanism.mechanism_rows import HIDDEN_STATES
from traps_pipeline.mechanism.stored import StoredStates
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


# --- arrays -----------------------------------------------------------------------------------------------------------


def test_directions_of_more_scenarios_are_made_and_damaged_files_are_written_again(tmp_path: Path) -> None:
    void, control = pair_states()
    made = remedied(
        lambda: extract_directions(void[:, :1], control[:, :1], [1]),
        "mechanism.directions.extract_directions",
        again=lambda: extract_directions(void, control, [1]),
    )
    path = tmp_path / "chaotic.safetensors"

    def made_again() -> None:
        path.unlink()
        save_directions(path, made, origin())

    save_directions(path, made, origin())
    path.write_bytes(path.read_bytes()[:-1])
    remedied(lambda: load_directions(path), "mechanism.directions.load_directions", made_again)
    from safetensors.numpy import load_file, save_file

    from traps_pipeline.base.digests import file_digest

    save_file({"void": load_file(path)["void"]}, path)
    note = json.loads(path.with_suffix(".json").read_text())
    path.with_suffix(".json").write_text(json.dumps(note | {"tensors_sha256": file_digest(path)}))
    remedied(lambda: load_directions(path), "mechanism.directions.load_directions", made_again)


# --- stages -----------------------------------------------------------------------------------------------------------


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
    remedied(read, "mechanism.stored.StoredStates.read", extracted(own))
