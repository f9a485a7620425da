"""The mechanism group: hidden states of local models, probes, void directions, steering (`benchmark.md` 7 and 8)."""

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import dagster as dg

from traps_pipeline import progress
from traps_pipeline.defs import common
from traps_pipeline.defs.benchmark import items, scene_specs, videos
from traps_pipeline.defs.common import OWNERS, Checks, Events, by_dataset, check, table_metadata
from traps_pipeline.defs.evaluation import judges, verdicts
from traps_pipeline.errors import TrapsError
from traps_pipeline.lineage import Lineage, standard_cells
from traps_pipeline.partitions import (
    ANSWERABLE,
    DATASETS,
    OCCLUSION_CATEGORIES,
    Extraction,
    StatesCell,
    SteeringCell,
)
from traps_pipeline.progress import Tally
from traps_pipeline.storage.workspace import Workspace
from traps_pipeline.tables import (
    COSINES,
    DIRECTIONS,
    HIDDEN_STATES,
    PROBE_ITEMS,
    PROBES,
    STEERING,
    STEERING_EFFECTS,
    STEERING_SHARES,
    STEERING_VOTES,
    Table,
)

if TYPE_CHECKING:
    import pandas as pd

GROUP = "mechanism"
PROBED, EXTRACTION, STATES = common.PROBED, common.EXTRACTION, common.STATES
STEERED, STEERING_CELL = common.STEERED, common.STEERING_CELL
by_extraction = dg.MultiToSingleDimensionPartitionMapping("extraction")
_OCCLUSION = dg.StaticPartitionMapping(dict.fromkeys(OCCLUSION_CATEGORIES, ANSWERABLE))
by_steering = dg.MultiToSingleDimensionPartitionMapping("steering")

extraction_settings = common.source_asset(
    "extraction_settings", GROUP, "What decides hidden states besides items: checkpoint, precision, prompt.", ["yaml"]
)
probing_settings = common.source_asset(
    "probing_settings", GROUP, "The study's settings of probes and directions, by model.", ["yaml"]
)
steering_settings = common.source_asset(
    "steering_settings", GROUP, "The study's settings of steering, the model and its prompt.", ["yaml"]
)


def _made(
    context: dg.AssetExecutionContext, table: Table, partition: dict[str, Any], rows: Sequence[Any], made: int = 0
) -> dg.AssetMaterialization:
    """Write a partition and tell Dagster. made: items that were extracted for it."""
    workspace, key = Workspace.open(), context.partition_key
    provenance, inputs = common.provenance(context, workspace), Lineage(workspace).inputs(table.name, key)
    version = workspace.tables.write(table, partition, rows, inputs)
    progress.current().partition(table.name, key, Tally(asked=made))
    metadata: dict[str, Any] = {"dagster/partition_row_count": len(rows), "extracted": made}
    return common.materialized(context, key, version, provenance, **metadata)


def _asset(
    table: Table,
    partitions: dg.PartitionsDefinition,
    deps: Sequence[Any],
    *checks: dg.AssetCheckSpec,
    kinds: Sequence[str] = (),
) -> Callable[[Callable[[dg.AssetExecutionContext], Events]], dg.AssetsDefinition]:
    """An asset of this group that is a partitioned table and writes itself."""
    return dg.asset(
        partitions_def=partitions,
        deps=deps,
        group_name=GROUP,
        kinds={"parquet", *kinds},
        owners=OWNERS,
        metadata=table_metadata(table.name),
        output_required=False,
        check_specs=checks,
    )


@_asset(
    PROBE_ITEMS,
    PROBED,
    [
        dg.AssetDep(items, partition_mapping=dg.StaticPartitionMapping({d: d for d in DATASETS})),
        *(
            dg.AssetDep(
                above, partition_mapping=dg.StaticPartitionMapping(dict.fromkeys(OCCLUSION_CATEGORIES, ANSWERABLE))
            )
            for above in (scene_specs, videos)
        ),
    ],
)
def probe_items(context: dg.AssetExecutionContext) -> Events:
    """Clips and questions that hidden states are extracted of: a dataset's items, or occlusion's void clips with a
    question that even they answer."""
    from traps_pipeline.mechanism.stages import probe_items as rows_of

    dataset = context.partition_key
    yield _made(context, PROBE_ITEMS, {"dataset": dataset}, rows_of(Workspace.open(), dataset))


@_asset(
    HIDDEN_STATES,
    STATES,
    [
        dg.AssetDep(probe_items, partition_mapping=by_dataset),
        dg.AssetDep(extraction_settings, partition_mapping=by_extraction),
    ],
    check("states_finite", "hidden_states", "Every number of the first and last layer is finite."),
    kinds=["pytorch"],
)
def hidden_states(context: dg.AssetExecutionContext) -> Events:
    """Hidden states of a frozen local model at every layer, one row an item; only what is not there is extracted."""
    from traps_pipeline.mechanism.stages import extract_states, unsound_layers

    workspace, cell = Workspace.open(), StatesCell.parse(context.partition_key)
    rows, new = extract_states(workspace, cell)
    checks = Checks(context, workspace)
    checks.record("states_finite", cell.key, unsound_layers(workspace, cell, rows[0]["n_layers"]))
    yield _made(context, HIDDEN_STATES, cell.partition, rows, new)
    yield from checks.results()


