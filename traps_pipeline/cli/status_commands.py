"""Show the state of a study and of an item (`traps status`, `traps why`)."""

from __future__ import annotations

import argparse
import os
import shlex
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from traps_pipeline.base.errors import TrapsError
from traps_pipeline.base.suggestions import did_you_mean
from traps_pipeline.base.terminal import plain, text_table, wrap_text
from traps_pipeline.base.wording import count_noun
from traps_pipeline.cli.command import (
    OK,
    Commands,
    add_experiment,
    experiment_of,
    ledger_faults,
    load_definitions,
    open_workspace,
    print_json,
)

if TYPE_CHECKING:
    from traps_pipeline.storage.workspace import Workspace

MAX_KEYS, MAX_REASON = 4, 300  # partitions and characters printed per reason


def add(commands: Commands) -> None:
    """Add `traps status` and `traps why`."""
    text = "say what is not fresh, why, and which command makes it again"
    parser = commands.add("study status", status, text, example="demo", json=True)
    add_experiment(parser, nargs="?", help="show only this experiment's part (default: the whole study)")
    text = "show an item, its answers and votes, and say which answers are valid and which will be asked again"
    parser = commands.add("study why", why, text, example="occlusion:domino_chain-0001:void", json=True)
    parser.add_argument("item", help="dataset:scenario:side")


def status(arguments: argparse.Namespace) -> int:
    environment = dict(os.environ)
    workspace = open_workspace(arguments)
    experiment = arguments.experiment
    if experiment is not None and experiment not in workspace.study.experiments:  # a file, or a misspelt name
        experiment = experiment_of(arguments).name
    if experiment is not None and experiment not in workspace.study.experiments:
        raise TrapsError(
            f"{workspace.root}/study.yaml: has no experiment {experiment!r}; traps init {experiment} adds it"
            + did_you_mean(experiment, workspace.study.experiments)
        )
    from traps_pipeline.pipeline.run_plan import RunPlan, failing_checks

    load_definitions()
    rows = [*RunPlan(workspace, experiment).statuses()]
    checks, faults = [*failing_checks(workspace)], ledger_faults(workspace)
    command = _command(workspace, arguments, environment)
    if arguments.json:
        names = ("check", "stage", "partition", "reason")
        failing = [dict(zip(names, check, strict=True)) for check in checks]
        head = {"workspace": str(workspace.place), "command": command, "ledger": faults}
        print_json(head | {"checks": failing, "stages": rows})
        return OK
    print(f"workspace {workspace.place}")
    for fault in faults:
        print(wrap_text(plain(fault)))
    for check, stage, partition, reason in checks:
        print(wrap_text(plain(f"check {check} of {stage} {partition} does not pass: {reason}")))
    total, rows_to_make = sum(row.fresh for row in rows), [row for row in rows if row.to_make]
    if not rows_to_make:
        print(f"everything is fresh: {count_noun(total, 'partition')} of {count_noun(len(rows), 'stage')}")
        return OK
    table = [(row.stage, row.fresh, len(row.stale), len(row.missing)) for row in rows_to_make]
    lines = text_table(("stage", "fresh", "stale", "missing"), table).splitlines()
    print("\n".join(lines[: -len(rows_to_make)]))
    for line, row in zip(lines[-len(rows_to_make) :], rows_to_make, strict=True):
        print(line)
        for reason, keys in row.by_reason().items():
            suffix = f" and {len(keys) - MAX_KEYS} more" if len(keys) > MAX_KEYS else ""
            prefix = "" if keys == [row.stage] else f"{', '.join(keys[:MAX_KEYS])}{suffix}: "
            print(wrap_text(plain(f"    {prefix}{reason[:MAX_REASON]}")))
    count = sum(row.to_make for row in rows_to_make)
    print(f"not fresh: {count:,} of {count_noun(total + count, 'partition')}; `{command}` makes them again")
    return OK


def _command(workspace: Workspace, arguments: argparse.Namespace, exported: Mapping[str, str]) -> str:
    """Return a command that refreshes stale partitions, in the shell with these variables.

    It runs the given experiment, or each of the study's; for one whose file is neither in the current folder nor
    among those of the package, it is the job of the whole study, which needs no file.
    """
    from traps_pipeline.storage.workspace import VARIABLE

    experiments = [arguments.experiment] if arguments.experiment else [*workspace.study.experiments]
    files = [*filter(None, map(_file_of, experiments))]
    if files and len(files) == len(experiments):
        workspace_option = [] if arguments.workspace is None else ["--workspace", str(workspace.place)]
        return " && ".join(shlex.join(["traps", "run", file, *workspace_option]) for file in files)
    required_variables = {VARIABLE: str(workspace.place), "DAGSTER_HOME": os.environ["DAGSTER_HOME"]}
    assignments = [
        f"{name}={shlex.quote(value)}" for name, value in required_variables.items() if exported.get(name) != value
    ]
    return " ".join([*assignments, "dagster job execute -m traps_pipeline.definitions -j everything"])


def _file_of(experiment: str) -> str:
    """Return what `traps run` takes for an experiment, by its name or path; empty if its file is not known."""
    from traps_pipeline.pipeline.experiment import EXPERIMENTS

    if experiment.endswith((".yaml", ".yml")) or (EXPERIMENTS / f"{experiment}.yaml").exists():
        return experiment
    return f"{experiment}.yaml" if Path(f"{experiment}.yaml").is_file() else ""


def why(arguments: argparse.Namespace) -> int:
    from traps_pipeline.pipeline.item_answers import explain_item, lines_of

    explanation = explain_item(open_workspace(arguments), arguments.item)
    if arguments.json:
        print_json(explanation)
        return OK
    for line in lines_of(explanation):
        print(wrap_text(plain(line)))
    return OK
