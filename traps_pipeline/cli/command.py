"""Share what commands need: exit codes, parser, workspace, experiment.

Only `errors`, `files` and `terminal` of the package are imported here before a command runs, so that `traps --help`
answers at once.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import re
import sys
import textwrap
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import fields, is_dataclass
from typing import TYPE_CHECKING, Any, NoReturn

from typing_extensions import override

from traps_pipeline.base.suggestions import did_you_mean, nearest_name
from traps_pipeline.base.terminal import plain, wrap_text

if TYPE_CHECKING:
    from traps_pipeline.pipeline.experiment import Experiment
    from traps_pipeline.servers.server import ServerSettings
    from traps_pipeline.storage.place import Place
    from traps_pipeline.storage.workspace import Workspace

# Exit codes. For bad usage argparse itself exits with 2.
OK, FAILED, OVER_BUDGET, INTERRUPTED = 0, 1, 4, 130
METAVAR = "COMMAND"
# Commands of daily use, which can be given without their group.
SHORT_NAMES = {**dict.fromkeys(("doctor", "init", "plan", "run", "status", "why", "ui"), "study"), "site": "results"}

Run = Callable[[argparse.Namespace], int]  # a command takes its parsed arguments and returns an exit code


def integer(least: int, most: int) -> Callable[[str], int]:
    """Return an argparse type for a whole number in plain digits, `least` to `most`."""

    def parse(text: str) -> int:
        if not re.fullmatch(r"-?[0-9]{1,19}", text) or not least <= int(text) <= most:
            raise argparse.ArgumentTypeError(f"{text[:40]!r} is no whole number from {least} to {most}")
        return int(text)

    return parse


def number(above: float, most: float) -> Callable[[str], float]:
    """Return an argparse type for a number in plain digits, in (`above`, `most`]."""

    def parse(text: str) -> float:
        if not re.fullmatch(r"[0-9]{1,9}(\.[0-9]{1,9})?", text) or not above < float(text) <= most:
            raise argparse.ArgumentTypeError(f"{text[:40]!r} is no number above {above:g}, at most {most:g}")
        return float(text)

    return parse


class LineHelpFormatter(argparse.HelpFormatter):
    """A help formatter that keeps line breaks, so that examples can be copied."""

    def _fill_text(self, text: str, width: int, indent: str) -> str:
        lines = (line if line.startswith("example: ") else textwrap.fill(line, width) for line in text.splitlines())
        return "\n".join(lines)


class Parser(argparse.ArgumentParser):
    """A parser that suggests the nearest word. commands: the parser of every command below it, as `study run`."""

    def __init__(self, *, short: Mapping[str, str] | None = None, **settings: Any) -> None:
        super().__init__(**settings)
        self.commands: dict[str, Parser] = {}
        self._short = short or {}

    def options(self) -> list[str]:
        """Return the command's option names."""
        return [*dict.fromkeys(re.findall(r"(?<![\w-])--[a-z][\w-]*", self.format_help()))]

    def parse_args(  # pyright: ignore[reportIncompatibleMethodOverride] - it has overloads
        self, args: Iterable[str] | None = None, namespace: Any = None
    ) -> Any:
        """Let the command that received an unknown option report it."""
        words = [*(sys.argv[1:] if args is None else args)]
        if words and words[0] in self._short:
            words.insert(0, self._short[words[0]])
        arguments, unknown_words = self.parse_known_args(words, namespace)
        if unknown_words:
            parser: Parser = getattr(arguments, "parser", self)
            parser.error(
                f"unrecognized arguments: {plain(' '.join(unknown_words))}"
                f"{did_you_mean(unknown_words[0], parser.options())}"
            )
        return arguments

    @override
    def error(self, message: str) -> NoReturn:
        # own text: what the user typed
        match = re.match(r"(?:argument (.+?): )?invalid choice: '(.*)' \(choose from (.+)\)$", message, re.DOTALL)
        if match and match[1] in (None, METAVAR):
            choices, last = re.findall(r"[\w-]+", match[3]), {path.split()[-1]: path for path in self.commands}
            suggestion = nearest_name(match[2], [*choices, *self._short]) or nearest_name(match[2], last)
            name = (
                f"{self.prog} {suggestion}"
                if suggestion in choices
                else f"traps {last.get(suggestion or '') or suggestion}"
            )
            name = f"traps {suggestion}" if suggestion in self._short else name
            hint = f"; did you mean `{name}`?" if suggestion else f"; `{self.prog} --help` lists them"
            message = f"unknown command {plain(match[2])[:40]!r}{hint}"
        elif match:
            message += did_you_mean(match[2], re.findall(r"[\w-]+", match[3]))
        super().error(message)

    def _print_message(self, message: str, file: Any = None) -> None:
        """Write a message; unlike `argparse` from 3.11.3 on, raise BrokenPipeError."""
        if message and (stream := file or sys.stderr):
            stream.write(message)


