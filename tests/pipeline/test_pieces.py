"""Of the parts of an asset only those are made again whose inputs or code changed, or whose content is damaged."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import pytest

from traps_pipeline.base.archives import zip_bytes
from traps_pipeline.pipeline import pieces
from traps_pipeline.pipeline.pieces import Piece, make_pieces
from traps_pipeline.storage.study import Study
from traps_pipeline.storage.workspace import Workspace

READS = {"overall": ("leaderboard",), "sub_scenarios": ("metrics", "items")}


@pytest.fixture
def versions(monkeypatch: pytest.MonkeyPatch) -> dict[str, str]:
    """The versions of what the asset is made from, which a test changes."""
    now = {"metrics/chaotic": "1", "leaderboard": "1"}
    monkeypatch.setattr(pieces.Lineage, "inputs", lambda self, stage, key: dict(now))
    return now


class Report:
    """An asset of two tables that counts how often each was made."""

    def __init__(self, root: Path) -> None:
        self.workspace = Workspace.create(root / "study", Study())
        self.archive = self.workspace.reports / ".state" / "report_page.pieces.zip"
        self.made = Counter[str]()

    def piece(self, name: str) -> Piece:
        def make() -> bytes:
            self.made[name] += 1
            return f"{name}, made {self.made[name]} times".encode()

        return Piece(name, make, READS[name])

    def make(self, *, code: str = "1", names: tuple[str, ...] = ("overall", "sub_scenarios")) -> list[str]:
        contents, remade = make_pieces(self.workspace, "report_page", code, [self.piece(name) for name in names])
        assert contents == {name: f"{name}, made {self.made[name]} times".encode() for name in names}
        return remade


def flipped(data: bytes, bit: int) -> bytes:
    changed = bytearray(data)
    changed[bit // 8] ^= 1 << bit % 8
    return bytes(changed)


@pytest.fixture
def report(tmp_path: Path, versions: dict[str, str]) -> Report:
    report = Report(tmp_path)
    assert report.make() == ["overall", "sub_scenarios"]
    return report


def test_nothing_is_made_again_while_nothing_changed(report: Report) -> None:
    before = report.archive.stat().st_mtime_ns
    assert report.make() == []
    assert report.made == {"overall": 1, "sub_scenarios": 1}
    assert report.archive.stat().st_mtime_ns == before


def test_a_table_is_made_again_when_a_partition_that_it_reads_changed(report: Report, versions: dict[str, str]) -> None:
    versions["metrics/chaotic"] = "2"
    assert report.make() == ["sub_scenarios"]
    assert report.make() == []


def test_a_changed_formula_makes_all_again(report: Report) -> None:
    assert report.make(code="2") == ["overall", "sub_scenarios"]


@pytest.mark.parametrize(
    "content", [None, b"{", zip_bytes({"inputs.json": b"[]"}), zip_bytes({"inputs.json": b'{"overall": 1}'})]
)
def test_what_is_no_archive_of_pieces_makes_all_again(report: Report, content: bytes | None) -> None:
    report.archive.unlink() if content is None else report.archive.write_bytes(content)
    assert report.make() == ["overall", "sub_scenarios"]


def test_a_flip_of_any_bit_makes_the_archive_again_or_changes_nothing(report: Report) -> None:
    data, rebuilt = report.archive.read_bytes(), Counter[int]()
    for bit in range(0, 8 * len(data), 11):
        report.archive.write_bytes(flipped(data, bit))
        report.made = Counter(overall=1, sub_scenarios=1)
        contents, _ = make_pieces(report.workspace, "report_page", "1", [*map(report.piece, READS)])
        n_made = sum(report.made.values()) - 2
        assert contents == {name: f"{name}, made {report.made[name]} times".encode() for name in READS}
        rebuilt[n_made] += 1
    assert {*rebuilt} <= {0, 1, 2} and rebuilt[2] > 0.5 * rebuilt.total()


def test_a_table_that_is_no_more_leaves_the_archive(report: Report) -> None:
    assert report.make(names=("overall",)) == []
    assert report.make() == ["sub_scenarios"]


def test_a_picture_is_made_again_when_the_rows_that_it_shows_change_and_not_with_their_table(
    report: Report, versions: dict[str, str]
) -> None:
    def made_again(rows: list[str]) -> list[str]:
        picture = Piece("sheet", lambda: repr(rows).encode(), ("metrics",), lambda: rows)
        return make_pieces(report.workspace, "site", "1", [picture])[1]

    assert made_again(["plinko-0001"]) == ["sheet"]
    versions["metrics/chaotic"] = "2"
    assert made_again(["plinko-0001"]) == []
    versions["metrics/chaotic"] = "3"
    assert made_again(["plinko-0002"]) == ["sheet"]
    assert made_again(["plinko-0002"]) == []


def test_rows_are_not_looked_at_while_their_table_is_the_same(report: Report, versions: dict[str, str]) -> None:
    looked = list[str]()

    def look() -> list[str]:
        looked.append(versions["metrics/chaotic"])
        return ["plinko-0001"]

    for version in ("1", "1", "2", "2"):
        versions["metrics/chaotic"] = version
        make_pieces(report.workspace, "site", "1", [Piece("sheet", lambda: b"drawn", ("metrics",), look)])
    assert looked == ["1", "2"]
