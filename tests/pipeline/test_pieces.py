"""Of the parts of an asset only those are made again whose inputs or code changed, or whose content is damaged."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import pytest

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


@pytest.mark.parametrize("damage", ["gone", "no archive", "a flipped byte"])
def test_a_damaged_archive_makes_all_again(report: Report, damage: str) -> None:
    data = report.archive.read_bytes()
    at = data.index(b"sub_scenarios", data.index(b"PK\x03\x04", 4)) + len("sub_scenarios")  # in a member's content
    flipped = data[:at] + bytes([data[at] ^ 255]) + data[at + 1 :]
    report.archive.unlink() if damage == "gone" else report.archive.write_bytes(
        b"{" if damage == "no archive" else flipped
    )
    assert report.make() == ["overall", "sub_scenarios"]


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


def test_what_all_studies_have_in_common_is_made_once_for_a_user(
    tmp_path: Path, versions: dict[str, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    made = list[str]()

    def make(study: str, code: str = "1") -> bytes:
        def paper() -> bytes:
            made.append(study)
            return f"made in {study} by {code}".encode()

        workspace = Workspace.create(tmp_path / study, Study())
        contents, remade = make_pieces(workspace, "report_page", code, [Piece("paper", paper, is_shared=True)])
        assert remade == ["paper"]
        return contents["paper"]

    assert {make("first"), make("second")} == {b"made in first by 1"}
    assert made == ["first"]
    assert make("third", code="2") == b"made in third by 2"
    (tmp_path / "cache" / "traps" / "report_page.pieces.zip").write_bytes(b"damaged")
    assert make("fourth", code="2") == b"made in fourth by 2"
