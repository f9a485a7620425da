"""Declare a stage or a source by a decorator.

`@stage(TABLE, ...)` declares that a function makes a table (or files for people), `@source(...)` that one returns the
version of something that people edit. `pipeline.assets` builds Dagster's assets from them, `pipeline.step` their
partitions.
"""

from collections.abc import Callable, Collection, Sequence
from functools import cache, wraps
from typing import Any

from traps_pipeline.base.digests import digest, file_digest
from traps_pipeline.base.paths import PACKAGE
from traps_pipeline.pipeline.graph import (
    DECLARED,
    GROUPS,
    Check,
    ConcurrentBuild,
    Cost,
    Parent,
    RunResources,
    Source,
    Stage,
    UpstreamPolicy,
)
from traps_pipeline.pipeline.partitioning import KeyMapping, Partitioning
from traps_pipeline.pipeline.previews import rows_shown
from traps_pipeline.pipeline.schemes import LEFT_OUT
from traps_pipeline.pipeline.wanted import StudyPartitions
from traps_pipeline.storage.parquet import StageOutput
from traps_pipeline.storage.tables import Table
from traps_pipeline.storage.workspace import Workspace

# Stages of these groups take seconds, so their code version hashes every file of these rooms. Others cost money or
# time, and state a version that is raised by hand.
_FOLLOWED = {"report": ("protocol", "report")} | dict.fromkeys(
    ("scoring", "judging", "people"), ("protocol", "judging", "scoring", "people")
)

SHARED_IN_RUN: dict[str, Any] = {}  # what stages of one Dagster run share; empty after its end


@cache
def code_of(group: str) -> str:
    """Return the code version of a group of cheap, fast stages."""
    paths = [path for room in _FOLLOWED.get(group, ()) for path in sorted((PACKAGE / room).rglob("*"))]
    files = [path for path in paths if path.is_file() and path.suffix != ".pyc"]
    return digest({path.relative_to(PACKAGE).as_posix(): file_digest(path) for path in files})[:12] if files else "1"


def is_declared(name: str) -> bool:
    """Return whether a stage or source is declared and part of the study's graph."""
    return name in DECLARED


def dep(parent: Stage | Source | str, mapping: KeyMapping | None = None, *, need: UpstreamPolicy = "every") -> Parent:
    """Return a stage's dependency on a parent, with its mapping and what it needs."""
    return Parent(parent if isinstance(parent, str) else parent.name, mapping, need)


def source(
    *, group: str, kinds: Sequence[str], scheme: Partitioning | None = None
) -> Callable[[Callable[[Workspace, Any], str]], Source]:
    """Declare a source by the function of its name, which returns its data version."""

    def declare(version: Callable[[Workspace, Any], str]) -> Source:
        declaration = Source(version.__name__, version, group, _result(_doc(version)), kinds, scheme)
        _declare(declaration)
        return declaration

    return declare


def stage(
    table: Table | str,
    *,
    group: str,
    parents: Sequence[Parent | Stage | Source],
    scheme: Partitioning | None = None,
    code: str = "",
    cost: Cost = "",
    checks: Sequence[Check] = (),
    kinds: Collection[str] = ("parquet",),
    wants: Callable[[StudyPartitions, Any], bool] = lambda study, key: True,
    lost: Callable[[Workspace, Any], list[str]] = lambda workspace, key: [],
    takes: RunResources | None = None,
    shared: ConcurrentBuild | None = None,
    side_by_side: bool = False,
) -> Callable[[Callable[[Workspace, Any], Any]], Stage]:
    """Declare the function behind a table or, given a name, files (`graph.Stage`).

    The description is the function's docstring, without its "Return"; the code is `code_of` the group, unless stated.
    It returns a StageOutput, or rows alone (numbers and ids, never text that a model wrote), which are then shown.
    side_by_side: it gets the keys of several partitions, and yields each with its StageOutput or TrapsError.
    """

    def declare(function: Callable[[Workspace, Any], Any]) -> Stage:
        @wraps(function)
        def make(workspace: Workspace, key: Any) -> StageOutput:
            output = function(workspace, key)
            return output if isinstance(output, StageOutput) or isinstance(table, str) else _with_preview(table, output)

        upstream = [parent if isinstance(parent, Parent) else dep(parent) for parent in parents]
        declaration = Stage(
            name=table if isinstance(table, str) else table.name,
            table=None if isinstance(table, str) else table,
            make=function if side_by_side else make,
            group=group,
            parents={parent.name: parent for parent in upstream},
            doc=_result(_doc(function)),
            scheme=scheme,
            checks=checks,
            kinds=[*kinds],
            code=code or ("1" if cost else code_of(group)),
            cost=cost,
            wants=wants,
            lost=lost,
            takes=takes or RunResources(),
            shared=shared,
            side_by_side=side_by_side,
        )
        _declare(declaration)
        return declaration

    return declare


def _with_preview(table: Table, rows: Any) -> StageOutput:
    """Return a frame (or values of the table's dataclass) with a preview."""
    import pandas as pd

    frame = rows if isinstance(rows, pd.DataFrame) else pd.DataFrame(list(rows), columns=pd.Index(table.names))
    return StageOutput(frame, shown={table.name: rows_shown(frame)})


def _doc(function: Callable[..., Any]) -> str:
    return " ".join((function.__doc__ or "").split())


def _result(doc: str) -> str:
    """Return what a docstring says that a function returns, for Dagster."""
    text = doc.removeprefix("Return ").removeprefix("Yield ").removeprefix("the version of ")
    return text[:1].upper() + text[1:]


def _declare(node: Stage | Source) -> None:
    if node.group not in GROUPS:
        raise ValueError(f"{node.name}: no job makes the group {node.group}; add it to JOB_GROUPS")
    if node.group not in LEFT_OUT:
        DECLARED[node.name] = node
