"""Rooms of the package import downwards only, and no files import each other in a circle."""

from __future__ import annotations

import ast
import re
import shutil
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import cache
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

import traps_pipeline
from tests.room_lines import TOTAL, excesses, lines_by_room, read_budgets

PACKAGE = Path(traps_pipeline.__file__).parent
# From bottom to top. A room imports rooms that stand before it here, and none that stands behind it: neither at the top
# of a file nor inside a function nor for types alone.
ROOMS = (
    "base", "protocol", "video", "scenes", "ledger", "storage", "benchmark", "models", "judging", "scoring",
    "mechanism", "people", "inside", "checks", "report", "pipeline", "exchange", "release", "servers", "definitions",
    "cli",
)  # fmt: skip
# The same for what lies in the room of scenes, whose largest rooms are folders.
SCENES = (
    "physics", "picture", "parts", "families", "family_registry", "observe", "worlds", "certification", "draw",
    "variants",
)  # fmt: skip
# For models: a call, how answers are read, what is declared, what is paid, how calls are sent and asked.
MODELS = ("request", "framing", "reading", "baselines", "registry", "local", "money", "wire", "asking")


@cache
def files() -> dict[str, Path]:
    """Every file of the package by its module's name."""
    named = {}
    for path in PACKAGE.rglob("*.py"):
        parts = [PACKAGE.name, *path.relative_to(PACKAGE).with_suffix("").parts]
        named[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return named


@cache
def imports() -> dict[str, list[tuple[int, str]]]:
    """Line and module of each import of ours, wherever in a file it stands, by the name of the module that imports."""
    return {module: [*_imported(path.read_text(encoding="utf-8"))] for module, path in files().items()}


def _imported(source: str) -> Iterator[tuple[int, str]]:
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0 and node.module, f"line {node.lineno}: name the package in an import"
            whole = [f"{node.module}.{alias.name}" for alias in node.names]
            names = [name if name in files() else node.module for name in whole]
        else:
            continue
        yield from ((node.lineno, name) for name in names if name in files())


def room_of(module: str) -> str:
    return module.split(".")[1] if "." in module else ""


def test_every_room_has_its_place_and_every_place_a_room() -> None:
    assert {room_of(module) for module in files()} - {""} == {*ROOMS}
    assert len({*ROOMS}) == len(ROOMS)


def test_contributing_lists_the_rooms_from_top_to_bottom() -> None:
    page = (PACKAGE.parent / "CONTRIBUTING.md").read_text(encoding="utf-8")
    section = page.partition("## Where things are\n")[2].partition("\n## ")[0]
    lines = section.partition("```text\n")[2].partition("```")[0].splitlines()
    listed = [name.removesuffix(".py").rstrip("/") for line in lines for name in line.split("  ")[0].split(", ")]
    assert listed == [*reversed(ROOMS)]
    assert len(lines) <= 10


def upwards(below: str, order: Sequence[str]) -> list[str]:
    """Imports of a folder above one's own, of all modules below a package whose folders lie in this order."""
    height, deep = {folder: number for number, folder in enumerate(order)}, below.count(".") + 1
    return [
        f"{files()[module].relative_to(PACKAGE)}:{line} imports {name}"
        for module, found in imports().items()
        for line, name in found
        if module.startswith(f"{below}.") and name.startswith(f"{below}.")
        if height[name.split(".")[deep]] > height[module.split(".")[deep]]
    ]


def test_no_room_imports_one_above_it() -> None:
    assert upwards(PACKAGE.name, ROOMS) == []


@pytest.mark.parametrize(("room", "order"), [("scenes", SCENES), ("models", MODELS)])
def test_no_folder_of_a_room_imports_one_above_it(room: str, order: Sequence[str]) -> None:
    assert {module.split(".")[2] for module in files() if module.startswith(f"{PACKAGE.name}.{room}.")} == {*order}
    assert upwards(f"{PACKAGE.name}.{room}", order) == []


def test_no_files_import_each_other_in_a_circle() -> None:
    graph = {module: {name for _, name in found} for module, found in imports().items()}
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        pytest.fail(" <- ".join(error.args[1]))


def test_the_package_for_several_hosts_is_asked_for_in_one_place_and_has_what_is_asked() -> None:
    """Nothing here imports it: its name is written where it is loaded by name, and where its extra is declared."""
    naming = [
        path.relative_to(PACKAGE).as_posix()
        for path in files().values()
        if "traps_cluster" in re.sub(r"`[^`]*`", "", path.read_text(encoding="utf-8"))
    ]
    assert sorted(naming) == ["base/extras.py", "storage/several_hosts.py"]
    files_of_both = (PACKAGE / "storage" / "several_hosts.py", PACKAGE.parent / "traps_cluster" / "entry.py")
    asked, entry = (ast.parse(path.read_text()) for path in files_of_both)
    (protocol,) = (node for node in asked.body if isinstance(node, ast.ClassDef))
    functions = [node.name for node in protocol.body if isinstance(node, ast.FunctionDef)]
    (has,) = (
        ast.literal_eval(node.value)
        for node in entry.body
        if isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == "__all__"
    )
    assert sorted(functions) == sorted(has) and len(functions) <= 6


def test_files_are_short_but_for_those_that_the_rules_defend() -> None:
    rules = (PACKAGE.parent / "CONTRIBUTING.md").read_text()
    defended = re.findall(r"^  - `(.+)`: ", rules[rules.index("at most 400 lines") :], re.MULTILINE)
    lines = {name: len((PACKAGE / name).read_text().splitlines()) for name in defended}
    assert lines and min(lines.values()) > 400, f"no longer in need of a defence: {lines}"
    long = {str(path.relative_to(PACKAGE)) for path in PACKAGE.rglob("*.py") if path.read_text().count("\n") > 400}
    assert long == set(defended)


def test_no_room_is_larger_than_its_budget_and_all_together_no_larger_than_at_030() -> None:
    budgets = read_budgets()
    assert [*excesses(lines_by_room(), budgets)] == []
    assert sum(budget.lines_030 for budget in budgets.values()) == TOTAL


def test_a_planted_growth_is_named_with_its_room(tmp_path: Path) -> None:
    budgets = {room: replace(budget, lines=lines_by_room()[room]) for room, budget in read_budgets().items()}
    shutil.copytree(PACKAGE, tmp_path / "package", ignore=shutil.ignore_patterns("__pycache__"))
    with (tmp_path / "package" / "video" / "encode.py").open("a") as file:
        file.write("\n")
    (sentence,) = excesses(lines_by_room(tmp_path / "package"), budgets)
    assert sentence.startswith("video: ") and ", 1 above its budget" in sentence


def test_a_budget_is_raised_with_a_reason_and_paid_by_another_room() -> None:
    budgets = read_budgets()
    counts = {room: budget.lines for room, budget in budgets.items() if budget.lines}
    more = TOTAL - sum(counts.values()) + 1
    raised = replace(budgets["video"], lines=budgets["video"].lines_030 + more, reason="")
    broken = [*excesses(counts | {"video": raised.lines}, budgets | {"video": raised})]
    assert "has no reason" in broken[0] and f"above {TOTAL}" in broken[1]
    assert len(broken) == 2