class Commands:
    """The `traps` commands being declared, some of them in groups. by_name: their parsers."""

    def __init__(self, parser: Parser, groups: Mapping[str, str] | None = None) -> None:
        title = "groups" if groups else "commands"
        self._parsers = {"": parser.add_subparsers(title=title, required=not groups, metavar=METAVAR)}
        self.by_name = parser.commands
        for name, text in (groups or {}).items():
            group = self._parsers[""].add_parser(name, help=text, description=text)
            group.set_defaults(command=_show_help, parser=group)
            group.commands = self.by_name
            self._parsers[name] = group.add_subparsers(title="commands", metavar=METAVAR)

    def add(
        self,
        path: str,
        run: Run,
        text: str,
        *,
        example: str = "",
        workspace: bool = True,
        json: bool = False,
        is_paid: bool = False,
    ) -> Parser:
        """Add a command; return its parser, for further arguments.

        path: its name, after that of its group. example: arguments that its help shows. workspace: whether it works in
        a study. json: whether it can print its result as JSON. is_paid: whether a budget can end it.
        """
        group, _, name = path.rpartition(" ")
        budget_exit = f"{OVER_BUDGET} a budget is reached, " if is_paid else ""
        codes = f"exit codes: {OK} done, {FAILED} something failed, 2 bad usage, {budget_exit}{INTERRUPTED} interrupted"
        example_line = (
            f"example: traps {path.removeprefix('study ') if name in SHORT_NAMES else path} {example}\n"
            if example
            else ""
        )
        parser = self._parsers[group].add_parser(
            name, help=text, description=text, epilog=example_line + codes, formatter_class=LineHelpFormatter
        )
        self.by_name[path] = parser
        parser.set_defaults(command=run, parser=parser)
        if workspace:
            parser.add_argument(
                "--workspace",
                help="folder or s3:// address of the study (default: $TRAPS_WORKSPACE, else .workspaces/default)",
            )
        if json:
            parser.add_argument("--json", action="store_true", help="print the result as JSON")
        return parser


def print_failure(text: str, *, as_json: bool = False) -> None:
    """Print an error to standard error, as wrapped lines or as a line of JSON."""
    if as_json:
        from datetime import UTC, datetime

        at, lines = datetime.now(UTC).isoformat(timespec="seconds"), "\n".join(map(plain, text.splitlines()))
        print(json.dumps({"event": "failure", "at": at, "text": lines}, ensure_ascii=False), file=sys.stderr)
        return
    for line in f"traps: {text}".splitlines():
        print(wrap_text(plain(line), sys.stderr), file=sys.stderr)


def _show_help(arguments: argparse.Namespace) -> int:
    arguments.parser.print_help()
    return OK


def print_json(value: Any) -> None:
    """Print a result as JSON, with null for missing numbers."""
    print(json.dumps(_as_json(value), indent=2, ensure_ascii=False, allow_nan=False))


def _as_json(value: Any) -> Any:
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if value is None or isinstance(value, str | int):
        return value
    if isinstance(value, os.PathLike):
        return os.fspath(value)
    if is_dataclass(value):
        return {field.name: _as_json(getattr(value, field.name)) for field in fields(value)}
    if isinstance(value, Mapping):
        return {str(key): _as_json(field) for key, field in value.items()}
    if hasattr(value, "to_dict"):  # a frame
        return _as_json(value.to_dict("records"))
    if hasattr(value, "item"):  # a number of numpy's
        return _as_json(value.item())
    return [_as_json(field) for field in value] if isinstance(value, Iterable) else str(value)


