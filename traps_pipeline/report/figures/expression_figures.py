"""Draw encoding against expression: states and output by item, margin by layer."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from traps_pipeline.mechanism.probes import auroc
from traps_pipeline.protocol.datasets import SHORT
from traps_pipeline.protocol.regimes import PROMPTING, STANDARD
from traps_pipeline.report.figures.looks import legend_key
from traps_pipeline.report.result_frames import Results, datasets_of
from traps_pipeline.report.tables.inside_columns import why
from traps_pipeline.report.writing import COLOURS, INK, PAGE_IN, NotRun, figure_style, new_figure, plain

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

CONTROL, VOID = COLOURS[0], COLOURS[1]
SCORES = {"states": "states", "margin": "first token", "sentences": "whole abstentions"}  # names of `orders`
_LINES = dict(zip(PROMPTING, ("-", "--"), strict=True))


def states_and_output(results: Results) -> Figure:
    """Return every item by its scores from states and from output.

    Both are read under the standard VQA prompt. Up: the score of a probe that has not seen the item's scenario, above
    its threshold for voids. Right: log-odds that the answer begins with an abstention. A filled marker was answered
    under standard, a hollow one abstained on. Orange filled markers above the line and left of it are encoded and not
    expressed. Above each panel: how well each score separates voids from controls (AUROC), whole abstentions
    against the model's own answer, and the floor of noise under the same split (mean and two deviations).
    There is a gap in AUROC, too, only if states exceed the output by more than that.
    """
    rows = scored_items(results)
    if not len(rows):
        raise NotRun(why(results, "the paper prints no scores of items"))
    models, datasets = list(dict.fromkeys(rows["model"])), datasets_of(rows)
    with figure_style():
        figure = new_figure(PAGE_IN, 0.6 + 2.1 * len(models))
        axes = figure.subplots(len(models), len(datasets), squeeze=False, sharey="row")
        for line, model in zip(axes, models, strict=True):
            for ax, dataset in zip(line, datasets, strict=True):
                part = rows.loc[(rows["model"] == model) & (rows["dataset"] == dataset)]
                _scatter(ax, part)
                figures = "\n".join(f"{SCORES[name]} {area:.2f}" for name, area in orders(part).items())
                title = f"{plain(str(model))[:20]}: {SHORT[dataset]}, n {len(part)}\n{figures}"
                ax.set_title(title + _floor(results, str(model), dataset), size=6)
            line[0].set_ylabel("states: log-odds of void")
        for ax in axes[-1]:
            ax.set_xlabel("output: log-odds of abstaining", size=7)
        handles = [
            legend_key(f"{side}, {word}", colour, "o", markerfacecolor=face or colour)
            for side, colour in (("void", VOID), ("control", CONTROL))
            for word, face in (("answered", ""), ("abstained", "white"))
        ]
        figure.legend(handles=handles, loc="outside lower center", ncols=4)
    return figure


def scored_items(results: Results) -> pd.DataFrame:
    """Return items with both scores, and `sentence`.

    `sentence`: by how much an abstention is likelier than the model's own answer (nats per token, or NaN).
    """
    rows, sentence_rows = results.item_scores, results.sentences
    sentence_rows = sentence_rows.loc[sentence_rows["prompt"] == STANDARD, ["model", "item_id", "abstention", "own"]]
    sentence_rows = sentence_rows.assign(
        sentence=sentence_rows["abstention"].astype(float) - sentence_rows["own"].astype(float)
    )
    rows = rows.merge(sentence_rows[["model", "item_id", "sentence"]], on=["model", "item_id"], how="left")
    return rows.loc[rows["margin"].notna() & rows["own"].notna()].reset_index(drop=True)


def orders(rows: pd.DataFrame) -> dict[str, float]:
    """Return the AUROC of states, margin and, if all are known, whole sentences."""
    void, areas = (rows["side"] == "void").to_numpy(), dict[str, float]()
    for name, column in (("states", "own"), ("margin", "margin"), ("sentences", "sentence")):
        values = rows[column].to_numpy(float)
        if np.isfinite(values).all():
            areas[name] = float(auroc(void, values))
    return areas


def _floor(results: Results, model: str, dataset: str) -> str:
    rows = results.baselines
    rows = rows.loc[(rows["features"] == "noise") & (rows["analysis"] == "held_out") & (rows["model"] == model)]
    rows = rows.loc[(rows["source"] == dataset) & (rows["target"] == dataset)]
    noise = [(float(mean), float(spread)) for mean, spread in zip(rows["value"], rows["spread"], strict=True)]
    return f"\nnoise {noise[0][0]:.2f} ± {2 * noise[0][1]:.2f}" if noise else ""


def _scatter(ax: Axes, rows: pd.DataFrame) -> None:
    for line in (ax.axhline, ax.axvline):
        line(0, color=INK, linewidth=0.6, zorder=0.5)
    for side, colour in (("control", CONTROL), ("void", VOID)):
        for abstained, face in ((False, colour), (True, "white")):
            part = rows.loc[(rows["side"] == side) & rows["abstained_standard"].fillna(False).eq(abstained)]
            ax.scatter(part["margin"], part["own"], s=12, facecolors=face, edgecolors=colour, linewidths=0.7, zorder=3)


def lens(results: Results) -> Figure:
    """Return mean log-odds of abstaining from the state of each layer.

    States pass through the model's own final norm and head (logit lens); shown are means of voids (orange) and controls
    (blue), under both VQA prompts. Where the lines of a side separate, the prompt decides; at the last layer they are
    the output. The dotted line is even odds.
    """
    rows = results.lens
    if not len(rows):
        raise NotRun(why(results, "the paper has no such curves"))
    from matplotlib.ticker import MaxNLocator

    models, datasets = list(dict.fromkeys(rows["model"])), datasets_of(rows)
    with figure_style():
        figure = new_figure(PAGE_IN, 0.6 + 1.7 * len(models))
        axes = figure.subplots(len(models), len(datasets), squeeze=False, sharey="row")
        for line, model in zip(axes, models, strict=True):
            for ax, dataset in zip(line, datasets, strict=True):
                of = rows.loc[(rows["model"] == model) & (rows["dataset"] == dataset)].sort_values("layer")
                for prompt, style in _LINES.items():
                    part = of.loc[of["prompt"] == prompt]
                    for side, colour in (("controls", CONTROL), ("voids", VOID)):
                        ax.plot(part["layer"], part[side], style, color=colour, marker="o", markersize=2.4, linewidth=1)
                ax.axhline(0, color=INK, linewidth=0.6, linestyle=":", zorder=0.5)
                ax.xaxis.set_major_locator(MaxNLocator(integer=True))
                ax.set_title(f"{plain(str(model))[:20]}: {SHORT[dataset]}", size=7.5)
            line[0].set_ylabel("log-odds of abstaining")
        for ax in axes[-1]:
            ax.set_xlabel("layer (0: embeddings)")
        handles = [
            legend_key(f"{side}, {prompt}", colour, line=style)
            for side, colour in (("voids", VOID), ("controls", CONTROL))
            for prompt, style in _LINES.items()
        ]
        figure.legend(handles=handles, loc="outside lower center", ncols=4)
    return figure
