"""`traps requests` and `traps answers`: export of calls that are made elsewhere, and import of their answers."""

from __future__ import annotations

import argparse
from pathlib import Path

from traps_pipeline.cli.command import OK, Commands, experiment_of, open_workspace


def add(commands: Commands) -> None:
    """Add `traps requests export` and `traps answers import`."""
    text = "write an experiment's missing calls and their media to a folder"
    parser = commands.noun("requests", "export calls to be made elsewhere").add("export", export_calls, text)
    parser.add_argument("experiment")
    parser.add_argument("--out", type=Path, required=True, help="folder of requests.jsonl and media/")

    text = "import answers (JSON lines by key) into the ledger"
    parser = commands.noun("answers", "import answers from elsewhere").add("import", import_given, text)
    parser.add_argument("experiment")
    parser.add_argument("file", type=Path)


def export_calls(arguments: argparse.Namespace) -> int:
    """See `traps requests export --help`."""
    from traps_pipeline.study.exchange import REQUESTS, export_requests

    experiment = experiment_of(arguments)
    count = export_requests(open_workspace(arguments), experiment, arguments.out.absolute())
    print(f"{count} requests in {arguments.out / REQUESTS}")
    print(f"next: have them answered, then traps answers import {arguments.experiment} ANSWERS.jsonl")
    return OK


def import_given(arguments: argparse.Namespace) -> int:
    """See `traps answers import --help`."""
    from traps_pipeline.study.exchange import import_answers

    imported = import_answers(open_workspace(arguments), experiment_of(arguments), arguments.file)
    print(f"{imported.new} answers imported, {imported.known} were there already")
    print(f"next: traps run {arguments.experiment}")
    return OK
