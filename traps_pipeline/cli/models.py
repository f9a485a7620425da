"""`traps models check`: whether the registry's entries send what they declare."""

from __future__ import annotations

import argparse

from traps_pipeline.cli.command import FAILED, OK, Commands


def add(commands: Commands) -> None:
    """Add `traps models check`."""
    text = "compare what models and judges are sent with their entries; needs no key, and nothing leaves this machine"
    parser = commands.noun("models", "check entries of the registry").add("check", check, text, workspace=False)
    parser.add_argument("names", nargs="*", metavar="MODEL", help="check only these models and judges")


def check(arguments: argparse.Namespace) -> int:
    """See `traps models check --help`."""
    from traps_pipeline.study.wire_check import check_named

    wrong = 0
    for checked in check_named(arguments.names):
        print("\n    ".join([checked.line, *checked.problems]), flush=True)
        wrong += bool(checked.problems)
    print("every entry sends what it declares" if not wrong else f"{wrong} entries do not send what they declare")
    return FAILED if wrong else OK
