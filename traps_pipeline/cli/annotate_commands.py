"""`traps people annotate`: pages on which people label clips and answers, without knowing whose they are."""

from __future__ import annotations

import argparse
import os
import re

from traps_pipeline.base.errors import TrapsError
from traps_pipeline.base.extras import require
from traps_pipeline.cli.command import OK, Commands, add_listening, listening_of, open_workspace

TOKEN_VARIABLE = "TRAPS_ANNOTATE_TOKEN"


def add(commands: Commands) -> None:
    """Add `traps people annotate`."""
    parser = commands.add(
        "people annotate",
        annotate,
        "serve pages on which people label clips and answers blindly; print an address for each",
        example="--who jd ab",
    )
    user = os.environ.get("USER", "")
    parser.add_argument(
        "--who", nargs="+", default=[user] if user else [], metavar="NAME", help="who labels (default: $USER)"
    )
    add_listening(parser, port=3200, variable=TOKEN_VARIABLE)


def annotate(arguments: argparse.Namespace) -> int:
    """See `traps people annotate --help`."""
    require("web")
    from traps_pipeline.servers.annotate import Annotation, annotation_app
    from traps_pipeline.servers.server import serve

    people = [name.strip() for name in arguments.who]
    wrong = [name for name in people if not re.fullmatch(r"[\w.@-]{1,60}", name)]
    if not people or wrong or len(set(people)) < len(people):
        raise TrapsError(
            f"--who {' '.join(people)[:80]}: say who labels, each once, in letters, digits, `.`, `-`, `_` and "
            "`@`, e.g. --who jd ab"
        )
    listening = listening_of(
        arguments, "people annotate", TOKEN_VARIABLE, danger="label in other people's names", people=people
    )
    workspace = open_workspace(arguments)
    if workspace.is_shared:
        raise TrapsError(
            f"{workspace.place}: labels are kept in a folder, and this study lies in an object store, where no other "
            "host would see them; label a study in a folder (docs/people.md)"
        )
    serve(annotation_app(Annotation(workspace)), listening)
    return OK
