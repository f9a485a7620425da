"""Write and verify releases, submissions and leaderboards (`traps publish`)."""

import argparse
import sys
from pathlib import Path

from traps_pipeline.base.errors import TrapsError
from traps_pipeline.base.paths import OWN_SPECS, SCENE_SPECS
from traps_pipeline.base.terminal import plain
from traps_pipeline.base.wording import count_noun
from traps_pipeline.cli.command import FAILED, OK, Commands, integer, open_workspace, print_json


def add(commands: Commands) -> None:
    """Add the `traps publish` commands."""
    text = "write the folder that is published: clips, questions, labels, certificates, card, checksums"
    parser = commands.add("publish release", release, text, example="out --anonymous")
    parser.add_argument("folder", type=Path, help="an empty or new folder")
    parser.add_argument(
        "--arms", nargs="+", default=[], metavar="ARM", help="also publish the items and clips of these arms"
    )
    parser.add_argument("--anonymous", action="store_true", help="name no author, for double-blind review")
    parser.add_argument(
        "--without-answers", type=Path, metavar="KEY",
        help="publish a held-out set, whose items have opaque names; this file maps them (created if missing)",
    )  # fmt: skip
    parser.add_argument(
        "--commitment", type=Path, metavar="FILE", help="publish a file of `traps benchmark commit` with it"
    )
    parser.add_argument("--date", metavar="YYYY-MM-DD", help="date of publication, for the descriptions")
    parser.add_argument("--sign", type=Path, metavar="PEM", help="sign it with this private elliptic key")

    text = "report what was altered in a release, or what is wrong in a submission"
    parser = commands.add("publish verify", verify, text, example="out", workspace=False, json=True)
    parser.add_argument(
        "path", type=Path, help="a folder of `traps publish release`, or a file of `traps publish submit`"
    )
    parser.add_argument("--key", type=Path, metavar="PEM", help="public key: check a release's signature too")
    parser.add_argument(
        "--release", type=Path, metavar="FOLDER", help="check a submission's items against this release"
    )

    text = "write the folder that lets inspect_ai and lmms-eval evaluate models on a release"
    parser = commands.add("publish harness", harness, text, example="out harness", workspace=False)
    parser.add_argument("release", type=Path, help="a folder that `traps publish release` wrote")
    parser.add_argument("folder", type=Path, help="an empty or new folder")
    parser.add_argument("--media", choices=["images", "video"], default="images", help="what models are shown")
    parser.add_argument(
        "--uniform", type=integer(1, 1000), metavar="N",
        help="show N evenly spaced frames of a clip, if the model's entry says so (default: 25, at 5 a second)",
    )  # fmt: skip

    text = "pack a study's items, answers, votes and numbers into one file"
    parser = commands.add("publish submit", submit, text, example="mine.zip --name mine")
    parser.add_argument("file", type=Path, help="the zip to write")
    parser.add_argument("--name", required=True, help="name of the submission: lower-case letters, digits, - and .")

    text = "write the leaderboard as the hub's .eval_results, as Every Eval Ever JSON, and as Parquet"
    parser = commands.add("publish results", results, text, example="results --dataset owner/name")
    parser.add_argument("folder", type=Path, help="where the files are written")
    parser.add_argument("--dataset", required=True, metavar="OWNER/NAME", help="repository of the release on the hub")
    parser.add_argument("--organization", default="unknown", help="the evaluating organization")
    parser.add_argument("--developer", default="unknown", help="developer of the models, as the hub names it")

    text = "verify submissions, and write one page of them; versions and panels are ranked apart"
    parser = commands.add(
        "publish leaderboard", leaderboard, text, example="mine.zip --out board", workspace=False, json=True
    )
    parser.add_argument(
        "submissions", type=Path, nargs="+", help="files of `traps publish submit`, or folders of such files"
    )
    parser.add_argument("--out", type=Path, required=True, metavar="FOLDER", help="folder for the page and its table")
    parser.add_argument("--release", type=Path, metavar="FOLDER", help="check items and clips against this release")


def release(arguments: argparse.Namespace) -> int:
    from traps_pipeline.base.extras import require_extra
    from traps_pipeline.release.content import content_of
    from traps_pipeline.release.folder import CARD, Options, write_release
    from traps_pipeline.release.signing import sign

    if arguments.sign:
        require_extra("sign")  # check it before anything is written
    workspace, target = open_workspace(arguments), arguments.folder.absolute()
    options = Options(
        arms=arguments.arms,
        anonymous=arguments.anonymous,
        held_out=arguments.without_answers and arguments.without_answers.absolute(),
        date=_date(arguments.date),
        commitment=arguments.commitment,
    )
    output = write_release(content_of(workspace, arguments.arms), target, options)
    rows = ", ".join(f"{count} {table}" for table, count in output.rows.items())
    print(f"{count_noun(output.files, 'file')} in {target}: {count_noun(output.clips, 'clip')}; {rows}")
    if output.answers:
        print(f"which item is which, for you alone: {output.answers}")
        if SCENE_SPECS == OWN_SPECS:
            print("these scenarios are published: frames tell their answers; draw your own with traps benchmark sample")
    if arguments.sign:
        print(f"signature: {sign(target, arguments.sign)}")
    print(f"next: read {target / CARD}; traps publish verify {target}")
    return OK


