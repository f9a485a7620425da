"""Materialize an experiment's missing or stale partitions (`traps run`)."""

from __future__ import annotations

import argparse
import re
import shlex
import shutil
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from traps_pipeline.base.errors import TrapsError
from traps_pipeline.base.terminal import wrap_text
from traps_pipeline.base.wording import count_noun
from traps_pipeline.cli.command import (
    FAILED,
    OK,
    OVER_BUDGET,
    Commands,
    add_experiment,
    add_panel,
    experiment_of,
    integer,
    load_definitions,
    number,
    place_of,
    print_failure,
    print_json,
)
from traps_pipeline.cli.init_commands import create

if TYPE_CHECKING:
    from dagster import DagsterInstance

    from traps_pipeline.pipeline.experiment import Experiment
    from traps_pipeline.pipeline.run_plan import RunReport
    from traps_pipeline.pipeline.runs import Runs
    from traps_pipeline.storage.workspace import Workspace

MONEY = ("budget_usd", "model_budgets_usd", "allow_unknown_prices")  # fields of an experiment and of a study


def add(commands: Commands) -> None:
    """Add `traps run` to the parser."""
    text = "make every missing or stale partition of an experiment, and print the leaderboard"
    parser = commands.add("study run", run, text, example="demo --until leaderboard", is_paid=True, json=True)
    add_experiment(parser)
    add_panel(parser)
    parser.add_argument(
        "--budget-usd", action="append", default=[], metavar="[MODEL=]USD",
        help="maximum dollars for calls over the network, in this study or to one model or judge; kept in study.yaml",
    )  # fmt: skip
    parser.add_argument(
        "--allow-unknown-prices",
        action="store_true",
        default=None,
        help="ask models that have no price in the registry",
    )
    parser.add_argument(
        "--no-preflight", action="store_true", help="ask at once, without first trying every model and judge"
    )
    parser.add_argument(
        "--unchecked",
        action="store_true",
        help="go on with what did not answer in time to be checked (default: ask on a terminal, else stop)",
    )
    parser.add_argument(
        "--until", metavar="STAGES", help="make only these stages (separated by commas) and the stages they need"
    )
    parser.add_argument(
        "--progress",
        choices=("auto", "plain", "json"),
        default="auto",
        help="on standard error: a live region on a terminal and lines elsewhere (auto), lines, or lines of JSON",
    )
    parser.add_argument("--cluster", action="store_true", help="run on the hosts of a Ray cluster (docs/cluster.md)")
    parser.add_argument(
        "--on-interrupt",
        choices=("leave", "cancel"),
        default="leave",
        help="what Ctrl-C does to the runs of --cluster (default: they go on)",
    )
    parser.add_argument(
        "--runs",
        type=integer(1, 500),
        default=40,
        help="number of runs per group of stages with --cluster (default: 40)",
    )
    parser.add_argument(
        "--gpus", type=number(0, 1000), default=0.0, help="with --cluster: GPUs per run that loads a local model"
    )
    parser.add_argument(
        "--cpus",
        type=integer(1, 1000),
        default=1,
        help="with --cluster: cores per run that renders clips or fits probes (default: 1)",
    )


def run(arguments: argparse.Namespace) -> int:
    from traps_pipeline.base.progress import use_progress
    from traps_pipeline.cli.printed_progress import make_progress

    experiment = experiment_of(arguments)
    if arguments.cluster:
        from traps_pipeline.storage.several_hosts import several_hosts

        several_hosts()  # refuses before a workspace is made
    place = place_of(arguments)
    is_new = isinstance(place, Path) and not place.exists()
    workspace = create(arguments, experiment, money=_money(experiment, arguments))
    if arguments.until is not None:
        _require_stages(arguments.until, workspace, is_new=is_new)
    stream = sys.stderr if arguments.json else sys.stdout
    title = f"{experiment.name}: {experiment.description}" if experiment.description else experiment.name
    print(f"{wrap_text(title, stream)}\nworkspace {workspace.place}", file=stream, flush=True)
    with use_progress(make_progress(arguments.progress)) as progress:
        load_definitions()  # takes seconds, as Dagster's import does
        from traps_pipeline.pipeline.experiment_run import run_experiment

        report = run_experiment(
            workspace,
            experiment,
            until=arguments.until,
            preflight=None if arguments.no_preflight else progress.tell,
            goes_on=partial(_goes_on, arguments),
            look_at_machine=not arguments.cluster,  # on a cluster, each host checks itself
            open_runs=partial(_open_runs, arguments),
        )
    if not arguments.json:
        _print_work(report, is_inside=experiment.mechanism is not None)
    if experiment.canary and not report.problems:
        from traps_pipeline.checks.canary import ask_canary, changes_text

        with use_progress(make_progress(arguments.progress)):
            changes = ask_canary(workspace, experiment.models)
        print(changes_text(changes), file=stream)
    if arguments.json:
        from traps_pipeline.scoring.score_rows import LEADERBOARD

        board = workspace.tables.read_all(LEADERBOARD)
        print_json({"workspace": str(workspace.place), "run": report, "leaderboard": board})
    if not arguments.json and arguments.until is None and report.has_board:
        from traps_pipeline.report.printed_board import stored_leaderboard_text

        print(stored_leaderboard_text(workspace))
        print(f"report {workspace.reports / 'report.html'}\nexplorer {workspace.reports / 'index.html'}")
        advice = "open one of them; traps why ITEM examines an item's answers; traps site writes a folder to send"
        print(wrap_text(f"next: {advice}"))
    if report.problems:
        _print_problems(report, as_json=arguments.progress == "json")
        return OVER_BUDGET if report.over_budget else FAILED
    if not arguments.json and arguments.until is not None:
        workspace_option = [] if arguments.workspace is None else ["--workspace", arguments.workspace]
        command = shlex.join(["traps", "run", arguments.experiment, *workspace_option])
        print(wrap_text(f"next: `{command}` for the stages after {arguments.until}"))
    return OK


