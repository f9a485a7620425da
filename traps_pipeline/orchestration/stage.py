"""The one declaration of a stage or source: what people edit, what is made of it, and how Dagster shows both.

`stage(...)` gives the Dagster asset of a table (or of files for people), `source(...)` that of something that people
edit. `orchestration.step` makes its partitions.
"""

import os
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any, cast

import dagster as dg

from traps_pipeline.base.digests import digest, file_digest
from traps_pipeline.base.paths import PACKAGE
from traps_pipeline.orchestration.graph import DECLARED, GROUPS, Check, Cost, Need, Shared, Source, Stage, Takes
from traps_pipeline.orchestration.schemes import LEFT_OUT, Scheme, study_here
from traps_pipeline.orchestration.step import CURRENT, CURRENT_DOC, Event, Step
from traps_pipeline.orchestration.wanted import Wanted
from traps_pipeline.storage.parquet import Made
from traps_pipeline.storage.place import place_of
from traps_pipeline.storage.tables import Table
from traps_pipeline.storage.workspace import Workspace

OWNERS = ["team:benchmark"]


class WorkspaceResource(dg.ConfigurableResource):
    """The study that a run works in."""

    root: str

    def open(self) -> Workspace:
        """The workspace. Raises TrapsError naming the remedy where there is none."""
        return Workspace.open(place_of(self.root))


def key_of(name: str) -> dg.AssetKey:
    """The asset key of a stage or source: its name, behind the study's where several studies share one history."""
    return dg.AssetKey([*_PREFIX, name])


def _shared_history() -> list[str]:
    home, workspace = os.environ.get("DAGSTER_HOME"), study_here()
    if workspace is not None and (workspace.is_shared or workspace.is_on_cluster):
        return [workspace.study.name]  # several studies share its database, and so may share its history
    if workspace is None or not home or Path(home).resolve() == workspace.dagster_home.resolve():
        return []
    return [workspace.study.name] if workspace.study.name else []


_PREFIX = _shared_history()


# Stages of these groups take seconds: their code version follows every file of these rooms. Others cost money or take
# long, and state one that is raised by hand.
_FOLLOWED = {"report": ("report",)} | dict.fromkeys(("scoring", "judging", "people"), ("judging", "scoring"))


@cache
def code_of(group: str) -> str:
    """Return the code version of a group's stages that take no money and little time."""
    paths = [path for room in _FOLLOWED.get(group, ()) for path in sorted((PACKAGE / room).rglob("*"))]
    files = [path for path in paths if path.is_file() and path.suffix != ".pyc"]
    return digest({path.relative_to(PACKAGE).as_posix(): file_digest(path) for path in files})[:12] if files else "1"


def shown(name: str) -> bool:
    """Whether a stage or source, declared before, is part of the study's graph."""
    return name in DECLARED


def _declare(name: str, one: Stage | Source) -> None:
    if one.spec.group_name not in GROUPS:
        raise ValueError(f"{name}: no job makes the group {one.spec.group_name}; add it to JOB_GROUPS")
    if one.spec.group_name not in LEFT_OUT:
        DECLARED[name] = one


def source(
    name: str,
    version: Callable[[Workspace, Any], str],
    *,
    group: str,
    doc: str,
    kinds: Collection[str],
    scheme: Scheme | None = None,
) -> dg.AssetsDefinition:
    """An observable source asset whose data version, by partition where it has any, is made from its content."""
    spec = dg.AssetSpec(key_of(name), group_name=group)
    _declare(name, Source(spec, version, scheme))

    @dg.observable_source_asset(
        key=spec.key,
        partitions_def=scheme.definition if scheme else None,
        group_name=group,
        description=doc,
        tags={f"dagster/kind/{kind}": "" for kind in kinds},
        metadata={"owner": OWNERS[0]},
    )
    def observe(workspace: WorkspaceResource) -> dg.DataVersion | dg.DataVersionsByPartition:
        opened = workspace.open()
        if scheme is None:
            return dg.DataVersion(version(opened, None))
        keys = map(str, scheme.definition.get_partition_keys())
        return dg.DataVersionsByPartition({key: version(opened, key) for key in keys})

    return cast(dg.AssetsDefinition, observe)


