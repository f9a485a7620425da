"""Serve a study's Dagster pages to the person who started it (`traps ui`)."""

import argparse
import os
import sys

from traps_pipeline.base.extras import require_extra
from traps_pipeline.cli.command import FAILED, INTERRUPTED, Commands, integer, number, open_workspace

CLUSTER = "of a study on a cluster"
_OWN_S = 5.0  # time for the second process itself, after its children have ended


def add(commands: Commands) -> None:
    """Add `traps ui` to the parser."""
    text = "start Dagster's web server and daemon; print the address to open, with its token"
    parser = commands.add("study ui", ui, text, example="--port 3001")
    parser.add_argument("--port", type=integer(1, 65535), default=3000, help="port of the web server (default: 3000)")
    parser.add_argument("--host", default="127.0.0.1", help="address to listen at (default: this machine only)")
    parser.add_argument(
        "--cpus", type=integer(1, 1000), help=f"as of `traps run`, for runs launched in the pages {CLUSTER}"
    )
    parser.add_argument(
        "--gpus", type=number(0, 1000), help=f"as of `traps run`, for runs launched in the pages {CLUSTER}"
    )
    parser.add_argument("--token", help="access token, instead of a fresh one (default: $TRAPS_UI_TOKEN)")


def ui(arguments: argparse.Namespace) -> int:
    """Start Dagster's web server and daemon, and print the address with its token."""
    require_extra("ui")
    from traps_pipeline.base.keys import optional_key
    from traps_pipeline.base.process_tree import fork_worker
    from traps_pipeline.base.webguard import token_for
    from traps_pipeline.pipeline.webserver import DANGER, STOP_S, TOKEN_VARIABLE, serve_with_dagster

    given_token = arguments.token or optional_key(TOKEN_VARIABLE)
    token = token_for(arguments.host, given_token, danger=DANGER, variable=TOKEN_VARIABLE)
    if (code := fork_worker(STOP_S + _OWN_S)) is not None:  # before Dagster's imports, which a fork could break
        return code if code >= 0 else FAILED
    print("starting Dagster; the address to open follows", file=sys.stderr)
    from traps_pipeline.pipeline.run import dagster_history
    from traps_pipeline.storage.workspace import RUN_CPUS, RUN_GPUS

    for variable, value in ((RUN_CPUS, arguments.cpus), (RUN_GPUS, arguments.gpus)):
        if value is not None:
            os.environ[variable] = str(value)  # read by the daemon, which starts such runs
    try:
        workspace = open_workspace(arguments)
        with dagster_history(workspace):
            pass  # one process creates it before several open it
        serve_with_dagster(arguments.host, arguments.port, token)
    except KeyboardInterrupt:
        return INTERRUPTED  # the first process reports it
