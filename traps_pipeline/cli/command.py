"""The parts that all commands share: exit codes, adding a command to the parser, its workspace and experiment.

Only `errors`, `files` and `terminal` of the package are imported here before a command runs, so that `traps --help`
answers at once.
"""

from __future__ import annotations

import argparse
import os
import re
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from traps_pipeline.pipeline.experiment import Experiment
    from traps_pipeline.servers.server import Listening
    from traps_pipeline.storage.place import Place
    from traps_pipeline.storage.workspace import Workspace

# Exit codes. For bad usage argparse itself exits with 2.
OK, FAILED, OVER_BUDGET, INTERRUPTED = 0, 1, 4, 130

Run = Callable[[argparse.Namespace], int]  # a command: it takes its parsed arguments and returns an exit code


def whole(least: int, most: int) -> Callable[[str], int]:
    """The type of an argument that is a whole number in these bounds, in plain digits."""

    def parse(text: str) -> int:
        if not re.fullmatch(r"-?[0-9]{1,18}", text) or not least <= int(text) <= most:
            raise argparse.ArgumentTypeError(f"{text[:40]!r} is no whole number from {least} to {most}")
        return int(text)

    return parse


def number(above: float, most: float) -> Callable[[str], float]:
    """The type of an argument that is a number in these bounds (the lower one left out), in plain digits."""

    def parse(text: str) -> float:
        if not re.fullmatch(r"[0-9]{1,9}(\.[0-9]{1,9})?", text) or not above < float(text) <= most:
            raise argparse.ArgumentTypeError(f"{text[:40]!r} is no number above {above:g}, at most {most:g}")
        return float(text)

    return parse


class Commands:
    """The commands of a parser, or those of one noun of it."""

    def __init__(self, parser: argparse.ArgumentParser, *, title: str | None = None) -> None:
        if title:
            self._parsers = parser.add_subparsers(title=title, required=True, metavar="COMMAND")
        else:
            self._parsers = parser.add_subparsers(required=True)

    def add(self, name: str, run: Run, text: str, *, workspace: bool = True) -> argparse.ArgumentParser:
        """Add a command; returns its parser, for further arguments. workspace: whether the command works in a study."""
        parser = self._parsers.add_parser(name, help=text, description=text)
        parser.set_defaults(command=run)
        if workspace:
            parser.add_argument(
                "--workspace",
                help="folder or s3:// address of the study (default: $TRAPS_WORKSPACE, else .workspaces/default)",
            )
        return parser

    def noun(self, name: str, text: str) -> Commands:
        """Add a noun, which has commands of its own."""
        return Commands(self._parsers.add_parser(name, help=text, description=text))


def add_listening(parser: argparse.ArgumentParser, *, port: int, variable: str) -> None:
    """Add the arguments of a command whose pages listen; `listening_of` reads them."""
    parser.add_argument("--port", type=whole(1, 65535), default=port, help=f"of the page (default: {port})")
    parser.add_argument("--host", default="127.0.0.1", help="address to listen at (default: this machine alone)")
    parser.add_argument("--token", help=f"of the address, instead of a fresh one (default: ${variable})")
    parser.add_argument(
        "--behind", default="", help="https address of a proxy that passes requests on (docs/people.md)"
    )


def listening_of(
    arguments: argparse.Namespace, command: str, variable: str, *, danger: str, people: Sequence[str] = ()
) -> Listening:
    """Where such a command listens and whom it lets in: who has the token, or each person with a token of their own.
    danger: what everybody who reaches the address could do. Raises TrapsError."""
    from traps_pipeline.base.keys import optional_key
    from traps_pipeline.base.webguard import personal_tokens, public_name, token_for
    from traps_pipeline.servers.server import Listening

    if arguments.behind:
        public_name(arguments.behind)
    given = arguments.token or optional_key(variable)
    token = token_for(arguments.host, given, danger=danger, variable=variable)
    tokens = personal_tokens(token, people) if people else token
    return Listening(arguments.host, arguments.port, tokens, f"traps {command}", arguments.behind)


def place_of(arguments: argparse.Namespace) -> Place:
    """Where the study lies that a command works in; it may not exist yet. Raises TrapsError for a wrong address."""
    from traps_pipeline.storage import place
    from traps_pipeline.storage.workspace import Workspace

    return place.place_of(arguments.workspace) if arguments.workspace else Workspace.default_place()


def open_workspace(arguments: argparse.Namespace) -> Workspace:
    """The study that a command works in. Raises TrapsError naming the remedy if there is none."""
    from traps_pipeline.storage.workspace import Workspace

    return entered(Workspace.open(place_of(arguments)))


def entered(workspace: Workspace) -> Workspace:
    """The workspace, after it was set in the environment, so that the partition keys here and in child processes are
    those of its study."""
    from traps_pipeline.models.own import forget
    from traps_pipeline.storage.workspace import VARIABLE

    os.environ[VARIABLE] = str(workspace.place)
    forget()  # the workspace may have models of its own
    os.environ.setdefault("DAGSTER_HOME", str(workspace.dagster_home))
    return workspace


def load_definitions() -> None:
    """Declare the graph, from which staleness is computed, without Dagster."""
    import traps_pipeline.pipeline.stages  # noqa: F401 - its import is what declares the graph


def add_panel(parser: argparse.ArgumentParser) -> None:
    """Add the arguments that say who judges."""
    parser.add_argument("--panel", help="who judges, where the experiment names no panel; kept in study.yaml")
    parser.add_argument(
        "--judged-by-rules",
        action="store_true",
        help="let the panel `rules` judge other models than reference models; every table and page then says so",
    )


def experiment_of(arguments: argparse.Namespace) -> Experiment:
    """The experiment that a command names. Raises TrapsError with the known names."""
    from traps_pipeline.pipeline.experiment import load_experiment

    return load_experiment(arguments.experiment)
