"""What `traps pocket ...` does: glue between the command line and the modules beside this one."""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable, Mapping
from importlib.metadata import version

from traps_pipeline.digests import digest, file_digest
from traps_pipeline.errors import TrapsError
from traps_pipeline.pocket import evaluate as evaluation
from traps_pipeline.pocket import inside
from traps_pipeline.pocket.data import data_digest, render
from traps_pipeline.pocket.inside import FACTS
from traps_pipeline.pocket.recipe import POCKET, RECIPE, Recipe, Split, load_recipe
from traps_pipeline.storage.workspace import Workspace

EVALUATION = POCKET / "evaluation.csv"
INSIDE = POCKET / "mechanism.csv"
CARD = POCKET / "README.md"
THREADS = 1  # sums then come in one order on any number of cores; layers this small gain little by a second one
WEIGHTS = "weights"  # in the folder of a seed: what `checkpoint:` names
MARKS = "<!-- evaluation: written by `traps pocket card` -->", "<!-- end of evaluation -->"
INSIDE_MARKS = "<!-- inside: written by `traps pocket card` -->", "<!-- end of inside -->"


def _say(line: str) -> None:
    print(line, flush=True)


def _recipe(arguments: argparse.Namespace) -> Recipe:
    return load_recipe(arguments.recipe or RECIPE)


def render_data(arguments: argparse.Namespace) -> None:
    """Both splits."""
    splits: tuple[Split, Split] = ("train", "held-out")
    for split in splits:
        _render(arguments, split)


def _render(arguments: argparse.Namespace, split: Split) -> None:
    """Draw what is missing of a split."""
    began = time.monotonic()
    render(_recipe(arguments), split, arguments.data, workers=arguments.workers, report=_say)
    _say(f"{split}: rendered in {(time.monotonic() - began) / 60:.1f} minutes")


def train(arguments: argparse.Namespace) -> None:
    """Render what is missing, train, and note in `training.json` what the weights came from."""
    import torch

    from traps_pipeline.pocket.train import train as fit

    recipe, out = _recipe(arguments), arguments.out
    _render(arguments, "train")
    began = time.monotonic()
    torch.set_num_threads(THREADS)
    weights = fit(recipe, arguments.data, out, arguments.seed, report=_say)
    facts = {
        "seed": arguments.seed,
        "recipe": digest(recipe.model_dump(mode="json")),
        "data": data_digest(recipe, "train", arguments.data),
        "weights": file_digest(weights / "model.safetensors"),
        "versions": {name: version(name) for name in ("mujoco", "tokenizers", "torch", "transformers")},
    }
    (out / FACTS).write_text(json.dumps(facts, indent=1) + "\n", encoding="utf-8")
    _say(f"{weights}: trained in {(time.monotonic() - began) / 60:.1f} minutes")


def evaluate(arguments: argparse.Namespace) -> None:
    """Ask the weights of a seed about the held-out scenes; prints the table and adds the counts to the CSV."""
    import torch

    torch.set_num_threads(THREADS)
    recipe = _recipe(arguments)
    _render(arguments, "held-out")
    asked = list(evaluation.held_out(recipe, arguments.data, arguments.scenes))
    cells = evaluation.evaluate(evaluation.entry_of(arguments.out / WEIGHTS), asked, arguments.seed, report=_say)
    evaluation.write_cells(arguments.csv or EVALUATION, cells)
    _say(evaluation.markdown(cells))


def card(arguments: argparse.Namespace) -> None:
    """Take the figures of finished workspaces into their CSV, and put the tables of both CSVs into the model card."""
    figures = [figure for folder in arguments.mechanism for figure in inside.figures_of(Workspace.open(folder))]
    if figures:
        inside.write_figures(INSIDE, figures)
    tables = {
        MARKS: evaluation.markdown(evaluation.read_cells(arguments.csv or EVALUATION)),
        INSIDE_MARKS: inside.markdown(inside.read_figures(INSIDE)),
    }
    text = CARD.read_text(encoding="utf-8")
    for (begin, end), table in tables.items():
        before, begun, rest = text.partition(begin)
        _, ended, after = rest.partition(end)
        if not begun or not ended:
            raise TrapsError(f"{CARD}: has no place for a table ({begin!r} to {end!r}); restore it from git")
        text = f"{before}{begin}\n\n{table}\n\n{end}{after}"
    CARD.write_text(text, encoding="utf-8")
    for table in tables.values():
        _say(table)


Command = Callable[[argparse.Namespace], None]
COMMANDS: Mapping[str, Command] = {"render": render_data, "train": train, "evaluate": evaluate, "card": card}
