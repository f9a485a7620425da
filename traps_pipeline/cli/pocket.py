"""`traps pocket`: the small model that is trained here."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from traps_pipeline.cli.command import OK, Commands, Run, whole

if TYPE_CHECKING:
    from traps_pipeline.pocket.recipe import Recipe


def add(commands: Commands) -> None:
    """Add `traps pocket render`, `train`, `evaluate` and `card`."""
    noun = commands.noun("pocket", "the small model that is trained here")
    text = "draw the scenes that the pocket model is trained and tested on; continues where it was stopped"
    parser = _add(noun, "render", render, text)
    _add_scenes(parser)

    text = "train the pocket model from scratch (renders missing scenes); continues where it was stopped"
    parser = _add(noun, "train", train, text)
    _add_scenes(parser)
    _add_weights(parser)

    text = "ask a trained model about the held-out scenes, and write the counts"
    parser = _add(noun, "evaluate", evaluate, text)
    _add_scenes(parser)
    _add_weights(parser)
    parser.add_argument(
        "--scenes", type=whole(1, 1_000_000), help="number of held-out scenes per family (default: all)"
    )
    _add_counts(parser)

    text = "write the counts and the mechanistic figures into the model card"
    parser = _add(noun, "card", card, text)
    _add_counts(parser)
    parser.add_argument(
        "--mechanism",
        type=Path,
        nargs="+",
        default=[],
        metavar="WORKSPACE",
        help="workspaces of `traps run mechanism`, one per seed; their figures go into assets/pocket/mechanism.csv",
    )


def _add(noun: Commands, name: str, run: Run, text: str) -> argparse.ArgumentParser:
    parser = noun.add(name, run, text, workspace=False)
    parser.add_argument(
        "--recipe", type=Path, help="recipe of scenes and training (default: assets/pocket/recipe.yaml)"
    )
    return parser


def _add_scenes(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--data", type=Path, required=True, help="folder of the rendered scenes")
    parser.add_argument("--workers", type=whole(1, 1024), help="processes that render (default: one per core)")


def _add_weights(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--seed", type=whole(0, 2**63 - 1), default=1, help="seed of weights and batches (default: 1)")
    parser.add_argument("--out", type=Path, required=True, help="folder for the weights of this seed")


def _add_counts(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--csv", type=Path, help="file of the counts (default: assets/pocket/evaluation.csv)")


def render(arguments: argparse.Namespace) -> int:
    """See `traps pocket render --help`."""
    from traps_pipeline.pocket import commands

    commands.render_data(_recipe(arguments), arguments.data, workers=arguments.workers, report=_report)
    return OK


def train(arguments: argparse.Namespace) -> int:
    """See `traps pocket train --help`."""
    from traps_pipeline.pocket import commands

    commands.train(
        _recipe(arguments),
        arguments.data,
        arguments.out,
        arguments.seed,
        workers=arguments.workers,
        report=_report,
    )
    return OK


def evaluate(arguments: argparse.Namespace) -> int:
    """See `traps pocket evaluate --help`."""
    from traps_pipeline.pocket import commands

    table = commands.evaluate(
        _recipe(arguments),
        arguments.data,
        arguments.out,
        arguments.seed,
        scenes=arguments.scenes,
        counts=arguments.csv or commands.EVALUATION,
        workers=arguments.workers,
        report=_report,
    )
    _report(table)
    return OK


def card(arguments: argparse.Namespace) -> int:
    """See `traps pocket card --help`."""
    from traps_pipeline.pocket import commands

    for table in commands.write_card(arguments.csv or commands.EVALUATION, arguments.mechanism):
        _report(table)
    return OK


def _recipe(arguments: argparse.Namespace) -> Recipe:
    from traps_pipeline.pocket.recipe import RECIPE, load_recipe

    return load_recipe(arguments.recipe or RECIPE)


def _report(line: str) -> None:
    print(line, flush=True)
