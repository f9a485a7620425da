"""One cell steered by a process of its own: `python -m tests.mechanism.steer_cell WORKSPACE ENTRY_JSON`.

Prints a line of JSON: answers that this process generated, and the texts of the cell by key.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

import pytest

from tests.mechanism.study import register
from traps_pipeline.mechanism import stages
from traps_pipeline.mechanism.mechanism_rows import STEERING
from traps_pipeline.mechanism.steered_backend import SteeredBackend
from traps_pipeline.mechanism.steering import collect_steered
from traps_pipeline.models.registry import ModelEntry
from traps_pipeline.models.request import Outcome, Request
from traps_pipeline.protocol.cells import Extraction, SteeringCell
from traps_pipeline.storage.workspace import Workspace

CELL = SteeringCell.make("chaotic", "tiny", "standard", "guided")


def main(place: str, described: str) -> None:
    """Steer CELL and say how it went."""
    entry, workspace = ModelEntry.model_validate_json(Path(described).read_text("utf-8")), Workspace.open(Path(place))
    generated = 0
    generate = SteeredBackend.generate

    def counting(of: SteeredBackend, wanted: Sequence[Request], stopped: Callable[[], bool]) -> list[Outcome]:
        nonlocal generated
        made = generate(of, wanted, stopped)
        generated += len(made)
        return made

    SteeredBackend.generate = counting  # type: ignore[method-assign]
    with pytest.MonkeyPatch.context() as patch:
        register(patch, entry)
        along = {"standard": stages.saved_directions(workspace, Extraction("tiny", "standard"))}
        ((_, made),) = collect_steered(workspace, entry, [CELL], along)
    texts = {row.request_key: row.text for row in made.rows(STEERING)}
    print(json.dumps({"generated": generated, "texts": texts}), flush=True)


if __name__ == "__main__":
    main(*sys.argv[1:])
