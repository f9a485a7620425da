"""Export requests and votes, and import their answers, to make calls elsewhere."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from traps_pipeline.base.errors import TrapsError
from traps_pipeline.base.wording import count_noun
from traps_pipeline.cli.command import OK, Commands, add_experiment, experiment_of, integer, open_workspace, print_json

if TYPE_CHECKING:
    from traps_pipeline.exchange.answer_exchange import ImportResult


def add(commands: Commands) -> None:
    """Add the export and import commands."""
    text = "write an experiment's missing calls and their media to a folder"
    parser = commands.add("study export-requests", export_calls, text, example="demo --out requests")
    add_experiment(parser)
    parser.add_argument("--out", type=Path, required=True, help="folder of requests.jsonl and media/, or of batches/")
    parser.add_argument("--batch", action="store_true", help="write the providers' own batch files, with media inline")
    parser.add_argument(
        "--media-at", metavar="ADDRESS",
        help="with --batch: write media to the folder media/, and refer to it under this address (https, gs, file ...)",
    )  # fmt: skip

    text = "write the missing votes as the judges' batch files"
    parser = commands.add("study export-votes", export_votes, text, example="paper --out votes")
    add_experiment(parser)
    parser.add_argument("--out", type=Path, required=True, help="folder of batches/")
    text = "import a provider's batch of votes into the ledger"
    parser = commands.add("study import-votes", import_cast, text, example="paper results.jsonl", json=True)
    add_experiment(parser)
    parser.add_argument("file", type=Path, help="the returned file")

    text = "import answers into the ledger: by key, a provider's batch, an inspect_ai log, or lmms-eval's samples"
    example = "demo answers.jsonl --model oracle"
    parser = commands.add("study import-answers", import_given, text, example=example, json=True)
    add_experiment(parser)
    parser.add_argument("file", type=Path, help="the returned file")
    parser.add_argument("--model", help="the model, for a file by item (default: the experiment's only model)")
    parser.add_argument("--run", type=integer(1, 1_000), default=1, help="the run, for a file by item (default: 1)")
    parser.add_argument("--key", type=Path, help="key of the held-out set that the file answers")
    parser.add_argument(
        "--errors", choices=("drop", "keep"), help="texts that look like error messages: leave them out, or import them"
    )


def export_calls(arguments: argparse.Namespace) -> int:
    from traps_pipeline.exchange.answer_exchange import REQUESTS, export_request_batches, export_requests

    experiment = experiment_of(arguments)
    if arguments.batch:
        workspace, out_folder = open_workspace(arguments), arguments.out.absolute()
        files, count = export_request_batches(workspace, experiment, out_folder, arguments.media_at)
        return _print_export(files, count, f"traps study import-answers {arguments.experiment}")
    if arguments.media_at:
        raise TrapsError("--media-at: only batch files refer to media by an address; say --batch, too")
    count = export_requests(open_workspace(arguments), experiment, arguments.out.absolute())
    print(f"{count_noun(count, 'request')} in {arguments.out / REQUESTS}")
    print(f"next: have them answered, then traps study import-answers {arguments.experiment} ANSWERS.jsonl")
    return OK


def import_given(arguments: argparse.Namespace) -> int:
    from traps_pipeline.benchmark.held_out import count_scoring, held_out_key
    from traps_pipeline.exchange.answer_exchange import AnswerContext, import_answers

    experiment = experiment_of(arguments)
    context = AnswerContext(arguments.model, arguments.run, arguments.key and held_out_key(arguments.key))
    import_result = import_answers(open_workspace(arguments), experiment, arguments.file, context, arguments.errors)
    if arguments.key:
        count = count_noun(count_scoring(arguments.key, arguments.file, import_result.scores), "score")
        print(f"by this key: {count}; about 20 of one participant tell every side", file=sys.stderr)
    return _print_import(import_result, arguments, "answer")


def export_votes(arguments: argparse.Namespace) -> int:
    from traps_pipeline.exchange.answer_exchange import export_vote_batches

    experiment = experiment_of(arguments)
    files, count = export_vote_batches(open_workspace(arguments), experiment, arguments.out.absolute())
    return _print_export(files, count, f"traps study import-votes {arguments.experiment}")


def import_cast(arguments: argparse.Namespace) -> int:
    from traps_pipeline.exchange.answer_exchange import import_votes

    experiment = experiment_of(arguments)
    return _print_import(import_votes(open_workspace(arguments), experiment, arguments.file), arguments, "vote")


def _print_export(files: Sequence[Path], count: int, command: str) -> int:
    for file in files:
        print(file)
    print(f"{count_noun(count, 'call')} in {count_noun(len(files), 'file')}")
    print(f"next: have them answered, then {command} RESULTS.jsonl for each file")
    return OK


def _print_import(imported: ImportResult, arguments: argparse.Namespace, noun: str) -> int:
    if arguments.json:
        print_json(imported)
        return OK
    print(f"{count_noun(imported.new, noun)} imported; already known: {imported.known:,}")
    if imported.dropped:
        print(f"{count_noun(imported.dropped, 'error message')} left out; their answers are still missing")
    if imported.failed:
        print(f"failed and still missing: {imported.failed}")
    print(f"next: traps run {arguments.experiment}")
    return OK
