"""`traps people review`: a page on this machine on which people review scenarios, one a screen."""

from __future__ import annotations

import argparse
import os

from traps_pipeline.base.errors import TrapsError
from traps_pipeline.base.extras import require
from traps_pipeline.cli.command import OK, Commands, add_listening, listening_of, open_workspace

TOKEN_VARIABLE = "TRAPS_REVIEW_TOKEN"


def add(commands: Commands) -> None:
    """Add `traps people review`."""
    text = "serve a page to review scenarios on: keep, correct, discard; print its address"
    parser = commands.add("people review", review, text, example="--who jd")
    parser.add_argument("--who", default=os.environ.get("USER", ""), help="whose decisions these are (default: $USER)")
    add_listening(parser, port=3100, variable=TOKEN_VARIABLE)


def review(arguments: argparse.Namespace) -> int:
    """See `traps people review --help`."""
    require("web")
    from traps_pipeline.base.paths import require_own_corrections
    from traps_pipeline.servers.review import Review, review_app
    from traps_pipeline.servers.server import serve

    if not arguments.who.strip():
        raise TrapsError("--who: say whose decisions these are, e.g. --who jd")
    listening = listening_of(arguments, "people review", TOKEN_VARIABLE, danger="decide about the benchmark's items")
    require_own_corrections()
    workspace = open_workspace(arguments)
    opened = Review(workspace, arguments.who.strip())
    _ = opened.specs  # a study without scenes is told before the address is
    serve(review_app(opened), listening)
    return OK
