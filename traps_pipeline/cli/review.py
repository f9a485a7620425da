"""`traps review`: a page on this machine on which people review scenarios, one a screen."""

from __future__ import annotations

import argparse
import os

from traps_pipeline.cli.command import OK, Commands, open_workspace, whole
from traps_pipeline.errors import TrapsError

TOKEN_VARIABLE = "TRAPS_REVIEW_TOKEN"


def add(commands: Commands) -> None:
    """Add `traps review`."""
    parser = commands.add("review", review, "a page to review scenarios on: keep, correct, discard; prints its address")
    parser.add_argument("--who", default=os.environ.get("USER", ""), help="whose decisions these are (default: $USER)")
    parser.add_argument("--port", type=whole(1, 65535), default=3100, help="of the page (default: 3100)")
    parser.add_argument("--host", default="127.0.0.1", help="address to listen at (default: this machine alone)")
    parser.add_argument("--token", help=f"of the address, instead of a fresh one (default: ${TOKEN_VARIABLE})")


def review(arguments: argparse.Namespace) -> int:
    """See `traps review --help`."""
    from traps_pipeline.explorer.review import Review, review_app
    from traps_pipeline.explorer.server import serve
    from traps_pipeline.webguard import token_for

    if not arguments.who.strip():
        raise TrapsError("--who: say whose decisions these are, e.g. --who jd")
    given = arguments.token or os.environ.get(TOKEN_VARIABLE)
    token = token_for(arguments.host, given, danger="decide about the benchmark's items", variable=TOKEN_VARIABLE)
    workspace = open_workspace(arguments)
    opened = Review(workspace, arguments.who.strip())
    _ = opened.specs  # a study without scenes is told before the address is
    serve(review_app(opened), arguments.host, arguments.port, token, command="traps review")
    return OK
