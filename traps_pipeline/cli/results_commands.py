"""Write, audit and compare results, with the explorer (`traps results`)."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from traps_pipeline.base.sheets import csv_bytes
from traps_pipeline.base.terminal import text_table, wrap_text
from traps_pipeline.base.wording import count_noun
from traps_pipeline.cli.command import OK, Commands, open_workspace, place_of, print_json


def add(commands: Commands) -> None:
    """Add the `traps results` commands, and `traps site`."""
    text = "write a folder to explore all answers and clips in; it opens from disk"
    parser = commands.add("results site", site, text, example="site --without-clips", json=True)
    parser.add_argument("folder", nargs="?", type=Path, help="default: `site` in the study's folder")
    parser.add_argument("--without-clips", action="store_true", help="leave the clips out, for a small folder")

    text = "recompute published values from other published tables, and compare"
    parser = commands.add("results audit", audit_published, text, example="--all", workspace=False, json=True)
    parser.add_argument("--all", action="store_true", help="also show the statements that agree")
    parser.add_argument("--csv", type=Path, metavar="FILE", help="write every finding to a file")

    text = "write every table, figure and page to a folder"
    parser = commands.add("results export", export_results, text, example="results")
    parser.add_argument("folder", nargs="?", type=Path, help="default: `export` in the study's folder")

    text = "print this study minus another on their common pairs, with paired intervals"
    parser = commands.add("results compare", compare_studies, text, example=".workspaces/earlier", json=True)
    parser.add_argument("other", type=Path, help="folder of the other study, such as an earlier benchmark version")
    parser.add_argument("--csv", type=Path, metavar="FILE", help="write every row to a file")


def site(arguments: argparse.Namespace) -> int:
    from traps_pipeline.report.explorer.site import INDEX, write_site

    workspace = open_workspace(arguments)
    folder = (arguments.folder or workspace.root / "site").absolute()
    summary = write_site(workspace, folder, clips=not arguments.without_clips)
    if arguments.json:
        print_json({"folder": folder, **vars(summary)})
        return OK
    clips = f"{count_noun(summary.clips, 'clip')}, {_megabytes(summary.clip_bytes)}"
    files = f"{count_noun(summary.files, 'file')}, {_megabytes(summary.bytes)}"
    content = f"{count_noun(summary.answers, 'answer')} with {count_noun(summary.votes, 'vote')}"
    print(f"{content}: {files}; {'without clips' if arguments.without_clips else clips}")
    if summary.lacking:
        print(f"{count_noun(len(summary.lacking), 'clip')} missing from the study, {summary.lacking[0]} first")
    print(f"next: open {folder / INDEX}")
    return OK


def _megabytes(size: int) -> str:
    return f"{size / 1e6:.1f} MB"


def audit_published(arguments: argparse.Namespace) -> int:
    """Print what the paper's tables contradict; a discrepancy is a finding and fails nothing."""
    from traps_pipeline.scoring.audit import audit, audit_text

    findings = audit()
    if arguments.json:
        print_json(findings)
    else:
        print(wrap_text(audit_text(findings, arguments.all)))
    if arguments.csv:
        arguments.csv.write_bytes(csv_bytes(findings))
        print(f"every finding: {arguments.csv}", file=sys.stderr)
    return OK


def export_results(arguments: argparse.Namespace) -> int:
    from traps_pipeline.report.publish import INDEX, export

    workspace = open_workspace(arguments)
    target = (arguments.folder or workspace.root / "export").absolute()
    count = export(workspace, target, say=lambda line: print(line, flush=True))
    print(f"{count_noun(count, 'file')} in {target}\nnext: open {target / INDEX}")
    return OK


def compare_studies(arguments: argparse.Namespace) -> int:
    from traps_pipeline.judging.judging_rows import VERDICTS
    from traps_pipeline.scoring.contrasts import version_contrasts
    from traps_pipeline.storage.benchmark_tables import current_rows
    from traps_pipeline.storage.workspace import Workspace

    studies = Workspace.open(arguments.other), Workspace.open(place_of(arguments))
    other_rows, own_rows = (current_rows(study, VERDICTS) for study in studies)
    table = version_contrasts(other_rows, own_rows)
    if arguments.csv:
        arguments.csv.write_bytes(csv_bytes(table))
    if arguments.json:
        print_json(table)
        return OK
    words = {True: "yes", False: "no"}
    separable = [words.get(value, "too few") for value in table["separable"]]
    separable = ["-" if p != p else word for word, p in zip(separable, table["p"], strict=True)]
    contrasts = table.assign(separable=separable, refused=table["refused"].fillna(""))
    print(text_table(list(contrasts), [[_cell(value) for value in row] for row in contrasts.itertuples(index=False)]))
    return OK


def _cell(value: object) -> str:
    """Return a figure with four digits, or a dash if it is missing."""
    if not isinstance(value, float):
        return str(value)
    return "-" if value != value else f"{value:.4f}"
