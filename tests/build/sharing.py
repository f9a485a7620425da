"""Rows that a pool draws into files, and a count of what each process drew."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from traps_pipeline.base.files import write_bytes
from traps_pipeline.benchmark.sharing import RenderWork, Row, make_together
from traps_pipeline.storage.store import Store

ROWS = [{"scenario_id": f"made-{n:04d}"} for n in range(9)]
STOPS_AT = 4  # the row in whose drawing a process can be stopped


@dataclass(frozen=True)
class Drawing:
    """A row that is drawn into a file, and told in another one; where a process stops, it does not come back."""

    row: Row
    clip: Path
    told: Path
    stops: bool


def draw(job: Drawing) -> int:
    with job.told.open("a") as told:
        told.write(f"{job.row['scenario_id']}\n")
    if job.stops:
        Path(f"{job.told}.stop").read_text()  # a pipe: as long as the test has it open
    write_bytes(job.clip, f"frames of {job.row['scenario_id']}".encode())
    return 1


def made(store: Store, told: Path, *, stops: bool = False) -> int:
    """Make what is missing; how much was drawn here."""

    def clip(row: Row) -> Path:
        return store.root / "clips" / f"{row['scenario_id']}.mp4"

    def missing(rows: Sequence[Row]) -> list[Row]:
        return [row for row in rows if clip(row) not in store.there([clip(row)])]

    def job(row: Row) -> Drawing | None:
        here = stops and row["scenario_id"] == ROWS[STOPS_AT]["scenario_id"]
        return None if clip(row).is_file() else Drawing(row, clip(row), told, here)

    of = RenderWork("videos/made", missing, lambda row: [clip(row)], job, draw)
    drawn, is_whole = make_together(store, ROWS, of, lambda done: None)
    assert is_whole
    return drawn