def add_listening(parser: argparse.ArgumentParser, *, port: int, variable: str) -> None:
    """Add the arguments of a command that serves pages; `listening_of` reads them."""
    parser.add_argument("--port", type=integer(1, 65535), default=port, help=f"port of the page (default: {port})")
    parser.add_argument("--host", default="127.0.0.1", help="address to listen at (default: this machine only)")
    parser.add_argument("--token", help=f"access token, instead of a fresh one (default: ${variable})")
    parser.add_argument("--behind", default="", help="https address of a reverse proxy in front (docs/people.md)")


def listening_of(
    arguments: argparse.Namespace, command: str, variable: str, *, danger: str, people: Sequence[str] = ()
) -> ServerSettings:
    """Return a page server's address and tokens. danger: what everybody who reaches it could do. Raises TrapsError."""
    from traps_pipeline.base.keys import optional_key
    from traps_pipeline.base.webguard import personal_tokens, public_name, token_for
    from traps_pipeline.servers.server import ServerSettings

    if arguments.behind:
        public_name(arguments.behind)
    token_or_tokens = arguments.token or optional_key(variable)
    token = token_for(arguments.host, token_or_tokens, danger=danger, variable=variable)
    tokens = personal_tokens(token, people) if people else token
    return ServerSettings(arguments.host, arguments.port, tokens, f"traps {command}", arguments.behind)


def place_of(arguments: argparse.Namespace) -> Place:
    """Return the location of a study, which need not exist. Raises TrapsError."""
    from traps_pipeline.storage import place
    from traps_pipeline.storage.workspace import Workspace

    return place.parse_place(arguments.workspace) if arguments.workspace else Workspace.default_place()


def open_workspace(arguments: argparse.Namespace) -> Workspace:
    """Return a command's study. Raises TrapsError with a remedy if there is none."""
    from traps_pipeline.storage.workspace import Workspace

    return enter_workspace(Workspace.open(place_of(arguments)))


def enter_workspace(workspace: Workspace) -> Workspace:
    """Set the workspace in the environment, for keys and child processes; return it."""
    from traps_pipeline.models.registry.user_registry import clear_caches
    from traps_pipeline.storage.workspace import VARIABLE

    os.environ[VARIABLE] = str(workspace.place)
    clear_caches()  # the workspace may define models
    os.environ["DAGSTER_HOME"] = os.environ.get("DAGSTER_HOME") or str(
        workspace.dagster_home
    )  # `DAGSTER_HOME=` is none
    return workspace


def load_definitions() -> None:
    """Declare the pipeline's graph, for staleness, without importing Dagster."""
    import traps_pipeline.pipeline.stages  # noqa: F401 - its import is what declares the graph


def ledger_faults(workspace: Workspace) -> list[str]:
    """Return what is wrong with the ledger's database and its money, before a run refuses to write on it."""
    return [*workspace.ledger.faults()] if workspace.ledger.exists() else []


def add_experiment(parser: argparse.ArgumentParser, **settings: Any) -> None:
    """Add the argument that names an experiment."""
    text = "one of assets/experiments, or the path of a YAML file"
    parser.add_argument("experiment", **{"help": text, **settings})


def add_panel(parser: argparse.ArgumentParser) -> None:
    """Add the arguments that choose the judges."""
    parser.add_argument("--panel", help="the judges, if the experiment names no panel; kept in study.yaml")
    parser.add_argument(
        "--judged-by-rules",
        action="store_true",
        help="let the panel `rules` judge more than reference strategies; every table and page then says so",
    )


def experiment_of(arguments: argparse.Namespace) -> Experiment:
    """Return the experiment a command names. Raises TrapsError with known names."""
    from traps_pipeline.pipeline.experiment import load_experiment

    return load_experiment(arguments.experiment)
