"""`traps ledger`: what is booked for calls that never left."""

from __future__ import annotations

import argparse

from traps_pipeline.base.errors import TrapsError
from traps_pipeline.cli.command import OK, Commands, open_workspace


def add(commands: Commands) -> None:
    """Add `traps ledger release`."""
    noun = commands.noun("ledger", "where answers, votes and spending are kept")
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
