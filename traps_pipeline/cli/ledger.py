"""`traps ledger`: where a study's ledger lies."""

from __future__ import annotations

import argparse

from traps_pipeline.cli.command import OK, Commands, open_workspace


def add(commands: Commands) -> None:
    """Add `traps ledger move`."""
    text = "move the study's answers, votes and spending into a PostgreSQL database that several hosts share, or back"
    parser = commands.noun("ledger", "where answers, votes and spending are kept").add("move", move, text)
    where = parser.add_mutually_exclusive_group(required=True)
    where.add_argument("--to", metavar="VARIABLE", help="variable of the environment that holds the database's address")
    where.add_argument("--store", metavar="ADDRESS", help="the whole study into an object store: s3://BUCKET/STUDY")
    where.add_argument("--back", action="store_true", help="into the study's folder again")


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