def _require_stages(until: str, workspace: Workspace, *, is_new: bool) -> None:
    """Raise TrapsError for stages that the study does not declare; remove a workspace that was just made."""
    load_definitions()
    from traps_pipeline.pipeline.run_plan import stages_until

    try:
        stages_until(until)
    except TrapsError:
        if is_new:
            shutil.rmtree(workspace.root)
        raise


def _goes_on(arguments: argparse.Namespace, unchecked: str) -> bool:
    """Return whether to go on without knowing what a sentence says was not checked."""
    if arguments.unchecked or not (sys.stdin.isatty() and sys.stderr.isatty()):
        return arguments.unchecked
    print(f"{unchecked}\ngo on all the same? [y/N] ", end="", file=sys.stderr, flush=True)
    return sys.stdin.readline().strip().lower() in ("y", "yes")


def _print_work(report: RunReport, *, is_inside: bool) -> None:
    from traps_pipeline.base.progress import as_clock

    responses, vote_tally = report.tally("responses"), report.tally("votes")
    print(f"\n{count_noun(responses.asked, 'answer')} asked ({responses.cached} from the ledger)")
    print(f"{count_noun(vote_tally.asked, 'vote')} asked ({vote_tally.cached} from the ledger)")
    print(f"{count_noun(report.frames, 'frame')} rendered, {as_clock(report.seconds)} min")
    if is_inside:
        states, steering_tally, judged = map(report.tally, ("hidden_states", "steering", "steering_votes"))
        steered = (
            f"{count_noun(steering_tally.asked, 'steered answer')} asked ({steering_tally.cached} from the ledger)"
        )
        votes = f"{count_noun(judged.asked, 'vote')} on them"
        print(f"inside models: {count_noun(states.asked, 'item')} extracted, {steered}, {votes}")


def _print_problems(report: RunReport, *, as_json: bool) -> None:
    """Print each cause once, last the one behind most problems, to fix first."""
    print_line = partial(print_failure, as_json=as_json)
    problems_by_cause = dict[str, list[str]]()
    for problem in report.problems:
        problems_by_cause.setdefault(problem.partition(": ")[2] or problem, []).append(problem)
    for first, *repeats in problems_by_cause.values():
        print_line(f"{first}{f' (and {len(repeats)} more)' if repeats else ''}")
    advice = "every table is made" if report.is_made else "finished work is kept: run the same command to continue"
    print_line(f"{count_noun(len(report.problems), 'problem')}; {advice}")
    cause, cause_problems = max(problems_by_cause.items(), key=lambda pair: len(pair[1]))
    if len(cause_problems) > 1:
        print_line(f"{len(cause_problems)} of them have one cause: {cause}")


@contextmanager
def _open_runs(arguments: argparse.Namespace, instance: DagsterInstance, workspace: Workspace) -> Iterator[Runs]:
    """Open the executor of runs, here or on a cluster. Raises TrapsError without one."""
    from traps_pipeline.definitions import defs
    from traps_pipeline.pipeline.runs import LocalRuns

    if not arguments.cluster:
        yield LocalRuns(instance, defs.resolve_implicit_global_asset_job_def())
        return
    from traps_pipeline.storage.several_hosts import several_hosts

    yield several_hosts().runs(workspace, instance, arguments)


def _money(experiment: Experiment, arguments: argparse.Namespace) -> dict[str, Any]:
    """Return the budgets of the command, else of the experiment. Raises TrapsError."""
    fields = {name: getattr(experiment, name) for name in MONEY}
    money: dict[str, Any] = {name: value for name, value in fields.items() if value is not None}
    if arguments.allow_unknown_prices:
        money["allow_unknown_prices"] = True
    for text in arguments.budget_usd:
        name, _, amount = text.rpartition("=")
        dollars = float(amount) if re.fullmatch(r"[0-9]{1,9}(\.[0-9]{1,9})?", amount) else -1.0
        if dollars < 0:
            raise TrapsError(
                f"--budget-usd {text}: give dollars (20 or 20.50), or MODEL=dollars for one model or judge"
            )
        if name:
            money["model_budgets_usd"] = money.get("model_budgets_usd", {}) | {name: dollars}
        else:
            money["budget_usd"] = dollars
    return money
