"""`traps ledger`: where a study's ledger lies, and what is booked in it for calls that never left."""

from __future__ import annotations

import argparse

from traps_pipeline.base.errors import TrapsError
from traps_pipeline.cli.command import OK, Commands, open_workspace


def add(commands: Commands) -> None:
    """Add `traps ledger move` and `traps ledger release`."""
    noun = commands.noun("ledger", "where answers, votes and spending are kept")
    text = "move the study's answers, votes and spending into a PostgreSQL database that several hosts share, or back"
    parser = noun.add("move", move, text)
    where = parser.add_mutually_exclusive_group(required=True)
    where.add_argument("--to", metavar="VARIABLE", help="variable of the environment that holds the database's address")
    where.add_argument("--store", metavar="ADDRESS", help="the whole study into an object store: s3://BUCKET/STUDY")
    where.add_argument("--back", action="store_true", help="into the study's folder again")

    text = "give back money that is booked for calls that never left; without arguments: list what may be released"
    parser = noun.add("release", release, text)
    parser.add_argument("--participant", metavar="NAME", help="the model or judge whose money it is")
    amount = parser.add_mutually_exclusive_group()
    amount.add_argument("--usd", type=float, metavar="X", help="so many dollars")
    amount.add_argument("--all-in-flight", action="store_true", help="all of its calls in flight when a process died")
    parser.add_argument("--why", help="the reason, which is recorded with your name and the time")


def release(arguments: argparse.Namespace) -> int:
    """See `traps ledger release --help`."""
    from traps_pipeline.base.terminal import text_table
    from traps_pipeline.models import release as releasing

    workspace = open_workspace(arguments)
    if arguments.participant is None:
        rooms = releasing.releasable(workspace)
        rows = [(name, f"{room.in_flight:.4f}", f"{room.failed:.4f}") for name, room in rooms.items()]
        print(text_table(("participant", "in flight ($)", "failed ($)"), rows) if rows else "nothing may be released")
        return OK
    if not (arguments.why or "").strip() or (arguments.usd is None and not arguments.all_in_flight):
        raise TrapsError(f"{arguments.participant}: give --usd X or --all-in-flight, and the reason with --why")
    usd = releasing.release(workspace, arguments.participant, arguments.usd, arguments.why.strip())
    print(f"${usd:.4f} of {arguments.participant} are released; the same command of `traps run` goes on")
    return OK


def move(arguments: argparse.Namespace) -> int:
    """See `traps ledger move --help`."""
    from traps_pipeline.base.progress import reporting
    from traps_pipeline.cli.progress import TerminalProgress
    from traps_pipeline.storage.place import place_of
    from traps_pipeline.storage.workspace import VARIABLE
    from traps_pipeline.study.ledger_move import move_back, move_to_database
    from traps_pipeline.study.store_move import move_to_store

    workspace = open_workspace(arguments)
    if arguments.store:
        with reporting(TerminalProgress()):
            moved = move_to_store(workspace, place_of(arguments.store))
    else:
        moved = move_back(workspace) if arguments.back else move_to_database(workspace, arguments.to)
    print(f"{moved.rows} rows moved; the ledger of {workspace.study.name} lies in {moved.where} now")
    if moved.kept:
        print(f"what lay in the folder before is kept in {moved.kept}, where nothing reads it")
    if arguments.store:
        print(f"the study lies at {arguments.store} now; export {VARIABLE}={arguments.store}, here and on other hosts")
    return OK
