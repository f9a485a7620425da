"""`traps publish release`, `verify`, `harness` and `traps benchmark commit`, `prove`: what is published, and proofs."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from traps_pipeline.base.errors import TrapsError
from traps_pipeline.cli.command import FAILED, OK, Commands, open_workspace, print_json, whole
from traps_pipeline.cli.submission_commands import verify_file

if TYPE_CHECKING:
    from traps_pipeline.release.commitment import Commitment
    from traps_pipeline.scenes.worlds.spec import SceneSpec


def add(commands: Commands) -> None:
    """Add the commands of releases."""
    text = "write the folder that is published: clips, questions, labels, certificates, card, checksums"
    parser = commands.add("publish release", release, text, example="out --anonymous")
    parser.add_argument("folder", type=Path, help="an empty or new one")
    parser.add_argument("--arms", nargs="+", default=[], metavar="ARM", help="also the items and clips of these arms")
    parser.add_argument("--anonymous", action="store_true", help="name no author, for double-blind review")
    parser.add_argument(
        "--without-answers", type=Path, metavar="KEY",
        help="a held-out set: items under opaque names, which only this file tells (it is made where it is missing)",
    )  # fmt: skip
    parser.add_argument(
        "--commitment", type=Path, metavar="FILE", help="publish a file of `traps benchmark commit` with it"
    )
    parser.add_argument("--date", metavar="YYYY-MM-DD", help="of the publication, for the descriptions")
    parser.add_argument("--sign", type=Path, metavar="PEM", help="sign it with this private elliptic key")

    text = "name what was altered in a release, or what does not hold in a submission"
    parser = commands.add("publish verify", verify, text, example="out", workspace=False, json=True)
    parser.add_argument(
        "path", type=Path, help="a folder of `traps publish release`, or a file of `traps publish submit`"
    )
    parser.add_argument("--key", type=Path, metavar="PEM", help="of a release: check its signature, too")
    parser.add_argument("--release", type=Path, metavar="FOLDER", help="of a submission: hold its items against this")

    text = "write the folder with which inspect_ai and lmms-eval evaluate models on a release"
    parser = commands.add("publish harness", harness, text, example="out harness", workspace=False)
    parser.add_argument("release", type=Path, help="a folder that `traps publish release` wrote")
    parser.add_argument("folder", type=Path, help="an empty or new one")
    parser.add_argument("--media", choices=["images", "video"], default="images", help="what models are shown")
    parser.add_argument(
        "--uniform", type=whole(1, 1000), metavar="N",
        help="so many evenly spaced frames of a clip, for a model whose entry says so (default: 25, at 5 a second)",
    )  # fmt: skip

    text = "fix a sampled benchmark before anybody sees it: write a commitment to publish, and a reveal to keep"
    example = "private --out commitment.json --reveal reveal.json"
    parser = commands.add("benchmark commit", commit_benchmark, text, example=example, workspace=False)
    parser.add_argument("benchmark", type=Path, help="a folder that `traps benchmark sample` wrote")
    parser.add_argument("--out", type=Path, required=True, metavar="FILE", help="the commitment")
    parser.add_argument("--reveal", type=Path, required=True, metavar="FILE", help="the seed and a secret number")

    text = "prove that a revealed benchmark is the one that was committed"
    example = "commitment.json reveal.json --specs private"
    parser = commands.add("benchmark prove", verify_commitment, text, example=example, workspace=False)
    parser.add_argument("commitment", type=Path, help="a file of `traps benchmark commit --out`")
    parser.add_argument("reveal", type=Path, help="a file of `traps benchmark commit --reveal`")
    parser.add_argument("--specs", type=Path, metavar="FOLDER", help="the revealed benchmark, sampled or released")
    parser.add_argument("--without-drawing", action="store_true", help="look at --specs alone; nothing is drawn again")
    parser.add_argument("--workers", type=whole(1, 1024), help="processes (default: one per core)")


def release(arguments: argparse.Namespace) -> int:
    """See `traps publish release --help`."""
    from traps_pipeline.base.extras import require
    from traps_pipeline.release.content import content_of
    from traps_pipeline.release.folder import CARD, Options, write_release
    from traps_pipeline.release.signing import sign

    if arguments.sign:
        require("sign")  # before anything is written
    workspace, target = open_workspace(arguments), arguments.folder.absolute()
    options = Options(
        arms=arguments.arms,
        anonymous=arguments.anonymous,
        held_out=arguments.without_answers and arguments.without_answers.absolute(),
        date=_date(arguments.date),
        commitment=arguments.commitment,
    )
    written = write_release(content_of(workspace, arguments.arms), target, options)
    rows = ", ".join(f"{count} {table}" for table, count in written.rows.items())
    print(f"{written.files} files in {target}: {written.clips} clips; {rows}")
    if written.answers:
        print(f"which item is which, for you alone: {written.answers}")
    if arguments.sign:
        print(f"signature: {sign(target, arguments.sign)}")
    print(f"next: read {target / CARD}; traps publish verify {target}")
    return OK


def _date(text: str | None) -> str | None:
    """Return a date as it was given. Raises TrapsError if it is none."""
    from datetime import date

    try:
        return text and date.fromisoformat(text).isoformat()
    except ValueError:
        raise TrapsError(f"--date {text!r:.40}: is no date; write it as YYYY-MM-DD") from None


def verify(arguments: argparse.Namespace) -> int:
    """See `traps publish verify --help`."""
    from traps_pipeline.release.checksums import altered_files, read_checksums

    if not arguments.path.is_dir():
        if arguments.key:
            raise TrapsError(f"--key: only folders are signed, and {arguments.path} is none; leave it out")
        return verify_file(arguments.path, arguments.release, is_json=arguments.json)
    problems = altered_files(arguments.path)
    if arguments.key:
        from traps_pipeline.release.signing import check_signature

        wrong = check_signature(arguments.path, arguments.key)
        problems += [wrong] if wrong else []
    if arguments.json:
        print_json({"problems": problems, "files": len(read_checksums(arguments.path))})
        return FAILED if problems else OK
    for problem in problems:
        print(problem)
    if problems:
        raise TrapsError(f"{arguments.path}: {len(problems)} of its files are not what was released")
    signed = "; the signature is of this key" if arguments.key else "; no signature was checked (say --key)"
    print(f"{len(read_checksums(arguments.path))} files are what their checksums say{signed}")
    return OK


def harness(arguments: argparse.Namespace) -> int:
    """See `traps publish harness --help`."""
    from traps_pipeline.release.harness.write import LMMS, shown, write_harness

    target = arguments.folder.absolute()
    count = write_harness(arguments.release, target, shown(arguments.media, arguments.uniform))
    print(f"{count} items in {target}")
    print(f"next: inspect eval {target / 'traps_task.py'} -T regime=standard --model MODEL")
    print(f"or: python -m lmms_eval --include_path {target / LMMS} --tasks traps_standard --model MODEL --log_samples")
    return OK


def commit_benchmark(arguments: argparse.Namespace) -> int:
    """See `traps benchmark commit --help`."""
    from traps_pipeline.release.commitment import commit

    made = commit(arguments.benchmark.absolute(), arguments.out, arguments.reveal)
    print(f"{len(made.specs)} records of {made.name} {made.version} are committed in {arguments.out}: publish it")
    print(f"keep {arguments.reveal} secret until the benchmark is revealed; without it nothing can be proven")
    return OK


def verify_commitment(arguments: argparse.Namespace) -> int:
    """See `traps benchmark prove --help`."""
    from traps_pipeline.release import commitment as sealed

    published, reveal = sealed.read_commitment(arguments.commitment), sealed.read_reveal(arguments.reveal)
    if arguments.without_drawing and not arguments.specs:
        raise TrapsError("--without-drawing: leaves nothing to look at; name the revealed benchmark with --specs")
    problems, proven = [], []
    specs = sealed.revealed_specs(arguments.specs.absolute()) if arguments.specs else None
    if specs is not None:
        problems += sealed.broken_seals(published, reveal, specs)
        proven.append(f"the records of {arguments.specs} are the committed ones")
    if not arguments.without_drawing and not problems:
        drawn = sealed.drawn_again(
            published, reveal, workers=arguments.workers, report=lambda line: print(line, flush=True)
        )
        problems += _not_drawn(published, sealed.broken_seals(published, reveal, drawn), specs, drawn)
        proven.append("the revealed seed draws them")
    for problem in problems:
        print(problem)
    if problems:
        raise TrapsError(f"{arguments.commitment}: is not proven; {len(problems)} things are not what was committed")
    print(f"{len(published.specs)} records of {published.name} {published.version}: {', and '.join(proven)}")
    if arguments.without_drawing:
        print("not checked: whether the revealed seed draws them")
    return OK


def _not_drawn(
    published: Commitment, problems: list[str], specs: dict[str, SceneSpec] | None, drawn: dict[str, SceneSpec]
) -> list[str]:
    """Return what the seed does not draw here; where only the machine's arithmetic differs, that is said too."""
    from traps_pipeline.release.commitment import other_arithmetic, same_scene

    if problems and specs is not None and {*specs} == {*drawn} and all(same_scene(specs[i], drawn[i]) for i in specs):
        elsewhere = other_arithmetic(published) or "another kind of CPU"
        problems.append(f"all scenes are the same but for the last digits of their simulation ({elsewhere})")
    return problems