@_asset(
    PROBES,
    EXTRACTION,
    [
        dg.AssetDep(hidden_states, partition_mapping=by_extraction),
        dg.AssetDep(verdicts, partition_mapping=dg.SpecificPartitionsPartitionMapping(standard_cells())),
        probing_settings,
    ],
    check("shares_are_shares", "probes", "Every figure and interval lies in [0, 1]."),
    kinds=["scikitlearn"],
)
def probes(context: dg.AssetExecutionContext) -> Events:
    """Probes of every dataset on every other at every layer: transfer, Cf->Cf, within, label-shuffled, centroids."""
    from traps_pipeline.mechanism.stages import probe_rows

    workspace, extraction = Workspace.open(), Extraction.parse(context.partition_key)
    rows = probe_rows(workspace, extraction)
    wrong = [row for row in rows if any(v is not None and not -1e-9 <= v <= 1 + 1e-9 for v in _figures(row))]
    checks = Checks(context, workspace)
    checks.record("shares_are_shares", extraction.key, f"{len(wrong)} rows are wrong" if wrong else "")
    yield _made(context, PROBES, dict(extraction.partition), rows)
    yield from checks.results()


def _figures(row: dict[str, Any]) -> list[float | None]:
    figures = [row[name] for name in ("value", "low", "high")]
    return [None if figure != figure else figure for figure in figures]


@_asset(
    DIRECTIONS,
    EXTRACTION,
    [dg.AssetDep(hidden_states, partition_mapping=by_extraction), probing_settings],
)
def directions(context: dg.AssetExecutionContext) -> Events:
    """The void direction of every dataset at every layer with its random and label-shuffled controls, as values."""
    from traps_pipeline.mechanism.stages import direction_rows

    extraction = Extraction.parse(context.partition_key)
    yield _made(context, DIRECTIONS, dict(extraction.partition), direction_rows(Workspace.open(), extraction))


def _cosines(workspace: Workspace) -> "pd.DataFrame":
    import pandas as pd

    from traps_pipeline.mechanism.stages import cosine_rows

    return pd.DataFrame(cosine_rows(workspace))


cosines = common.table_asset(
    COSINES, GROUP, "Cosines of every two void directions of a model at one layer.", [directions], _cosines
)


@_asset(
    STEERING,
    STEERING_CELL,
    [
        dg.AssetDep(items, partition_mapping=by_dataset),
        dg.AssetDep(directions, partition_mapping=dg.AllPartitionMapping()),
        dg.AssetDep(steering_settings, partition_mapping=by_steering),
    ],
    kinds=["pytorch"],
)
def steering(context: dg.AssetExecutionContext) -> Events:
    """Answers of a model that is steered along every path into a dataset; what the ledger holds is not asked."""
    from traps_pipeline.mechanism.stages import looked_into, saved_directions
    from traps_pipeline.mechanism.steering import collect_steered

    workspace, cell = Workspace.open(), SteeringCell.parse(context.partition_key)
    entry = looked_into(workspace, cell.evaluation.model)
    provenance, inputs = common.provenance(context, workspace), Lineage(workspace).inputs("steering", cell.key)
    along = {cell.directions: saved_directions(workspace, Extraction(entry.id, cell.directions))}
    for done in collect_steered(workspace, entry, [cell], along, {cell.key: inputs}):
        progress.current().partition("steering", cell.key, done.tally)
        metadata: dict[str, Any] = {"dagster/partition_row_count": done.rows, "asked": done.tally.asked}
        yield common.materialized(context, cell.key, done.version, provenance, **metadata)


@_asset(STEERING_VOTES, STEERING_CELL, [dg.AssetDep(items, partition_mapping=by_dataset), steering, judges])
def steering_votes(context: dg.AssetExecutionContext) -> Events:
    """What the study's panel says of each steered answer: whether it abstains."""
    from traps_pipeline.mechanism.steering import collect_steering_votes

    workspace, cell = Workspace.open(), SteeringCell.parse(context.partition_key)
    provenance, inputs = common.provenance(context, workspace), Lineage(workspace).inputs("steering_votes", cell.key)
    for done in collect_steering_votes(workspace, [cell], {cell.key: inputs}):
        progress.current().partition("steering_votes", cell.key, done.tally)
        metadata: dict[str, Any] = {"dagster/partition_row_count": done.rows, "asked": done.tally.asked}
        yield common.materialized(context, cell.key, done.version, provenance, **metadata)


def _effects(workspace: Workspace) -> "pd.DataFrame":
    import pandas as pd

    from traps_pipeline.mechanism.shares import effect_rows

    return pd.DataFrame(effect_rows(*_judged(workspace, STEERING_EFFECTS)))


def _shares(workspace: Workspace) -> "pd.DataFrame":
    import pandas as pd

    from traps_pipeline.mechanism.shares import share_rows

    return pd.DataFrame(share_rows(*_judged(workspace, STEERING_SHARES)))


def _judged(workspace: Workspace, table: Table) -> "tuple[pd.DataFrame, pd.DataFrame]":
    answers, votes = workspace.tables.read_all(STEERING), workspace.tables.read_all(STEERING_VOTES)
    if votes.empty:
        raise TrapsError(f"{table.name}: no votes yet; materialize steering and steering_votes first")
    return answers, votes


steering_effects = common.table_asset(
    STEERING_EFFECTS,
    GROUP,
    "Abstention by path, kind of direction, layer, strength and side.",
    [steering, steering_votes],
    _effects,
)
steering_shares = common.table_asset(
    STEERING_SHARES,
    GROUP,
    "Abstention over the paths of a set, with intervals by scenario.",
    [steering, steering_votes],
    _shares,
)

SOURCES = [extraction_settings, probing_settings, steering_settings]
_STEERED = [steering, steering_votes, steering_effects, steering_shares]
ASSETS = [probe_items, hidden_states, probes, directions, cosines, *_STEERED]
