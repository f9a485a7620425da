"""Export or import a study's ledger, move a study, or release money."""

import argparse
from pathlib import Path

from traps_pipeline.base.errors import TrapsError
from traps_pipeline.base.wording import count_noun
from traps_pipeline.cli.command import OK, Commands, open_workspace, print_json


def add(commands: Commands) -> None:
    """Add the commands that export, import and move a ledger to the parser."""
    text = "write answers, votes and money to one file, as they are"
    parser = commands.add("study export-ledger", export, text, example="ledger.sqlite")
    parser.add_argument("file", type=Path, metavar="FILE", help="the file to write")
    text = "read an exported ledger into a study without answers: in its folder, or in the database of study.yaml"
    parser = commands.add("study import-ledger", import_, text, example="ledger.sqlite")
    parser.add_argument("file", type=Path, metavar="FILE", help="a file of `traps study export-ledger`")
    text = "move the whole study into an object store that several hosts share"
    parser = commands.add("study move", move, text, example="--store s3://bucket/study")
    parser.add_argument("--store", metavar="ADDRESS", required=True, help="s3://BUCKET/STUDY")

    text = "release money reserved for calls that were never sent; without arguments: list what may be released"
    example = "--participant qwen --usd 1.50 --why killed"
    parser = commands.add("study release-money", release, text, example=example, json=True)
    parser.add_argument("--participant", metavar="NAME", help="the model or judge that holds the reservation")
    amount = parser.add_mutually_exclusive_group()
    amount.add_argument("--usd", type=float, metavar="X", help="amount in dollars")
    amount.add_argument("--all-in-flight", action="store_true", help="all of its calls in flight when a process died")
    parser.add_argument("--why", help="the reason, which is recorded with your name and the time")


def release(arguments: argparse.Namespace) -> int:
    from traps_pipeline.base.terminal import text_table
    from traps_pipeline.models.money.spending import releasable, release_money

    workspace = open_workspace(arguments)
    if arguments.participant is None:
        rooms = releasable(workspace)
        if arguments.json:
            print_json(rooms)
            return OK
        rows = [(name, f"{room.in_flight:.4f}", f"{room.failed:.4f}") for name, room in rooms.items()]
        print(text_table(("participant", "in flight ($)", "failed ($)"), rows) if rows else "nothing may be released")
        return OK
    if not (arguments.why or "").strip() or (arguments.usd is None and not arguments.all_in_flight):
        raise TrapsError(f"{arguments.participant}: give --usd X or --all-in-flight, and the reason with --why")
    usd = release_money(workspace, arguments.participant, arguments.usd, arguments.why.strip())
    print(f"${usd:.4f} of {arguments.participant} are released; the same command of `traps run` goes on")
    return OK


def export(arguments: argparse.Namespace) -> int:
    """Write the study's ledger rows to a file, and print their number."""
    from traps_pipeline.ledger.row_transfer import export_ledger

    count = export_ledger(open_workspace(arguments).ledger, arguments.file.absolute(), print)
    print(
        f"wrote {count_noun(count, 'row')} to {arguments.file}; `traps study import-ledger` reads it into another study"
    )
    return OK


def import_(arguments: argparse.Namespace) -> int:
    """Read ledger rows from a file into the study's ledger, and print their number."""
    from traps_pipeline.ledger.row_transfer import import_ledger

    workspace = open_workspace(arguments)
    count = import_ledger(arguments.file.absolute(), workspace.ledger, print)
    print(f"read {count_noun(count, 'row')} into {workspace.ledger.place}")
    return OK


def move(arguments: argparse.Namespace) -> int:
    from traps_pipeline.base.progress import use_progress
    from traps_pipeline.cli.printed_progress import make_progress
    from traps_pipeline.storage.place import parse_place
    from traps_pipeline.storage.several_hosts import several_hosts
    from traps_pipeline.storage.workspace import VARIABLE

    workspace = open_workspace(arguments)
    with use_progress(make_progress()):
        count = several_hosts().move(workspace, parse_place(arguments.store))
    print(f"moved {count_noun(count, 'row')} to {arguments.store}; next: export {VARIABLE}={arguments.store}")
    return OK
