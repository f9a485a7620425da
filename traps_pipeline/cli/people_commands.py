"""Serve review and labelling pages, and validate judges (`traps people`)."""

import argparse
import os
import re
from pathlib import Path

from traps_pipeline.base.errors import TrapsError
from traps_pipeline.base.extras import require_extra
from traps_pipeline.base.wording import count_noun
from traps_pipeline.cli.command import OK, Commands, add_listening, listening_of, open_workspace, print_json

REVIEW_TOKEN, ANNOTATE_TOKEN = "TRAPS_REVIEW_TOKEN", "TRAPS_ANNOTATE_TOKEN"


def add(commands: Commands) -> None:
    """Add the `traps people` commands."""
    text = "serve a page to review scenarios on: keep, correct, discard; print its address"
    parser = commands.add("people review", review, text, example="--who jd")
    parser.add_argument("--who", default=os.environ.get("USER", ""), help="whose decisions these are (default: $USER)")
    add_listening(parser, port=3100, variable=REVIEW_TOKEN)

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
    add_listening(parser, port=3200, variable=ANNOTATE_TOKEN)

    for name, command, text in (
        ("sheet", make_sheet, "write a CSV of labelled failures, which people then label blindly"),
        ("labels", write_labels, "write the labels that people gave on the pages of `traps people annotate` as a CSV"),
        ("validate", validate_judge, "compare the judge with the labels of two annotators"),
    ):
        parser = commands.add(f"people {name}", command, text, example="labels.csv", json=name == "validate")
        parser.add_argument("file", type=Path, help="CSV; see docs/judging.md for its columns")


def review(arguments: argparse.Namespace) -> int:
    """Serve the pages on which a reviewer decides about scenarios, until Ctrl-C."""
    require_extra("web")
    from traps_pipeline.base.paths import require_own_corrections
    from traps_pipeline.servers.review import Review, review_app
    from traps_pipeline.servers.server import serve

    if not arguments.who.strip():
        raise TrapsError("--who: say whose decisions these are, e.g. --who jd")
    listening = listening_of(arguments, "people review", REVIEW_TOKEN, danger="decide about the benchmark's items")
    require_own_corrections()
    workspace = open_workspace(arguments)
    session = Review(workspace, arguments.who.strip())
    _ = session.specs  # report a study without scenes before printing the address
    serve(review_app(session), listening)
    return OK


def annotate(arguments: argparse.Namespace) -> int:
    require_extra("web")
    from traps_pipeline.servers.annotate import Annotation, annotation_app
    from traps_pipeline.servers.server import serve

    people = [name.strip() for name in arguments.who]
    invalid_names = [name for name in people if not re.fullmatch(r"[\w.@-]{1,60}", name)]
    if not people or invalid_names or len(set(people)) < len(people):
        raise TrapsError(
            f"--who {' '.join(people)[:80]}: say who labels, each once, in letters, digits, `.`, `-`, `_` and "
            "`@`, e.g. --who jd ab"
        )
    listening = listening_of(
        arguments, "people annotate", ANNOTATE_TOKEN, danger="label in other people's names", people=people
    )
    workspace = open_workspace(arguments)
    if workspace.is_shared:
        raise TrapsError(
            f"{workspace.place}: labels are kept in a folder, and this study lies in an object store, where no other "
            "host would see them; label a study in a folder (docs/people.md)"
        )
    serve(annotation_app(Annotation(workspace)), listening)
    return OK


def make_sheet(arguments: argparse.Namespace) -> int:
    from traps_pipeline.people.judge_validation import annotation_sheet, write_sheet

    rows = annotation_sheet(open_workspace(arguments))
    write_sheet(rows, arguments.file)
    print(f"{count_noun(len(rows), 'failure')} in {arguments.file}")
    print("next: two people each fill in a copy: their name, then 1 or 0 an axis")
    print("then: put both copies' rows into one file, then traps people validate FILE.csv")
    return OK


def write_labels(arguments: argparse.Namespace) -> int:
    from traps_pipeline.people.judge_validation import LABEL_COLUMNS, write_sheet
    from traps_pipeline.people.labels import confabulation_rows, human_labels

    rows = confabulation_rows(human_labels(open_workspace(arguments)))
    write_sheet(rows, arguments.file, LABEL_COLUMNS)
    people = sorted({row["annotator"] for row in rows})
    print(f"{count_noun(len(rows), 'label')} of {', '.join(people)} in {arguments.file}")
    print(f"next: traps people validate {arguments.file}")
    return OK


def validate_judge(arguments: argparse.Namespace) -> int:
    from traps_pipeline.people.judge_validation import validation_rows, validation_text

    rows = validation_rows(open_workspace(arguments), arguments.file)
    if arguments.json:
        print_json(rows)
    else:
        print(validation_text(rows))
    return OK
