"""Create the workspace of an experiment (`traps init`)."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from traps_pipeline.base.errors import TrapsError
from traps_pipeline.cli.command import OK, Commands, add_experiment, add_panel, enter_workspace, experiment_of, place_of

if TYPE_CHECKING:
    from traps_pipeline.pipeline.experiment import Experiment
    from traps_pipeline.storage.workspace import Workspace


def add(commands: Commands) -> None:
    """Add `traps init` to the parser."""
    text = "make a workspace for an experiment without running it"
    parser = commands.add("study init", init, text, example="demo --workspace .workspaces/demo")
    add_experiment(parser, nargs="?", default="demo")
    add_panel(parser)
    parser.add_argument(
        "--database",
        metavar="VARIABLE",
        help="keep the ledger of a new study in PostgreSQL, for several hosts that share its folder (docs/cluster.md); "
        "the variable of the environment holds the address",
    )


def init(arguments: argparse.Namespace) -> int:
    workspace = create(arguments, experiment_of(arguments), arguments.database)
    print(f"workspace {workspace.place} (study.yaml names its benchmark, panel and budget)")
    print(f"next: export TRAPS_WORKSPACE={workspace.place} DAGSTER_HOME={workspace.dagster_home}")
    return OK


def create(
    arguments: argparse.Namespace,
    experiment: Experiment,
    database: str | None = None,
    money: Mapping[str, Any] | None = None,
) -> Workspace:
    """Return the workspace with the experiment in its study, created if missing.

    database: the environment variable with the address of the study's database, if one is requested. money: fields of
    the study to change, such as budgets. Raises TrapsError, before anything is written, for a budget of nobody; and if
    the existing study differs from the one that the experiment needs, or keeps its ledger elsewhere.
    """
    from traps_pipeline.benchmark.corrections import load_scenarios
    from traps_pipeline.models.registry.entries import get_model
    from traps_pipeline.models.registry.judges import load_judges
    from traps_pipeline.models.registry.user_registry import save_entries
    from traps_pipeline.storage.workspace import Workspace

    place, is_judged_by_rules, money = place_of(arguments), arguments.judged_by_rules, dict(money or {})
    if Workspace.is_there(place):
        caps = enter_workspace(Workspace.open(place)).study.model_budgets_usd  # and its own models are known now
    else:  # refuse before a folder is created
        experiment.judged(None, arguments.panel, judged_by_rules=is_judged_by_rules)
        load_scenarios(experiment.study)
        caps = {}
    if "model_budgets_usd" in money:
        money["model_budgets_usd"] = (experiment.model_budgets_usd or caps) | money["model_budgets_usd"]
    for name in {**(experiment.model_budgets_usd or {}), **money.get("model_budgets_usd", {})}:
        if name not in load_judges():
            get_model(name)  # refuses a name that is none
    workspace = Workspace.create(place, experiment.study.model_copy(update={"database": database}))
    if database is not None and workspace.study.database != database:
        raise TrapsError(
            f"{place}/study.yaml: its ledger lies in {workspace.study.database or 'its folder'}; make a new "
            f"one with --database {database} in another place, and bring the answers along (docs/cluster.md)"
        )
    judged = experiment.judged(workspace.study, arguments.panel, judged_by_rules=is_judged_by_rules)
    experiment.check_study(judged, workspace.root / "study.yaml")
    if judged != workspace.study:
        if experiment.panel is None and judged.panel != workspace.study.panel:
            print(f"note: judged by the panel {judged.panel!r}; write `panel: {judged.panel}` into the experiment")
        workspace = workspace.allow(panel=judged.panel, judged_by_rules=judged.judged_by_rules)
    if experiment.mechanism is not None and workspace.study.mechanism is None:
        workspace = workspace.allow(mechanism=experiment.mechanism)
    experiments = workspace.study.experiments | {experiment.name: experiment.asked}
    if experiments != workspace.study.experiments or money:
        workspace = workspace.allow(experiments=experiments, **money)
    enter_workspace(workspace)
    save_entries(workspace)
    if not (workspace.dagster_home / "dagster.yaml").exists():
        from traps_pipeline.pipeline.run import dagster_history

        with dagster_history(workspace):  # open it once here, so that several processes can use it afterwards
            pass
    return workspace
