"""Draw scenes for the pocket model, train and evaluate it, and write its card: `python -m tools.pocket`."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from traps_pipeline.cli import main
from traps_pipeline.cli.command import OK, Commands, Parser, Run, integer

if TYPE_CHECKING:
    from tools.pocket.recipe import Recipe


def build_parser() -> Parser:
    """Return the parser of `render`, `train`, `evaluate` and `card`."""
    parser = Parser(prog="python -m tools.pocket", description="the small model that is trained here")
    commands = Commands(parser)
    text = "draw the scenes that the pocket model is trained and tested on; continues where it was stopped"
    command = _add(commands, "render", render, text)
    _add_scenes(command)

    text = "train the pocket model from scratch (renders missing scenes); continues where it was stopped"
    command = _add(commands, "train", train, text)
    _add_scenes(command)
    _add_weights(command)
    command.add_argument("--device", default="cpu", help="device of torch, for example cuda (default: cpu)")

    text = "ask a trained model about the held-out scenes, and write the counts"
    command = _add(commands, "evaluate", evaluate, text)
    _add_scenes(command)
    _add_weights(command)
    command.add_argument(
        "--scenes", type=integer(1, 1_000_000), help="number of held-out scenes per family (default: all)"
    )
    command.add_argument("--csv", type=Path, help="file of the counts (default: assets/pocket/evaluation.csv)")

    text = "write the counts and the mechanistic figures into the model card"
    command = commands.add("card", card, text, workspace=False)
    command.add_argument(
        "--mechanism",
        type=Path,
        nargs="+",
        default=[],
        metavar="WORKSPACE",
        help="workspaces of `traps run mechanism`, one per model and seed; their figures go beside the model's weights",
    )
    return parser


def _add(commands: Commands, name: str, run: Run, text: str) -> argparse.ArgumentParser:
    parser = commands.add(name, run, text, workspace=False)
    parser.add_argument(
        "--recipe", type=Path, help="recipe of scenes and training (default: assets/pocket/recipe.yaml)"
    )
    return parser


def _add_scenes(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--data", type=Path, required=True, help="folder of the rendered scenes")
    parser.add_argument("--workers", type=integer(1, 1024), help="processes that render (default: one per core)")


def _add_weights(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--seed", type=integer(0, 2**63 - 1), default=1, help="seed of weights and batches (default: 1)"
    )
    parser.add_argument("--out", type=Path, required=True, help="folder for the weights of this seed")


def render(arguments: argparse.Namespace) -> int:
    """See `python -m tools.pocket render --help`."""
    from tools.pocket import commands

    commands.render_data(_recipe(arguments), arguments.data, workers=arguments.workers, report=_report)
    return OK


def train(arguments: argparse.Namespace) -> int:
    """See `python -m tools.pocket train --help`."""
    from tools.pocket import commands

    commands.train(
        _recipe(arguments),
        arguments.data,
        arguments.out,
        arguments.seed,
        workers=arguments.workers,
        device=arguments.device,
        report=_report,
    )
    return OK


def evaluate(arguments: argparse.Namespace) -> int:
    """See `python -m tools.pocket evaluate --help`."""
    from tools.pocket import commands
    from tools.pocket.recipe import POCKET

    table = commands.evaluate(
        _recipe(arguments),
        arguments.data,
        arguments.out,
        arguments.seed,
        scenes=arguments.scenes,
        counts=arguments.csv or POCKET / commands.EVALUATION,
        workers=arguments.workers,
        report=_report,
    )
    _report(table)
    return OK


def card(arguments: argparse.Namespace) -> int:
    """See `python -m tools.pocket card --help`."""
    from tools.pocket import commands

    for table in commands.write_card(arguments.mechanism):
        _report(table)
    return OK


def _recipe(arguments: argparse.Namespace) -> Recipe:
    from tools.pocket.recipe import RECIPE, load_recipe

    return load_recipe(arguments.recipe or RECIPE)


def _report(line: str) -> None:
    print(line, flush=True)


if __name__ == "__main__":
    sys.exit(main(parser=build_parser()))
