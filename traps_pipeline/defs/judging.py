"""The judging group: how far the panel agrees, which way its judges lean, and what is wrong with void failures."""

from typing import TYPE_CHECKING

import dagster as dg

from traps_pipeline import progress
from traps_pipeline.defs import common
from traps_pipeline.defs.benchmark import items
from traps_pipeline.defs.common import OWNERS, Checks, Events, check, table_asset, table_metadata
from traps_pipeline.defs.evaluation import judges, responses, verdicts, votes
from traps_pipeline.defs.scoring import leaderboard
from traps_pipeline.errors import TrapsError
from traps_pipeline.judging.confabulation import load_protocol
from traps_pipeline.lineage import Lineage
from traps_pipeline.storage.workspace import Workspace
from traps_pipeline.tables import (
    AGREEMENT,
    CONFABULATION,
    CONFABULATION_PREVALENCE,
    JUDGE_BIAS,
    LEADERBOARD,
    LEAVE_ONE_OUT,
    VERDICTS,
    VOTES,
)

if TYPE_CHECKING:
    import pandas as pd

GROUP = "judging"
MAX_INVALID_SHARE = 0.05
confabulation_protocol = common.source_asset(
    "confabulation_protocol",
    GROUP,
    "assets/confabulation.yaml and its prompt: whose failures are sampled and who labels them.",
    ["yaml"],
)
judge_validation = common.source_asset(
    "judge_validation",
    GROUP,
    "The judge against two annotators: the table that `traps confabulation validate` writes.",
    ["parquet"],
)
_SAMPLED = dg.SpecificPartitionsPartitionMapping(
    [cell.key for model in load_protocol().models for cell in load_protocol().cells(model)]
)


def _panel(workspace: Workspace) -> list[str]:
    from traps_pipeline.judging.panel import load_panel

    return [judge.id for judge in load_panel(workspace.study.panel)]


def _votes(workspace: Workspace, stage: str) -> "pd.DataFrame":
    """The votes of the study's panel. Raises TrapsError if there is none."""
    from traps_pipeline.judging.ratings import VOTE_COLUMNS
    from traps_pipeline.judging.verdicts import current

    votes = current(workspace, VOTES, VOTE_COLUMNS)
    votes = votes.loc[votes["judge"].isin(_panel(workspace))]
    if votes.empty:
        raise TrapsError(f"{stage}: no votes yet; materialize votes for a cell first")
    return votes


def _agreement(workspace: Workspace) -> "pd.DataFrame":
    from traps_pipeline.judging.agreement import agreement

    return agreement(_votes(workspace, "agreement"), _panel(workspace))


def _judge_bias(workspace: Workspace) -> "pd.DataFrame":
    from traps_pipeline.judging.agreement import judge_bias

    return judge_bias(_votes(workspace, "judge_bias"), _panel(workspace))


def _leave_one_out(workspace: Workspace) -> "pd.DataFrame":
    from traps_pipeline.judging.verdicts import current
    from traps_pipeline.scoring.leave_one_out import leave_one_out

    votes, board = _votes(workspace, "leave_one_out"), workspace.tables.read(LEADERBOARD, {})
    return leave_one_out(current(workspace, VERDICTS), votes, board, _panel(workspace))


def _prevalence(workspace: Workspace) -> "pd.DataFrame":
    from traps_pipeline.scoring.prevalence import prevalence

    return prevalence(workspace.tables.read(CONFABULATION, {}))


agreement = table_asset(
    AGREEMENT,
    GROUP,
    "Agreement of the panel and of each two judges per dataset and task: unanimous share, Fleiss, Cohen, Krippendorff.",
    [items, votes, judges],
    _agreement,
)
judge_bias = table_asset(
    JUDGE_BIAS,
    GROUP,
    "Each judge's rate of yes against the panel's majority, per dataset and task.",
    [items, votes, judges],
    _judge_bias,
)
leave_one_out = table_asset(
    LEAVE_ONE_OUT,
    GROUP,
    "PECS as the other two judges decide it, for each judge left out.",
    [items, votes, verdicts, leaderboard, judges],
    _leave_one_out,
)


@dg.asset(
    deps=[
        items,
        dg.AssetDep(responses, partition_mapping=_SAMPLED),
        dg.AssetDep(verdicts, partition_mapping=_SAMPLED),
        confabulation_protocol,
    ],
    group_name=GROUP,
    kinds={"parquet"},
    owners=OWNERS,
    metadata=table_metadata("confabulation"),
    output_required=False,
    check_specs=[
        check("few_invalid_labels", "confabulation", f"At most {MAX_INVALID_SHARE:.0%} of the labels break the schema.")
    ],
)
def confabulation(context: dg.AssetExecutionContext) -> Events:
    """Void failures of the sampled models, labelled on four axes by one judge; empty where the study has none."""
    from traps_pipeline.judging.confabulation import collect_labels

    workspace = Workspace.open()
    lineage, provenance, checks = Lineage(workspace), common.provenance(context, workspace), Checks(context, workspace)
    inputs = lineage.inputs("confabulation", None)
    done = collect_labels(workspace)
    invalid = sum(not row["valid"] for row in done.rows)
    many = f"{invalid} of {len(done.rows)} labels are invalid" if invalid > MAX_INVALID_SHARE * len(done.rows) else ""
    checks.record("few_invalid_labels", None, many)
    version = workspace.tables.write(CONFABULATION, {}, done.rows, inputs, failed=done.tally.errors)
    progress.current().partition("confabulation", "", done.tally)
    metadata = {"dagster/row_count": len(done.rows), "asked": done.tally.asked, "from the ledger": done.tally.cached}
    yield common.materialized(context, None, version, provenance, **metadata)
    yield from checks.results()


confabulation_prevalence = table_asset(
    CONFABULATION_PREVALENCE,
    GROUP,
    "How often each axis applies to each model's sampled void failures; empty where nothing was labelled.",
    [confabulation],
    _prevalence,
)
ASSETS = [agreement, judge_bias, leave_one_out, confabulation, confabulation_prevalence]
