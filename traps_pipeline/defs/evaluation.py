"""The evaluation group: answers of models, votes of judges, verdicts of the panel. A cell is dataset x evaluation."""

from collections.abc import Callable, Iterator, Mapping, Sequence

import dagster as dg

from traps_pipeline import progress
from traps_pipeline.defs import common
from traps_pipeline.defs.benchmark import items
from traps_pipeline.defs.common import (
    CELL,
    OWNERS,
    SINGLE_RUN,
    Checks,
    Events,
    by_dataset,
    by_evaluation,
    check,
    table_metadata,
)
from traps_pipeline.lineage import Lineage
from traps_pipeline.models.answers import FinishedCell, collect_answers
from traps_pipeline.partitions import Cell
from traps_pipeline.progress import Tally
from traps_pipeline.storage.workspace import Workspace
from traps_pipeline.tables import RESPONSES, VERDICTS, VOTES

GROUP = "evaluation"
MAX_INVALID_SHARE = 0.05
models = common.source_asset(
    "models", GROUP, "assets/models.yaml: what decides a model's answers, by evaluation.", ["yaml"]
)
prompts = common.source_asset("prompts", GROUP, "assets/prompts: the regime's system prompt, by evaluation.", ["text"])
judges = common.source_asset(
    "judges", GROUP, "assets/judges.yaml and the judges' prompts: the study's panel.", ["yaml"]
)

Collect = Callable[[Workspace, Sequence[Cell], Mapping[str, Mapping[str, str]]], Iterator[FinishedCell]]


def _collect(
    context: dg.AssetExecutionContext, stage: str, collect: Collect
) -> Iterator[tuple[FinishedCell, dg.AssetMaterialization]]:
    """Run a paid stage over this run's cells; each is materialized as it is finished."""
    workspace = Workspace.open()
    cells = [Cell.parse(key) for key in common.keys(context)]
    lineage, provenance = Lineage(workspace), common.provenance(context, workspace)
    inputs = {cell.key: lineage.inputs(stage, cell.key) for cell in cells}
    for done in collect(workspace, cells, inputs):
        progress.current().partition(stage, done.cell.key, done.tally)
        metadata = {
            "dagster/partition_row_count": done.rows,
            "asked": done.tally.asked,
            "from the ledger": done.tally.cached,
            "failed": done.tally.errors,
        }
        yield done, common.materialized(context, done.cell.key, done.version, provenance, **metadata)


@dg.asset(
    partitions_def=CELL,
    deps=[
        dg.AssetDep(items, partition_mapping=by_dataset),
        dg.AssetDep(models, partition_mapping=by_evaluation),
        dg.AssetDep(prompts, partition_mapping=by_evaluation),
    ],
    backfill_policy=SINGLE_RUN,
    group_name=GROUP,
    kinds={"parquet"},
    owners=OWNERS,
    metadata=table_metadata("responses"),
    output_required=False,
    check_specs=[check("one_answer_an_item", "responses", "Every item of the cell has exactly one row.")],
)
def responses(context: dg.AssetExecutionContext) -> Events:
    """Answers of a model under a regime in a run, one row an item; only what the ledger does not hold is asked."""
    workspace = Workspace.open()
    checks = Checks(context, workspace)
    for done, event in _collect(context, "responses", collect_answers):
        state = Lineage(workspace).state("items", done.cell.dataset)
        n_items = state.rows if state else 0
        wrong = "" if done.rows == n_items else f"{done.rows} rows for {n_items} items"
        checks.record("one_answer_an_item", done.cell.key, wrong)
        yield event
    yield from checks.results()


@dg.asset(
    partitions_def=CELL,
    deps=[dg.AssetDep(items, partition_mapping=by_dataset), responses, judges],
    backfill_policy=SINGLE_RUN,
    group_name=GROUP,
    kinds={"parquet"},
    owners=OWNERS,
    metadata=table_metadata("votes"),
    output_required=False,
    check_specs=[
        check(
            "few_invalid_votes", "votes", f"At most {MAX_INVALID_SHARE:.0%} of a cell's votes break the judges' schema."
        )
    ],
)
def votes(context: dg.AssetExecutionContext) -> Events:
    """Votes of the study's panel on the answers of a cell, one row a judge and task."""
    from traps_pipeline.judging.panel import collect_votes

    workspace = Workspace.open()
    checks = Checks(context, workspace)
    for done, event in _collect(context, "votes", collect_votes):
        valid = workspace.tables.read(VOTES, done.cell.partition, ["valid"])["valid"].to_numpy(bool)
        invalid = len(valid) - int(valid.sum())
        many = f"{invalid} of {len(valid)} votes are invalid" if invalid > MAX_INVALID_SHARE * len(valid) else ""
        checks.record("few_invalid_votes", done.cell.key, many)
        yield event
    yield from checks.results()


@dg.asset(
    partitions_def=CELL,
    deps=[dg.AssetDep(items, partition_mapping=by_dataset), responses, votes],
    backfill_policy=SINGLE_RUN,
    group_name=GROUP,
    kinds={"parquet"},
    owners=OWNERS,
    metadata=table_metadata("verdicts"),
    output_required=False,
    check_specs=[check("one_verdict_an_item", "verdicts", "Every answered item has exactly one verdict.")],
)
def verdicts(context: dg.AssetExecutionContext) -> Events:
    """What the panel's majority says of each item of a cell."""
    from traps_pipeline.judging.verdicts import decide_cell

    workspace = Workspace.open()
    lineage, provenance, checks = Lineage(workspace), common.provenance(context, workspace), Checks(context, workspace)
    for key in common.keys(context):
        cell = Cell.parse(key)
        rows = decide_cell(workspace, cell)
        answered = workspace.tables.state(RESPONSES, cell.partition)
        n_answers = answered.rows if answered else 0
        wrong = "" if n_answers == len(rows) else f"{len(rows)} verdicts for {n_answers} answers"
        checks.record("one_verdict_an_item", key, wrong)
        version = workspace.tables.write(VERDICTS, cell.partition, rows, lineage.inputs("verdicts", key))
        progress.current().partition("verdicts", key, Tally())
        undecided = int(rows["undecided"].to_numpy(bool).sum())
        metadata = {"dagster/partition_row_count": len(rows), "undecided": undecided}
        yield common.materialized(context, key, version, provenance, **metadata)
    yield from checks.results()
