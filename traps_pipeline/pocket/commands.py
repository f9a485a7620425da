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
from traps_pipeline.pocket.data import data_digest, render
from traps_pipeline.pocket.recipe import POCKET, RECIPE, Recipe, Split, load_recipe

EVALUATION = POCKET / "evaluation.csv"
CARD = POCKET / "README.md"
THREADS = 1  # sums then come in one order on any number of cores; layers this small gain little by a second one
WEIGHTS = "weights"  # in the folder of a seed: what `checkpoint:` names
FACTS = "training.json"  # beside them
BEGIN, END = "<!-- evaluation: written by `traps pocket card` -->", "<!-- end of evaluation -->"


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
    """Put the table of the CSV between the marks of the model card."""
    text = CARD.read_text(encoding="utf-8")
    before, begin, rest = text.partition(BEGIN)
    _, end, after = rest.partition(END)
    if not begin or not end:
        raise TrapsError(f"{CARD}: has no place for the table ({BEGIN!r} to {END!r}); restore it from git")
    table = evaluation.markdown(evaluation.read_cells(arguments.csv or EVALUATION))
    CARD.write_text(f"{before}{BEGIN}\n\n{table}\n\n{END}{after}", encoding="utf-8")


Command = Callable[[argparse.Namespace], None]
COMMANDS: Mapping[str, Command] = {"render": render_data, "train": train, "evaluate": evaluate, "card": card}
