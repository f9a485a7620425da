"""`traps people sheet`, `labels`, `validate`: the judge's labels of void failures, compared with people's."""

from __future__ import annotations

import argparse
from pathlib import Path

from traps_pipeline.cli.command import OK, Commands, open_workspace, print_json


def add(commands: Commands) -> None:
    """Add `traps people sheet`, `labels` and `validate`."""
    for name, command, text in (
        ("sheet", make_sheet, "write a CSV of labelled failures, which people then label blindly"),
        ("labels", write_labels, "write the labels that people gave on the pages of `traps people annotate` as a CSV"),
        ("validate", validate_judge, "compare the judge with the labels of two annotators"),
    ):
        parser = commands.add(f"people {name}", command, text, example="labels.csv", json=name == "validate")
        parser.add_argument("file", type=Path, help="CSV; see docs/judging.md for its columns")


def make_sheet(arguments: argparse.Namespace) -> int:
    """See `traps people sheet --help`."""
    from traps_pipeline.people.judge_validation import annotation_sheet, write_sheet

    rows = annotation_sheet(open_workspace(arguments))
    write_sheet(rows, arguments.file)
    print(f"{len(rows)} failures in {arguments.file}; two people each fill in a copy: their name, then 1 or 0 an axis")
    print("next: put both copies' rows into one file, then traps people validate FILE.csv")
    return OK


def write_labels(arguments: argparse.Namespace) -> int:
    """See `traps people labels --help`."""
    from traps_pipeline.people.judge_validation import LABEL_COLUMNS, write_sheet
    from traps_pipeline.people.labels import confabulation_rows, human_labels

    rows = confabulation_rows(human_labels(open_workspace(arguments)))
    write_sheet(rows, arguments.file, LABEL_COLUMNS)
    people = sorted({row["annotator"] for row in rows})
    print(f"{len(rows)} labels of {', '.join(people)} in {arguments.file}")
    print(f"next: traps people validate {arguments.file}")
    return OK


def validate_judge(arguments: argparse.Namespace) -> int:
    """See `traps people validate --help`."""
    from traps_pipeline.people.judge_validation import validate, validation_text

    rows = validate(open_workspace(arguments), arguments.file)
    if arguments.json:
        print_json(rows)
    else:
        print(validation_text(rows))
    return OK
