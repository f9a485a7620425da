"""`traps publish submit`, `results` and `leaderboard`: a study as one file, in other forms, and a page of many."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from traps_pipeline.base.terminal import plain
from traps_pipeline.cli.command import FAILED, OK, Commands, open_workspace, print_json


def add(commands: Commands) -> None:
    """Add `traps publish submit`, `results` and `leaderboard`."""
    text = "pack a study's items, answers, votes and numbers into one file"
    parser = commands.add("publish submit", submit, text, example="mine.zip --name mine")
    parser.add_argument("file", type=Path, help="the zip to write")
    parser.add_argument("--name", required=True, help="of the submission: lower-case letters, digits, - and .")

    text = "write the leaderboard as the hub's .eval_results, as Every Eval Ever JSON, and as Parquet"
    parser = commands.add("publish results", results, text, example="results --dataset owner/name")
    parser.add_argument("folder", type=Path, help="where the files are written")
    parser.add_argument("--dataset", required=True, metavar="OWNER/NAME", help="repository of the release on the hub")
    parser.add_argument("--organization", default="unknown", help="who made the evaluation")
    parser.add_argument("--developer", default="unknown", help="of the models, as the hub names it")

    text = "verify submissions, and make one page of them; other versions or panels are not ranked together"
    parser = commands.add(
        "publish leaderboard", leaderboard, text, example="mine.zip --out board", workspace=False, json=True
    )
    parser.add_argument(
        "submissions", type=Path, nargs="+", help="files of `traps publish submit`, or folders of such files"
    )
    parser.add_argument("--out", type=Path, required=True, metavar="FOLDER", help="of the page and its table")
    parser.add_argument("--release", type=Path, metavar="FOLDER", help="hold items and clips against this release")


def submit(arguments: argparse.Namespace) -> int:
    """See `traps publish submit --help`."""
    from traps_pipeline.release.submission import pack

    about = pack(open_workspace(arguments), arguments.file.absolute(), arguments.name)
    size = arguments.file.stat().st_size / 1e6
    of_what = f"benchmark {about.benchmark} {about.version}, panel {about.panel}"
    print(f"{arguments.file}: {about.name}, {of_what}, {size:.1f} MB")
    print(f"next: traps publish verify {arguments.file} --release FOLDER")
    return OK


def results(arguments: argparse.Namespace) -> int:
    """See `traps publish results --help`."""
    from traps_pipeline.release.results import Who, write_results

    target, who = arguments.folder.absolute(), Who(arguments.organization, arguments.developer)
    written = write_results(open_workspace(arguments), target, arguments.dataset, who)
    print(f"{len(written)} files in {target}")
    return OK


def verify_file(path: Path, release: Path | None, *, is_json: bool) -> int:
    """Return what `traps publish verify` says of a submission."""
    from traps_pipeline.release.submission import read_submission
    from traps_pipeline.release.verification import verify

    found = verify(read_submission(path), release)
    if is_json:
        print_json({"problems": found.problems, "checked": found.checked, "not_checked": found.unchecked})
        return FAILED if found.problems else OK
    for problem in found.problems:
        print(plain(problem))
    print(f"checked: {', '.join(found.checked)}")
    for what in found.unchecked:
        print(f"not checked: {what}")
    print(f"{path}: {'does not hold' if found.problems else 'holds'}")
    return FAILED if found.problems else OK


def leaderboard(arguments: argparse.Namespace) -> int:
    """See `traps publish leaderboard --help`."""
    from traps_pipeline.release.submissions import PAGE, gather, write_board
    from traps_pipeline.report.leaderboard_page import leaderboard_text

    given = arguments.submissions
    paths = [path for one in given for path in (sorted(one.glob("*.zip")) if one.is_dir() else [one])]
    board = gather(paths, arguments.release, say=lambda line: print(plain(line), file=sys.stderr, flush=True))
    write_board(board, arguments.out.absolute())
    if arguments.json:
        print_json({"groups": board.groups, "refused": board.refused})
        return FAILED if board.refused else OK
    for group in board.groups:
        print(f"\n{group.title}\n{leaderboard_text(group.board)}")
    for one in board.refused:
        print(plain(f"refused: {one.name}: {one.problems[0]}"))
    print(f"next: open {arguments.out / PAGE}")
    return FAILED if board.refused else OK
