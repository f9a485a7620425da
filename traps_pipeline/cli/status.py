"""`traps status` and `traps why`: the state of a study and of an item's answers."""

from __future__ import annotations

import argparse

from traps_pipeline.base.errors import TrapsError
from traps_pipeline.base.terminal import plain, text_table
from traps_pipeline.cli.command import OK, Commands, experiment_of, load_definitions, open_workspace

SHOWN = 8  # stale partitions that are listed for a stage


def add(commands: Commands) -> None:
    """Add `traps status` and `traps why`."""
    parser = commands.add("status", status, "list fresh, stale and missing partitions, with the reasons")
    parser.add_argument("experiment", nargs="?")
    parser = commands.add(
        "why", why, "show an item, its answers and votes, and say which answers are valid and which will be asked again"
    )
    parser.add_argument("item", help="dataset:scenario:side")


def status(arguments: argparse.Namespace) -> int:
    """See `traps status --help`."""
    workspace = open_workspace(arguments)
    experiment = experiment_of(arguments).name if arguments.experiment else None
    if experiment is not None and experiment not in workspace.study.experiments:
        raise TrapsError(
            f"{workspace.root}/study.yaml: has no experiment {experiment!r}; traps init {experiment} adds it"
        )
    from traps_pipeline.pipeline.lineage import Lineage
    from traps_pipeline.pipeline.study_status import stage_statuses

    load_definitions()
    lineage = Lineage(workspace)
    rows = list(stage_statuses(workspace, lineage, experiment))
    counts = [(row.stage, row.fresh, len(row.stale), row.missing) for row in rows]
    lines = text_table(("stage", "fresh", "stale", "missing"), counts).splitlines()
    print("\n".join([f"workspace {workspace.place}", *lines[: -len(rows)]]))
    for line, row in zip(lines[-len(rows) :], rows, strict=True):
        print(line)
        for key, reasons in list(row.stale.items())[:SHOWN]:
            print(f"    {key}: {'; '.join(reasons[:3])}{' ...' if len(reasons) > 3 else ''}")
        if len(row.stale) > SHOWN:
            print(f"    ... and {len(row.stale) - SHOWN} more")
    for file in workspace.store.below(workspace.root / "checks", "*/*/*.json"):
        stage, check = file.parts[-3:-1]
        said = workspace.store.here(file).read_text(encoding="utf-8")[:200]
        print(f"check {check} of {stage} {file.stem} does not pass: {said}")
    print("stale: made from something that has changed since; `traps run EXPERIMENT` makes it again")
    return OK


def why(arguments: argparse.Namespace) -> int:
    """See `traps why --help`."""
    from traps_pipeline.pipeline.stale_reasons import why as explain

    for line in explain(open_workspace(arguments), arguments.item):
        print(plain(line))
    return OK
