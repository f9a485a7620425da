"""Check whether this machine meets a study's requirements (`traps doctor`)."""

import argparse

from traps_pipeline.base.extras import require_extra
from traps_pipeline.base.terminal import plain, wrap_text
from traps_pipeline.base.wording import count_noun
from traps_pipeline.cli.command import FAILED, OK, Commands, place_of, print_json


def add(commands: Commands) -> None:
    """Add `traps doctor` to the parser."""
    text = "check this machine: render and encode a frame, and name what is missing"
    parser = commands.add("study doctor", doctor, text, example="--verify", json=True)
    parser.add_argument(
        "--local",
        nargs="*",
        metavar="MODEL",
        help="check local models instead: devices, NF4, weights, and the named models (by default the pocket model)",
    )
    parser.add_argument(
        "--verify",
        action="store_true",
        help="read every table, ledger and clip of the study in full, and report damage",
    )
    parser.add_argument(
        "--unused",
        nargs="?",
        choices=("show", "remove"),
        const="show",
        help="show (default) or remove unreferenced objects in the study's object store",
    )


def doctor(arguments: argparse.Namespace) -> int:
    from traps_pipeline.checks.doctor import examine, examine_files, examine_local, examine_unused

    if arguments.verify:
        findings, summary = iter(examine_files(place_of(arguments))), ("", "")
    elif arguments.unused is not None:
        findings = iter([examine_unused(place_of(arguments), is_removed=arguments.unused == "remove")])
        summary = "", ""
    elif arguments.local is not None:
        require_extra("local")
        findings = iter(examine_local(arguments.local))
        summary = "local models will not run", "this machine has everything that local models need"
    else:
        findings = iter(examine(place_of(arguments)))
        summary = "the demo will not run", "this machine has everything that the demo needs"
    if arguments.json:
        results = [*findings]
        print_json(results)
        return OK if all(finding.ok for finding in results) else FAILED
    problems = 0
    for finding in findings:
        line = f"{'ok  ' if finding.ok else 'FAIL'} {finding.what}: {plain(finding.detail)}"
        print(wrap_text(line, hang=5), flush=True)
        problems += not finding.ok
    if summary[0]:
        print(f"{count_noun(problems, 'problem')}; {summary[0]}" if problems else summary[1])
    return FAILED if problems else OK
