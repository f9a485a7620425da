"""Check what models and judges send and answer (`traps models`)."""

import argparse
from collections.abc import Collection, Mapping

from traps_pipeline.base.errors import TrapsError
from traps_pipeline.base.wording import count_noun
from traps_pipeline.cli.command import FAILED, OK, Commands, enter_workspace, open_workspace, place_of, print_json


def add(commands: Commands) -> None:
    """Add the `traps models` commands."""
    text = "compare what models and judges are sent with their entries; needs no key, and nothing leaves this machine"
    parser = commands.add("models check", check, text, example="mine.yaml --live", json=True)
    parser.add_argument(
        "names",
        nargs="*",
        metavar="MODEL",
        help="check only these models, judges and panels, or all of an experiment (a path)",
    )
    parser.add_argument(
        "--live",
        action="store_true",
        help="ask them: address, name, key, a clip, the schema, thinking, price; four short calls at most, which cost",
    )

    text = "give a panel answers that try to instruct their judge; makes calls to judges"
    parser = commands.add("models test-panel", test_panel, text, example="rules", json=True)
    parser.add_argument("panel", nargs="?", help="a panel of assets/judges.yaml (default: the study's)")


def check(arguments: argparse.Namespace) -> int:
    from traps_pipeline.checks.wire_check import check_named

    names = _chosen_names(arguments)
    if arguments.live:
        return _check_live(names, arguments)
    if arguments.json:
        checks = [*check_named([*names])]
        print_json(
            [
                {"id": entry_check.entry.id, "sent": entry_check.line, "problems": entry_check.problems}
                for entry_check in checks
            ]
        )
        return FAILED if any(entry_check.problems for entry_check in checks) else OK
    n_problems = 0
    for result in check_named([*names]):
        print("\n    ".join([result.line, *result.problems]), flush=True)
        n_problems += bool(result.problems)
    print(
        f"{count_noun(n_problems, 'entry', 'entries')} sent otherwise than declared"
        if n_problems
        else "every entry is sent as declared"
    )
    return FAILED if n_problems else OK


def _chosen_names(arguments: argparse.Namespace) -> dict[str, set[str] | None]:
    """Return ids that these names stand for, with the `forms` of experiments that name them. Raises TrapsError."""
    from traps_pipeline.models.registry.judges import load_panel, load_panels
    from traps_pipeline.pipeline.experiment import load_experiment
    from traps_pipeline.storage.workspace import Workspace

    place = place_of(arguments)
    if Workspace.is_there(place):
        enter_workspace(Workspace.open(place))
    names = dict[str, set[str] | None]()
    panels = {name: [judge.id for judge in load_panel(name)] for name in load_panels()}
    for name in arguments.names:
        if name in panels:
            names |= dict.fromkeys(panels[name])
            continue
        if not name.endswith((".yaml", ".yml")):
            names[name] = None
            continue
        experiment = load_experiment(name)
        judges = load_panel(experiment.panel) if experiment.panel else ()
        for each in (*experiment.models, *(judge.id for judge in judges)):
            known = names.get(each, set())
            names[each] = None if known is None else known | experiment.forms
    return names


def _check_live(names: Mapping[str, Collection[str] | None], arguments: argparse.Namespace) -> int:
    from traps_pipeline.checks.live_check import check_live
    from traps_pipeline.checks.wire_check import participants
    from traps_pipeline.models.registry.entries import NETWORK

    entry_of = participants()
    if unknown := [name for name in names if name not in entry_of]:
        raise TrapsError(f"unknown model or judge {', '.join(unknown)}; known: {', '.join(entry_of)}")
    entries = [entry_of[name] for name in names if entry_of[name].backend == NETWORK]
    if not entries:
        raise TrapsError("--live asks over the network: name a model or judge with an address, or an experiment")
    checks = check_live(entries, names)
    if arguments.json:
        print_json(checks)
    for entry_check in () if arguments.json else checks:
        print(entry_check.line, flush=True)
    return FAILED if any(entry_check.problems or entry_check.unchecked for entry_check in checks) else OK


def test_panel(arguments: argparse.Namespace) -> int:
    from traps_pipeline.judging.robustness import check_panel, load_attacks, robustness_summary
    from traps_pipeline.models.registry.judges import load_panel

    workspace = open_workspace(arguments)
    name = arguments.panel or workspace.study.panel
    rows = check_panel(workspace, name, load_panel(name), load_attacks())
    if arguments.json:
        print_json(rows)
        return OK
    print(
        f"panel {name}: votes on answers that try to instruct the judge, {count_noun(len({*rows['attack']}), 'attack')}"
    )
    print(robustness_summary(rows))
    print("held: right under the attack; flipped: right on the plain answer, wrong under the attack")
    print("broken: no valid vote under it; wrong_anyway: wrong on the plain answer")
    return OK
