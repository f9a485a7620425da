"""Processes that make clips of one category beside one another, wherever the study's files lie."""

from __future__ import annotations

import os
import subprocess
import sys
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import pytest

from tests.build.sharing import ROWS, STOPS_AT, draw, made
from tests.build.stores import opened, where
from tests.conftest import ROOT
from traps_pipeline.base.files import write_bytes
from traps_pipeline.benchmark.sharing import RenderWork, make_together
from traps_pipeline.storage.store import LEASES

__all__ = ["where"]  # the fixture
MAKE = """
import sys
from pathlib import Path
from tests.build.sharing import made
from tests.build.stores import opened
print(made(opened(*sys.argv[3:]), Path(sys.argv[1]), stops=sys.argv[2] == "stops"))
"""


@contextmanager
def process(told: Path, where: Sequence[str], host: str, how: str = "goes on") -> Iterator[subprocess.Popen[str]]:
    command = [sys.executable, "-c", MAKE, str(told), how, *where, host]
    environment = {**os.environ, "TRAPS_CORES": "1"}
    with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True, env=environment) as started:
        yield started


def contents(where: Sequence[str]) -> dict[str, bytes]:
    """What the study has."""
    store = opened(*where, "reader")
    clips = [store.root / "clips" / f"{row['scenario_id']}.mp4" for row in ROWS]
    return {path.name: store.here(path).read_bytes() for path in clips}


@pytest.mark.slow
def test_two_processes_draw_each_row_once(where: Sequence[str], tmp_path: Path) -> None:
    told = tmp_path / "told"
    with process(told, where, "one") as one, process(told, where, "other") as other:
        drawn = [int(each.communicate()[0]) for each in (one, other)]
    assert sum(drawn) == len(ROWS) and Counter(told.read_text().split()) == {row["scenario_id"]: 1 for row in ROWS}
    assert contents(where) == {f"{row['scenario_id']}.mp4": f"frames of {row['scenario_id']}".encode() for row in ROWS}
    assert not list(tmp_path.rglob(LEASES))


@pytest.mark.slow
def test_what_a_process_that_is_killed_has_finished_is_kept_and_its_row_is_made_by_another(
    where: Sequence[str], tmp_path: Path
) -> None:
    told = tmp_path / "told"
    os.mkfifo(f"{told}.stop")
    # The pipe opens when it is read from: the row before may not have been handed over yet.
    with process(told, where, "one", "stops") as one, Path(f"{told}.stop").open("w"):
        one.kill()
        one.wait()
        drawn = made(opened(*where, "other"), told)
    counts, rows = Counter(told.read_text().split()), [row["scenario_id"] for row in ROWS]
    assert counts[rows[STOPS_AT]] == 2
    assert {name for name, count in counts.items() if count > 1} <= {*rows[STOPS_AT - 1 : STOPS_AT + 1]}
    assert counts.total() == STOPS_AT + 1 + drawn and drawn in (len(ROWS) - STOPS_AT, len(ROWS) - STOPS_AT + 1)
    assert contents(where).keys() == {f"{row['scenario_id']}.mp4" for row in ROWS}


@pytest.mark.slow
def test_what_lies_on_this_host_alone_is_handed_over_and_not_drawn(where: Sequence[str], tmp_path: Path) -> None:
    store, begun = opened(*where, "one"), ROWS[:2]
    for row in begun:
        write_bytes(store.root / "clips" / f"{row['scenario_id']}.mp4", b"made before a kill")
    assert made(store, tmp_path / "told") == len(ROWS) - len(begun)
    assert list(contents(where).values()).count(b"made before a kill") == len(begun)
    assert made(opened(*where, "other"), tmp_path / "told") == 0


def test_who_does_not_wait_makes_what_is_free_and_says_that_others_are_at_the_rest(where: Sequence[str]) -> None:
    one, other, done = opened(*where, "one"), opened(*where, "other"), list[int]()
    theirs = other.lease("videos/made/000001")
    assert theirs is not None
    of = RenderWork("videos/made", lambda rows: rows, lambda row: [], lambda row: None, draw)
    assert make_together(one, ROWS, of, done.append, wait=False) == (0, False)
    assert done[-1] == len(ROWS) - 1
    theirs.close()
    assert make_together(one, ROWS, of, done.append, wait=False) == (0, True)
