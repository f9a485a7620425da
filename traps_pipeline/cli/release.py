"""`traps release`, `traps verify`: the folder that is published, and what was altered in one."""

from __future__ import annotations

import argparse
from pathlib import Path

from traps_pipeline.cli.command import OK, Commands, open_workspace
from traps_pipeline.errors import TrapsError


def add(commands: Commands) -> None:
    """Add the commands of releases."""
    text = "write the folder that is published: clips, questions, labels, certificates, card, checksums"
    parser = commands.add("release", release, text)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--arms", nargs="+", default=[], metavar="ARM", help="also the items and clips of these arms")
    parser.add_argument("--anonymous", action="store_true", help="name no author, for double-blind review")
    parser.add_argument(
        "--without-answers", type=Path, metavar="KEY",
        help="a held-out set: items under opaque names, which only this file tells (it is made where it is missing)",
    )  # fmt: skip
    parser.add_argument("--date", metavar="YYYY-MM-DD", help="of the publication, for the descriptions")
    parser.add_argument("--sign", type=Path, metavar="PEM", help="sign it with this private elliptic key")

    text = "name every altered file of a release"
    parser = commands.add("verify", verify, text, workspace=False)
    parser.add_argument("path", type=Path, help="a folder that `traps release` wrote")
    parser.add_argument("--key", type=Path, metavar="PEM", help="check the signature with this public key, too")


def release(arguments: argparse.Namespace) -> int:
    """See `traps release --help`."""
    from traps_pipeline.release.content import content_of
    from traps_pipeline.release.folder import CARD, Options, write_release
    from traps_pipeline.release.signing import require_signing, sign

    if arguments.sign:
        require_signing()  # before anything is written
    workspace, target = open_workspace(arguments), arguments.folder.absolute()
    options = Options(
        arms=arguments.arms,
        anonymous=arguments.anonymous,
        held_out=arguments.without_answers and arguments.without_answers.absolute(),
        date=_date(arguments.date),
    )
    written = write_release(content_of(workspace, arguments.arms), target, options)
    rows = ", ".join(f"{count} {table}" for table, count in written.rows.items())
    print(f"{written.files} files in {target}: {written.clips} clips; {rows}")
    if written.answers:
        print(f"which item is which, for you alone: {written.answers}")
    if arguments.sign:
        print(f"signature: {sign(target, arguments.sign)}")
    print(f"next: read {target / CARD}; traps verify {target}")
    return OK


def _date(text: str | None) -> str | None:
    """A date as it was given. Raises TrapsError if it is none."""
    from datetime import date

    try:
        return text and date.fromisoformat(text).isoformat()
    except ValueError:
        raise TrapsError(f"--date {text!r:.40}: is no date; write it as YYYY-MM-DD") from None


def verify(arguments: argparse.Namespace) -> int:
    """See `traps verify --help`."""
    from traps_pipeline.release.checksums import altered_files, read_checksums

    problems = altered_files(arguments.path)
    if arguments.key:
        from traps_pipeline.release.signing import check_signature

        wrong = check_signature(arguments.path, arguments.key)
        problems += [wrong] if wrong else []
    for problem in problems:
        print(problem)
    if problems:
        raise TrapsError(f"{arguments.path}: {len(problems)} of its files are not what was released")
    signed = "; the signature is of this key" if arguments.key else "; no signature was checked (say --key)"
    print(f"{len(read_checksums(arguments.path))} files are what their checksums say{signed}")
    return OK
