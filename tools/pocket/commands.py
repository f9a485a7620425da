"""What the commands of `python -m tools.pocket` do: draw, train, evaluate, write the model card."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Sequence
from importlib.metadata import version
from pathlib import Path

from tools.pocket import claims, inside, lane_evaluation
from tools.pocket import evaluate as evaluation
from tools.pocket.data import data_digest, render
from tools.pocket.inside import FACTS
from tools.pocket.lanes import LaneScenes
from tools.pocket.recipe import GAP, NO_GAP, POCKET, SHIPPED, Recipe, Split
from tools.pocket.seeds import Figure, read_seeds, write_seeds
from traps_pipeline.base.digests import digest, file_digest
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.base.files import write_text
from traps_pipeline.base.paths import require_own
from traps_pipeline.storage.workspace import Workspace

EVALUATION, MECHANISM = "evaluation.csv", "mechanism.csv"  # beside the weights that ship
CARD = POCKET / "README.md"
THREADS = 1  # one thread sums in the same order on any machine; layers this small gain little from a second one
WEIGHTS = "weights"  # folder of the weights, below the folder of a seed; `checkpoint:` names it


Report = Callable[[str], None]  # takes a line about the progress of the work


def render_data(recipe: Recipe, data: Path, *, workers: int | None, report: Report) -> None:
    """Draw the missing scenes of both splits. workers: number of processes; None for one per core."""
    splits: tuple[Split, Split] = ("train", "held-out")
    for split in splits:
        _render(recipe, split, data, workers, report)


def _render(recipe: Recipe, split: Split, data: Path, workers: int | None, report: Report) -> None:
    """Draw the missing scenes of a split."""
    began = time.monotonic()
    render(recipe, split, data, workers=workers, report=report)
    report(f"{split}: rendered in {(time.monotonic() - began) / 60:.1f} minutes")


def train(
    recipe: Recipe, data: Path, out: Path, seed: int, *, workers: int | None, device: str = "cpu", report: Report
) -> None:
    """Render missing scenes, train on a device, and record the origin of the weights in `training.json`."""
    import torch

    from tools.pocket.train import train as fit

    _render(recipe, "train", data, workers, report)
    began = time.monotonic()
    torch.set_num_threads(THREADS)
    weights = fit(recipe, data, out, seed, device=device, report=report)
    facts = {
        "seed": seed,
        "recipe": digest(recipe.content()),
        "data": data_digest(recipe, "train", data),
        "weights": file_digest(weights / "model.safetensors"),
        "versions": {name: version(name) for name in ("mujoco", "tokenizers", "torch", "transformers")},
    }
    write_text(out / FACTS, json.dumps(facts, indent=1) + "\n")
    report(f"{weights}: trained in {(time.monotonic() - began) / 60:.1f} minutes")


def evaluate(
    recipe: Recipe,
    data: Path,
    out: Path,
    seed: int,
    *,
    scenes: int | None,
    counts: Path,
    workers: int | None,
    report: Report,
) -> str:
    """Ask the model of a seed about the held-out scenes and add the counts to the CSV; returns the table in Markdown.

    scenes: number per family; None for all held-out scenes.
    """
    import torch

    require_own(counts, "name a file of your own with --csv")
    torch.set_num_threads(THREADS)
    _render(recipe, "held-out", data, workers, report)
    if recipe.two_events:
        rows = lane_evaluation.evaluate(
            evaluation.entry_of(out / WEIGHTS, recipe.media), LaneScenes(recipe, data, "held-out"), seed, report=report
        )
        write_seeds(counts, rows)
        return lane_evaluation.markdown(rows)
    asked = list(evaluation.held_out(recipe, data, scenes))
    cells = evaluation.evaluate(evaluation.entry_of(out / WEIGHTS, recipe.media), asked, seed, report=report)
    write_seeds(counts, cells)
    return evaluation.markdown(cells)


def write_card(workspaces: Sequence[Path]) -> list[str]:
    """Write the figures of finished workspaces to the CSV of their model, and tables of the CSVs into the model card;
    returns these and the other tables in Markdown. Raises TrapsError if the card lacks the comments around a table."""
    require_own(CARD, "write the card in a checkout of the repository")
    for workspace in map(Workspace.open, workspaces):
        write_seeds(SHIPPED[inside.looked_into(workspace)] / MECHANISM, inside.figures_of(workspace))
    tables, text = card_tables(), CARD.read_text(encoding="utf-8")
    for name, table in tables.items():
        begin, end = marks(name)
        before, begun, rest = text.partition(begin)
        _, ended, after = rest.partition(end)
        if not begun or not ended:
            raise TrapsError(f"{CARD}: lacks the comments around a table ({begin!r}, {end!r}); restore it from git")
        text = f"{before}{begin}\n\n{table}\n\n{end}{after}"
    CARD.write_text(text, encoding="utf-8")
    return [*tables.values(), *other_tables()]


def card_tables() -> dict[str, str]:
    """Return the tables of the card in Markdown, by the names that their comments have."""
    gap, no_gap = (read_seeds(SHIPPED[name] / MECHANISM, Figure) for name in (GAP, NO_GAP))
    return {"contrast": claims.markdown(gap, no_gap)}


def other_tables() -> list[str]:
    """Return the tables for which the card is too short: what each model answers under every prompt."""
    return [evaluation.markdown(_counts(name)) for name in SHIPPED]


def _counts(model: str) -> list[evaluation.AnswerCounts]:
    return read_seeds(SHIPPED[model] / EVALUATION, evaluation.AnswerCounts)


def marks(table: str) -> tuple[str, str]:
    """Return the comments between which a table stands."""
    return f"<!-- {table}: written by `python -m tools.pocket card` -->", f"<!-- end of {table} -->"