def _date(text: str | None) -> str | None:
    """Return a date unchanged. Raises TrapsError if it is invalid."""
    from datetime import date

    try:
        return text and date.fromisoformat(text).isoformat()
    except ValueError:
        raise TrapsError(f"--date {text!r:.40}: is no date; write it as YYYY-MM-DD") from None


def verify(arguments: argparse.Namespace) -> int:
    from traps_pipeline.release.checksums import altered_files, read_checksums

    if not arguments.path.is_dir():
        if arguments.key:
            raise TrapsError(f"--key: only folders are signed, and {arguments.path} is none; leave it out")
        return verify_file(arguments.path, arguments.release, is_json=arguments.json)
    problems = altered_files(arguments.path)
    if arguments.key:
        from traps_pipeline.release.signing import signature_problem

        problem = signature_problem(arguments.path, arguments.key)
        problems += [problem] if problem else []
    if arguments.json:
        print_json({"problems": problems, "files": len(read_checksums(arguments.path))})
        return FAILED if problems else OK
    for problem in problems:
        print(problem)
    if problems:
        raise TrapsError(f"{arguments.path}: differs from the release in {count_noun(len(problems), 'file')}")
    signature_note = "; the signature is of this key" if arguments.key else "; no signature was checked (say --key)"
    print(f"{count_noun(len(read_checksums(arguments.path)), 'file')} checked, as released{signature_note}")
    return OK


def verify_file(path: Path, release: Path | None, *, is_json: bool) -> int:
    """Return the report of `traps publish verify` on a submission."""
    from traps_pipeline.release import verification as checks

    _, verification = checks.verify_file(path, None if release is None else checks.released_items(release))
    if is_json:
        print_json(
            {"problems": verification.problems, "checked": verification.checked, "not_checked": verification.unchecked}
        )
        return FAILED if verification.problems else OK
    for problem in verification.problems:
        print(plain(problem))
    print(f"checked: {', '.join(verification.checked)}")
    for part in verification.unchecked:
        print(f"not checked: {part}")
    print(f"{path}: {'does not hold' if verification.problems else 'holds'}")
    return FAILED if verification.problems else OK


def harness(arguments: argparse.Namespace) -> int:
    from traps_pipeline.release.harness.write import LMMS, media_settings, write_harness

    target = arguments.folder.absolute()
    count = write_harness(arguments.release, target, media_settings(arguments.media, arguments.uniform))
    print(f"{count_noun(count, 'item')} in {target}")
    print(f"next: inspect eval {target / 'traps_task.py'} -T regime=standard --model MODEL")
    print(f"or: python -m lmms_eval --include_path {target / LMMS} --tasks traps_standard --model MODEL --log_samples")
    return OK


def submit(arguments: argparse.Namespace) -> int:
    from traps_pipeline.release.submission import pack_submission

    description = pack_submission(open_workspace(arguments), arguments.file.absolute(), arguments.name)
    size = arguments.file.stat().st_size / 1e6
    contents_text = f"benchmark {description.benchmark} {description.version}, panel {description.panel}"
    print(f"{arguments.file}: {description.name}, {contents_text}, {size:.1f} MB")
    print(f"next: traps publish verify {arguments.file} --release FOLDER")
    return OK


def results(arguments: argparse.Namespace) -> int:
    from traps_pipeline.release.results import Attribution, write_results

    target, attribution = arguments.folder.absolute(), Attribution(arguments.organization, arguments.developer)
    files = write_results(open_workspace(arguments), target, arguments.dataset, attribution)
    print(f"{count_noun(len(files), 'file')} in {target}")
    return OK


def leaderboard(arguments: argparse.Namespace) -> int:
    from traps_pipeline.release.submissions import PAGE, gather, write_board
    from traps_pipeline.report.leaderboard_page import leaderboard_text

    submissions = arguments.submissions
    paths = [path for source in submissions for path in (sorted(source.glob("*.zip")) if source.is_dir() else [source])]
    board = gather(paths, arguments.release, say=lambda line: print(plain(line), file=sys.stderr, flush=True))
    write_board(board, arguments.out.absolute())
    if arguments.json:
        print_json({"groups": board.groups, "refused": board.refused})
        return FAILED if board.refused else OK
    for group in board.groups:
        print(f"\n{group.title}\n{leaderboard_text(group.board, group.two_way)}")
    for entry in board.refused:
        print(plain(f"refused: {entry.name}: {entry.problems[0]}"))
    print(f"next: open {arguments.out / PAGE}")
    return FAILED if board.refused else OK
