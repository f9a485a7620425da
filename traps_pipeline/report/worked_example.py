"""Draw the worked example: one pair with answers, judges' votes and verdict."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from traps_pipeline.base.wording import count_noun
from traps_pipeline.judging.judging_rows import VERDICTS, VOTES
from traps_pipeline.models.asking.answer_rows import RESPONSES
from traps_pipeline.models.registry.entries import reference_rows
from traps_pipeline.protocol.cells import Cell, Evaluation
from traps_pipeline.report.contact_sheet import Layout, draw_pair, moments_of, ratio_of
from traps_pipeline.report.writing import PAGE_IN, figure_style, new_figure, plain
from traps_pipeline.storage.benchmark_tables import ITEMS

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

    from traps_pipeline.storage.workspace import Workspace

SCENE = "seesaw_sorter"  # the paper's example
FRAMES = Layout(block=3.0, header=0.62, gap=0.4, letters=64, questions=2, ids=True)
WORDS_IN, LETTERS, MAX_LINES = 3.1, 66, 6  # width of the text column beside the frames


@dataclass(frozen=True)
class Example:
    """A pair (ITEMS rows indexed by side), the model that is shown, and the lines beside its frames."""

    pair: pd.DataFrame
    model: str
    words: Mapping[str, Sequence[str]]


def worked_example(workspace: Workspace) -> Example | None:
    """Return the `chosen_example` of verdicts under standard, or None without one."""
    verdicts = workspace.tables.read_all(VERDICTS, None, dataset=("occlusion", "chaotic"), regime="standard")
    verdict = chosen_example(verdicts)
    if verdict is None:
        return None
    cell = Cell(verdict["dataset"], Evaluation(verdict["model"], "standard", int(verdict["run"])))
    tables = workspace.tables
    items = tables.read(ITEMS, {"dataset": cell.dataset})
    pair = items.loc[items["pair_id"] == verdict["pair_id"]].set_index("side")
    answers = {row["item_id"]: row for row in tables.read(RESPONSES, cell.partition).to_dict("records")}
    votes = tables.read_all(VOTES, None, **cell.partition).to_dict("records")
    rows = {row["item_id"]: row for row in verdicts.to_dict("records") if row["model"] == verdict["model"]}
    words = {}
    for side in ("control", "void"):
        item = str(pair.at[side, "item_id"])
        item_votes = [vote for vote in votes if vote["item_id"] == item]
        words[side] = reading(str(answers[item]["text"] or ""), item_votes, rows[item])
    return Example(pair, str(verdict["model"]), words)


def chosen_example(verdicts: pd.DataFrame) -> dict[Any, Any] | None:
    """Return the control's VERDICTS row of a telling pair; None without one.

    The control is correct and the void decided. Seesaws come first, then models that are no reference strategy, then
    voids abstained on.
    """
    decided_verdicts = verdicts.dropna(subset=["abstained"])
    voids = {
        (row["pair_id"], row["model"], row["run"]): bool(row["abstained"])
        for row in decided_verdicts.loc[decided_verdicts["side"] == "void"].to_dict("records")
    }
    references = reference_rows()
    controls = [
        row
        for row in decided_verdicts.loc[decided_verdicts["side"] == "control"].to_dict("records")
        if row["correct"] is True and not row["abstained"] and (row["pair_id"], row["model"], row["run"]) in voids
    ]

    def place(row: Mapping[Any, Any]) -> tuple[Any, ...]:
        abstained = voids[row["pair_id"], row["model"], row["run"]]
        rank = row["sub_scenario"] != SCENE, row["model"] in references, not abstained
        return *rank, row["pair_id"], row["model"], row["run"]

    return min(controls, key=place, default=None)


def reading(answer: str, votes: Sequence[Mapping[Any, Any]], verdict: Mapping[Any, Any]) -> list[str]:
    """Return three lines of text about a side (control or void): answer, judges' votes, and verdict."""
    valid = [vote for vote in votes if vote["valid"]]
    abstention_votes = [vote for vote in valid if vote["task"] == "abstention"]
    abstained = sum(bool(vote["abstained"]) for vote in abstention_votes)
    summary = f"an abstention for {abstained} of {count_noun(len(abstention_votes), 'judge')}"
    values = [str(vote["extracted_value"]) for vote in valid if vote["task"] == "correctness"]
    if values:
        summary += f"; they extract {', '.join(dict.fromkeys(values))}"
    outcome = "abstained" if verdict["abstained"] else "answered"
    if verdict["side"] == "control":
        outcome += ", correct" if verdict["correct"] else ", wrong"
    else:
        outcome += ", as it should" if verdict["abstained"] else ", though the outcome cannot be known"
    return [f"Answer: {answer}", f"Reading: {summary}.", f"Verdict: {outcome}."]


def example_figure(example: Example, root: Path) -> Figure:
    """Draw control and void frames left of their text, one page wide."""
    pair, words = example.pair, example.words
    with figure_style():
        block = moments_of(pair, root, FRAMES.moments)
        block_height = FRAMES.block * ratio_of(block[0])
        height = block_height + FRAMES.header + 0.35
        figure = new_figure(PAGE_IN, height, FRAMES.dpi, layout=None)
        left, bottom = 0.8 * FRAMES.gap, height - FRAMES.header - block_height - 0.05
        axes = figure.add_axes((left / PAGE_IN, bottom / height, FRAMES.block / PAGE_IN, block_height / height))
        draw_pair(axes, pair, *block, FRAMES)
        x = (left + FRAMES.block + 0.25) / PAGE_IN
        figure.text(
            x, (bottom + block_height + 0.12) / height, plain(example.model), size=7, weight="bold", parse_math=False
        )
        for side, top in (("control", bottom + block_height), ("void", bottom + block_height / 2 - 0.03)):
            wrap_options: dict[str, Any] = {"max_lines": MAX_LINES, "placeholder": " …"}
            lines = [line for part in words[side] for line in textwrap.wrap(plain(part), LETTERS, **wrap_options)]
            figure.text(x, top / height, "\n".join(lines), size=6.2, va="top", linespacing=1.25, parse_math=False)
    return figure
