"""Segments of one machine: what a ledger of files has taken, no crash and no full disk loses."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from hashlib import blake2b
from pathlib import Path

import pytest

from traps_pipeline.base.errors import TrapsError
from traps_pipeline.storage.ledger import Ledger, Totals
from traps_pipeline.storage.lines import checked_line
from traps_pipeline.storage.segments import SegmentLedger

FILL = """
import resource, sys
from pathlib import Path
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.storage.ledger import Ledger
from traps_pipeline.storage.segments import SegmentLedger
resource.setrlimit(resource.RLIMIT_FSIZE, (2000, 2000))
try:
    with SegmentLedger(Path(sys.argv[1]), "answers").writer("m") as writer:
        for n in range(100):
            writer.append({"key": f"k{n}", "text": "x" * 100})
except TrapsError as error:
    print(error)
"""


@pytest.fixture
def ledger(tmp_path: Path) -> Ledger:
    return SegmentLedger(tmp_path, "answers")


def segments(ledger: Ledger) -> list[Path]:
    return sorted(ledger.folder("m").glob("*.jsonl"))


def write(ledger: Ledger, *rows: dict[str, object]) -> None:
    with ledger.writer("m") as writer:
        for row in rows:
            writer.append(row)


def answer(key: str, text: str) -> dict[str, object]:
    return {"key": key, "outcome": "answer", "text": text}


def test_a_writer_that_writes_nothing_leaves_no_file(ledger: Ledger) -> None:
    with ledger.writer("m"):
        pass
    assert segments(ledger) == []


def test_the_newest_row_of_a_key_wins_within_and_across_segments(ledger: Ledger) -> None:
    write(ledger, answer("a", "1"), answer("a", "2"), answer("b", "3"))
    assert ledger.read("m").rows["a"]["text"] == "2"
    write(ledger, answer("a", "4"))
    assert len(segments(ledger)) == 2
    assert {key: row["text"] for key, row in ledger.read("m").rows.items()} == {"a": "4", "b": "3"}


def test_segments_of_one_second_are_read_in_the_order_they_were_begun(ledger: Ledger) -> None:
    for n in range(20):
        write(ledger, answer("a", str(n)))
    assert ledger.read("m").rows["a"]["text"] == "19"


def test_a_torn_last_line_is_ignored_and_told_with_its_place(ledger: Ledger) -> None:
    write(ledger, {"key": "a"}, {"key": "b"})
    segment = segments(ledger)[0]
    segment.write_bytes(segment.read_bytes()[:-2])
    known = ledger.read("m")
    assert list(known.rows) == ["a"]
    assert "torn last line ignored" in known.notes[f"{segment}:2"]


@pytest.mark.parametrize("line", ["{not json", '"text"', '{"no": "key"}', ""])
def test_a_bad_line_of_an_early_segment_is_named_with_the_remedy(ledger: Ledger, line: str) -> None:
    ledger.folder("m").mkdir(parents=True)
    segment = ledger.folder("m") / "20261101T000000.jsonl"
    segment.write_text(f'{{"key": "a"}}\n{line}\n{{"key": "c"}}\n')
    with pytest.raises(TrapsError, match=rf"{segment.name}:2: not a ledger row .*remove that line and run again"):
        ledger.read("m")


def test_no_bit_of_a_segment_can_flip_unseen(ledger: Ledger) -> None:
    """Bits all over a small segment: the rows come back as they were, or a place is named."""
    rows = [answer(f"k{n}", "left") | {"cost_usd": 0.25, "components": {"participant": "m"}} for n in range(3)]
    write(ledger, *rows)
    (segment,) = segments(ledger)
    whole, written = ledger.read("m").rows, segment.read_bytes()
    silent = []
    for place in range(0, 8 * len(written), 7):  # in seven of eight bytes, each bit in turn
        flipped = bytearray(written)
        flipped[place // 8] ^= 1 << place % 8
        segment.write_bytes(flipped)
        known = ledger.read("m")
        spent = ledger.totals()
        assert sum(its.dollars + its.unknown * 0.25 for its in spent.values()) >= 0.75
        if not all(whole.get(key) == row for key, row in known.rows.items()) or (
            len(known.rows) < 3 and not known.notes
        ):
            silent.append(place)
    assert silent == []


def test_the_totals_of_a_long_segment_are_kept_and_counted_again_where_they_are_not_its_own(ledger: Ledger) -> None:
    row = answer("a", "x" * 1000) | {"cost_usd": 0.25, "components": {"participant": "m"}}
    write(ledger, *([row] * 300))
    assert ledger.totals() == {"m": Totals(75.0, 0.25)}
    (kept,) = ledger.folder("m").glob(".*.totals")
    written = kept.read_bytes()
    for damaged in (written.replace(b"75.0", b"15.0"), b"", b"no sums"):
        kept.write_bytes(damaged)
        assert ledger.totals() == {"m": Totals(75.0, 0.25)}
    (segment,) = segments(ledger)
    with segment.open("ab") as stream:
        stream.write(checked_line(row))
    assert ledger.totals() == {"m": Totals(75.25, 0.25)}


def test_values_that_no_table_holds_are_unknown_and_told(ledger: Ledger) -> None:
    ledger.folder("m").mkdir(parents=True)
    segment = ledger.folder("m") / "20261101T000000.jsonl"
    odd = {"prompt_tokens": 2**63, "completion_tokens": -1, "served_model": 5, "cost_usd": -1000.0}
    segment.write_text(json.dumps(answer("a", "left \ud83d") | odd) + "\n")
    known = ledger.read("m")
    assert known.rows["a"] == answer("a", "left ?") | dict.fromkeys(odd)
    assert list(known.notes) == [f"{segment}:1"] and "cost_usd" in known.notes[f"{segment}:1"]


def test_files_are_there_before_the_first_answer_and_go_if_there_is_none(ledger: Ledger) -> None:
    with ledger.writer("m") as writer:
        writer.open()
        assert len(list(ledger.folder("m").iterdir())) == 3
        writer.append({"key": "a"})
    assert len(list(ledger.folder("m").iterdir())) == 1


def test_reasoning_lies_in_a_sibling_file_and_comes_back_by_key(ledger: Ledger) -> None:
    with ledger.writer("m") as writer:
        writer.append({"key": "a", "text": "left"}, {"reasoning": "It rolls left."})
        writer.append({"key": "b", "text": "right"})
    assert ledger.reasoning("m") == {"a": "It rolls left."}
    assert "rolls" not in segments(ledger)[0].read_text()
    assert [path.name for path in ledger.folder("m").glob("*.reasoning")] == [segments(ledger)[0].name + ".reasoning"]


def test_a_row_is_in_the_file_before_append_returns(ledger: Ledger) -> None:
    with ledger.writer("m") as writer:
        writer.append({"key": "a"})
        seen = subprocess.run(["cat", str(segments(ledger)[0])], capture_output=True, check=True, text=True)
        assert seen.stdout == '{"key": "a", "sum": "' + blake2b(b'{"key": "a"', digest_size=8).hexdigest() + '"}\n'


def test_a_full_disk_loses_no_earlier_row_and_leaves_no_half_line(ledger: Ledger, tmp_path: Path) -> None:
    ran = subprocess.run([sys.executable, "-c", FILL, str(tmp_path)], capture_output=True, check=True, text=True)
    assert "could not be written (File too large)" in ran.stdout and "run the same command again" in ran.stdout
    known = ledger.read("m")
    line = len('{"key": "k10", "text": "", "sum": "0123456789abcdef"}\n') + 100
    assert len(known.rows) == 13  # 10 lines of 153 bytes and 3 of 154 are 1,992; a fourth would pass 2,000
    assert line == 154
    assert known.notes == {}
    write(ledger, {"key": "later"})
    assert len(ledger.read("m").rows) == 14


def test_a_disk_that_is_really_full_loses_no_earlier_row(tiny_disk: Path) -> None:
    ledger, written = SegmentLedger(tiny_disk, "answers"), 0
    with (
        pytest.raises(TrapsError, match=r"\.jsonl: .*No space left on device.*free some space"),
        ledger.writer("m") as w,
    ):
        for n in range(1000):
            w.append({"key": f"k{n}", "text": "x" * 300})
            written += 1
    assert written > 50
    known = ledger.read("m")
    assert list(known.rows) == [f"k{n}" for n in range(written)]
    assert known.notes == {}


@pytest.fixture
def fsyncs(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[int]]:
    counted: list[int] = []
    real = os.fsync

    def fsync(descriptor: int) -> None:
        counted.append(descriptor)
        real(descriptor)

    monkeypatch.setattr(os, "fsync", fsync)
    yield counted


def test_rows_reach_the_disk_every_hundred_rows_or_half_second(
    ledger: Ledger, fsyncs: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    clock = [100.0]
    monkeypatch.setattr(time, "monotonic", lambda: clock[0])
    with ledger.writer("m") as writer:
        for n in range(99):
            writer.append({"key": str(n)})
        assert len(fsyncs) == 0
        writer.append({"key": "99"})
        assert len(fsyncs) == 3  # the file and, once, its folder and the one above
        writer.append({"key": "100"})
        clock[0] += 0.49
        writer.sync_if_due()
        assert len(fsyncs) == 3
        clock[0] += 0.01
        writer.sync_if_due()
        assert len(fsyncs) == 4
        writer.sync_if_due()
        assert len(fsyncs) == 4  # nothing new to sync
        writer.append({"key": "101"})
    assert len(fsyncs) == 5  # closing syncs


def test_a_segment_to_which_nothing_was_written_asks_for_no_folder(ledger: Ledger) -> None:
    with ledger.writer("m") as writer:  # of a cell whose answers are all broken: no judge is asked
        writer.sync()
    assert not ledger.folder("m").exists()
