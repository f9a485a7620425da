"""Of an asset of many tables or figures only those are made again whose inputs, code or files changed."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import pytest

from traps_pipeline.pipeline import pieces
from traps_pipeline.pipeline.pieces import Piece, make_pieces
from traps_pipeline.storage.study import Study
from traps_pipeline.storage.workspace import Workspace


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
        self.made = Counter[str]()

    def piece(self, name: str, *reads: str) -> Piece:
        def make() -> dict[str, bytes]:
            self.made[name] += 1
            return {f"tables/{name}.md": f"{name}, made {self.made[name]} times".encode()}

        return Piece(name, make, reads)

    def make(self, *, code: str = "1", names: tuple[str, ...] = ("overall", "sub_scenarios")) -> list[str]:
        reads = {"overall": ("leaderboard",), "sub_scenarios": ("metrics", "items")}
        both = [self.piece(name, *reads[name]) for name in names]
        files, remade = make_pieces(self.workspace, "report_tables", code, both)
        assert [*files] == [f"tables/{name}.md" for name in names]
        self.workspace.store.write({self.workspace.reports / path: data for path, data in files.items()})
        return remade


@pytest.fixture
def report(tmp_path: Path, versions: dict[str, str]) -> Report:
    report = Report(tmp_path)
    assert report.make() == ["overall", "sub_scenarios"]
    return report


def test_nothing_is_made_again_while_nothing_changed(report: Report) -> None:
    assert report.make() == []
    assert report.made == {"overall": 1, "sub_scenarios": 1}


def test_a_table_is_made_again_when_a_partition_that_it_reads_changed(report: Report, versions: dict[str, str]) -> None:
    versions["metrics/chaotic"] = "2"
    assert report.make() == ["sub_scenarios"]


def test_a_changed_formula_makes_all_again(report: Report) -> None:
    assert report.make(code="2") == ["overall", "sub_scenarios"]


@pytest.mark.parametrize("damage", ["gone", "edited"])
def test_a_file_that_is_not_what_was_written_is_made_again(report: Report, damage: str) -> None:
    path = report.workspace.reports / "tables" / "overall.md"
    path.unlink() if damage == "gone" else path.write_text("99.9")
    assert report.make() == ["overall"]


def test_files_of_a_table_that_is_no_more_are_removed(report: Report) -> None:
    assert report.make(names=("overall",)) == []
    assert [path.name for path in (report.workspace.reports / "tables").iterdir()] == ["overall.md"]


def test_a_note_that_cannot_be_read_makes_all_again(report: Report) -> None:
    (report.workspace.reports / ".state" / "report_tables.pieces.json").write_text("{")
    assert report.make() == ["overall", "sub_scenarios"]


def test_a_picture_is_made_again_when_the_rows_that_it_shows_change_and_not_with_their_table(
    report: Report, versions: dict[str, str]
) -> None:
    def made_again(rows: list[str]) -> list[str]:
        picture = Piece("sheet", lambda: {"sheet.png": repr(rows).encode()}, inputs=rows)
        files, remade = make_pieces(report.workspace, "contact_sheet", "1", [picture])
        report.workspace.store.write({report.workspace.reports / path: data for path, data in files.items()})
        return remade

    assert made_again(["plinko-0001"]) == ["sheet"]
    versions["metrics/chaotic"] = "2"
    assert made_again(["plinko-0001"]) == []
    assert made_again(["plinko-0002"]) == ["sheet"]