def stage(
    table: Table | str,
    make: Callable[[Workspace, Any], Made] | None = None,
    *,
    collect: Callable[[Workspace, Sequence[str]], Iterator[tuple[str | None, Made]]] | None = None,
    group: str,
    deps: Sequence[Any],
    doc: str = "",
    scheme: Scheme | None = None,
    needs: Mapping[str, Need] | None = None,
    checks: Sequence[Check] = (),
    kinds: Collection[str] = (),
    code: str = "",
    cost: Cost = "",
    wants: Callable[[Wanted, Any], bool] = lambda wanted, key: True,
    lost: Callable[[Workspace, Any], list[str]] = lambda workspace, key: [],
    columns: Mapping[str, Collection[str]] | None = None,
    takes: Takes | None = None,
    shared: Shared | None = None,
) -> dg.AssetsDefinition:
    """The asset of a table, or of files for people where only a name is given (see `graph.Stage` for the parameters).

    The description is `doc`, else the docstring of `make` or `collect`; the code is `code_of` the group, unless stated.
    columns: columns of parents that a column is made from, as `parent.column`, where that is known.
    """
    name = table if isinstance(table, str) else table.name
    described = doc or (make or collect).__doc__ or ""
    code = code or ("1" if cost else code_of(group))
    spec = dg.AssetSpec(
        key_of(name),
        deps=deps,
        description=" ".join(described.split()),
        group_name=group,
        kinds={*kinds} or {"parquet"},
        owners=OWNERS,
        partitions_def=scheme.definition if scheme else None,
        metadata={} if isinstance(table, str) else _table_metadata(table, columns or {}),
        code_version=code,
        tags={"cost": cost} if cost else {},
    )
    content = None if isinstance(table, str) else table
    declared = Stage(
        spec, content, make, collect, scheme, needs or {}, checks, code, cost, wants, lost, takes or Takes(), shared
    )
    _declare(name, declared)
    specs = [(CURRENT, CURRENT_DOC, False), *((check.name, check.doc, check.blocks) for check in checks)]

    @dg.asset(
        key=spec.key,
        deps=deps,
        description=spec.description,
        group_name=group,
        kinds=set(spec.kinds),
        owners=OWNERS,
        partitions_def=spec.partitions_def,
        metadata=spec.metadata,
        code_version=code,
        tags={"cost": cost} if cost else None,
        backfill_policy=dg.BackfillPolicy.single_run() if scheme else None,
        output_required=False,
        check_specs=[
            dg.AssetCheckSpec(n, asset=spec.key, description=d, blocking=b, partitions_def=spec.partitions_def)
            for n, d, b in specs
        ],
    )
    def asset(context: dg.AssetExecutionContext, workspace: WorkspaceResource) -> Iterator[Event]:
        yield from Step(declared, context, workspace.open()).run()

    return asset


def _table_metadata(table: Table, made_from: Mapping[str, Collection[str]]) -> dict[str, Any]:
    """A table's contract as Dagster shows it."""
    columns = [
        dg.TableColumn(c.name, c.type_name, c.doc, dg.TableColumnConstraints(nullable=c.nullable))
        for c in table.columns
    ]
    metadata: dict[str, Any] = {"dagster/column_schema": dg.TableSchema(columns=columns), "one row is": table.row}
    if made_from:
        sources = {
            column: [
                dg.TableColumnDep(key_of(above.partition(".")[0]), above.partition(".")[2]) for above in sorted(parents)
            ]
            for column, parents in made_from.items()
        }
        metadata["dagster/column_lineage"] = dg.TableColumnLineage(sources)
    return metadata
