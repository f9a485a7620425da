"""Build Dagster's assets from the declared stages and sources."""

from collections.abc import Generator, Iterator
from contextlib import ExitStack
from typing import Any, cast

import dagster as dg
from pydantic import PrivateAttr
from typing_extensions import override

from traps_pipeline.pipeline.graph import Graph, Source, Stage
from traps_pipeline.pipeline.metadata import errors_for_pages
from traps_pipeline.pipeline.partition_checks import CURRENT, CURRENT_DOC
from traps_pipeline.pipeline.stage import SHARED_IN_RUN
from traps_pipeline.pipeline.step import Event, guard_events, run_step
from traps_pipeline.pipeline.translation import asset_deps, asset_key, partitions_of
from traps_pipeline.storage.tables import Table
from traps_pipeline.storage.workspace import Workspace

OWNERS = ["team:benchmark"]


class WorkspaceResource(dg.ConfigurableResource):
    """The Dagster resource that opens the workspace of the study whose partitions are loaded.

    It is no run configuration. Dagster stores that with a run, so a run repeated in a copy of the study would write to
    the original.
    """

    _steps: ExitStack = PrivateAttr(default_factory=ExitStack)

    def until_torn_down(self, events: Generator[Event, None, None]) -> Iterator[Event]:
        """Yield the events of a step, and close the step when the run ends at the latest.

        Dagster abandons a step if it cannot write an event. Closing it here stores the calls in flight and releases its
        locks; the garbage collector would wait forever for the threads of these calls.
        """
        self._steps.callback(events.close)
        return events

    @override
    def teardown_after_execution(self, context: dg.InitResourceContext) -> None:
        self._steps.close()
        SHARED_IN_RUN.clear()

    def open(self) -> Workspace:
        """Return the workspace. Raises TrapsError with a remedy where there is none."""
        return Workspace.open()


def assets_of(graph: Graph) -> list[dg.AssetsDefinition]:
    """Return Dagster's assets: one for each stage, and an observable one for each source."""
    return [
        _asset(graph, declaration) if isinstance(declaration, Stage) else _observable(declaration)
        for declaration in graph.declared.values()
    ]


def _observable(source: Source) -> dg.AssetsDefinition:
    partitions = partitions_of(source.scheme) if source.scheme else None

    @dg.observable_source_asset(
        key=asset_key(source.name),
        partitions_def=partitions,
        group_name=source.group,
        description=source.doc,
        tags={f"dagster/kind/{kind}": "" for kind in source.kinds},
        metadata={"owner": OWNERS[0]},
    )
    def observe(workspace: WorkspaceResource) -> dg.DataVersion | dg.DataVersionsByPartition:
        with errors_for_pages():
            study, keys = workspace.open(), source.scheme.keys if source.scheme else ()
            if source.scheme is None:
                return dg.DataVersion(source.version(study, None))
            return dg.DataVersionsByPartition({key: source.version(study, key) for key in keys})

    return cast(dg.AssetsDefinition, observe)


def _asset(graph: Graph, stage: Stage) -> dg.AssetsDefinition:
    key, partitions = asset_key(stage.name), partitions_of(stage.scheme) if stage.scheme else None
    docs = [(check, "" if check.blocks else " A failure is a warning and blocks nothing.") for check in stage.checks]
    checks = [(CURRENT, CURRENT_DOC, False), *((check.name, check.doc + note, check.blocks) for check, note in docs)]

    @dg.asset(
        key=key,
        deps=asset_deps(graph, stage.name),
        description=stage.doc,
        group_name=stage.group,
        kinds={*stage.kinds},
        owners=OWNERS,
        partitions_def=partitions,
        metadata=_contract(stage.table) if stage.table is not None else {},
        code_version=stage.code,
        tags={"cost": stage.cost} if stage.cost else None,
        backfill_policy=dg.BackfillPolicy.single_run() if stage.scheme else None,
        output_required=False,
        check_specs=[
            dg.AssetCheckSpec(name, asset=key, description=doc, blocking=blocks, partitions_def=partitions)
            for name, doc, blocks in checks
        ],
    )
    def asset(context: dg.AssetExecutionContext, workspace: WorkspaceResource) -> Iterator[Event]:
        with errors_for_pages():
            events = guard_events(run_step(stage, context, workspace.open()), context)
            yield from workspace.until_torn_down(events)

    return asset


def _contract(table: Table) -> dict[str, Any]:
    """Return a table's columns and the meaning of a row, as Dagster shows them."""
    columns = [
        dg.TableColumn(c.name, c.type_name, c.doc, dg.TableColumnConstraints(nullable=c.nullable))
        for c in table.columns
    ]
    return {"dagster/column_schema": dg.TableSchema(columns=columns), "one row is": table.row}
