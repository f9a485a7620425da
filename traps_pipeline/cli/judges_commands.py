"""`traps models test-panel`: whether an answer can instruct a panel how to vote."""

from __future__ import annotations

import argparse

from traps_pipeline.cli.command import OK, Commands, open_workspace, print_json


def add(commands: Commands) -> None:
    """Add `traps models test-panel`."""
    text = "give a panel answers that try to instruct their judge; makes calls to judges"
    parser = commands.add("models test-panel", check, text, example="rules", json=True)
    parser.add_argument("panel", nargs="?", help="a panel of assets/judges.yaml (default: the study's)")


def check(arguments: argparse.Namespace) -> int:
    """See `traps models test-panel --help`."""
    from traps_pipeline.judging.robustness import check_panel, load_attacks, summary
    from traps_pipeline.models.judges import load_panel

    workspace = open_workspace(arguments)
    name = arguments.panel or workspace.study.panel
    rows = check_panel(workspace, name, load_panel(name), load_attacks())
    if arguments.json:
        print_json(rows)
        return OK
    print(f"panel {name}: votes on {rows['attack'].nunique()} answers that try to instruct the judge")
    print(summary(rows))
    print("flipped: right on the plain answer, wrong under the attack; broken: no valid vote under it")
    return OK
