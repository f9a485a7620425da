"""Plot what is claimed of a model, states among their rivals, and the margin by layer."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from traps_pipeline.mechanism.control_rows import MODEL, RESIDUAL, STATES
from traps_pipeline.protocol.datasets import SHORT
from traps_pipeline.protocol.regimes import PROMPTING
from traps_pipeline.report.figures.looks import legend_key
from traps_pipeline.report.result_frames import Results, datasets_of
from traps_pipeline.report.tables.claims import CLAIMS, RANDOM, SUBJECT_NAMES, SUBJECTS, Claim, claim_frame
from traps_pipeline.report.tables.control_reports import OTHER_GATES, lead_rows
from traps_pipeline.report.tables.inside_columns import why_not
from traps_pipeline.report.terms import TITLE_OF
from traps_pipeline.report.writing import (
    COLOURS,
    GRID,
    INK,
    PAGE_IN,
    SOFT,
    NotRun,
    figure_style,
    fraction,
    new_figure,
    plain,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

CONTROL, VOID = COLOURS[0], COLOURS[1]
HOLDS, FAILS = "#b7e1cd", "#fbc9a0"
CLAIM_WORDS = (
    "void: a question that its clip cannot answer: the outcome is hidden (visual), or there is none (ill-posed). "
    "control: its answerable twin. n: items, clips or pairs.\n"
    "states (activations) tell voids: a linear probe scores them above controls. rivals, subtracted where grey: words, "
    "pixels, length, output. guided prompt: allows abstention.\n"
    "random: the same network, random weights, two seeds. placebo: answerable look-alikes as voids. "
    "–: no such control. pocket: 1.1 M parameters, trained by this project, no product.\n"
    "no gap: its twin, which abstains on all voids under every prompt. It knows voids too, and so counts only where a "
    "gap is claimed: of states and answers, or of prompts."
)
_LINES = dict(zip(PROMPTING, ("-", "--"), strict=True))


def claims(results: Results) -> Figure:
    """Return which claims hold of each model, and in which of its controls the same holds.

    Below each claim are its measure, the bound that it must reach in the model, and the number of items. A claim is
    held if the model reaches the bound and no framed control does. Grey numbers do not count: rivals that a lead is
    over, and a control that may hold what is claimed too. constant: all states are equal.
    """
    rows = claim_frame(results)
    if not len(rows):
        raise NotRun(why_not(results, "the paper has no such controls"))
    models, by_name = list(dict.fromkeys(rows["model"])), {claim.name: claim for claim in CLAIMS}
    with figure_style():
        figure = new_figure(PAGE_IN, 0.9 + (0.27 * len(CLAIMS) + 0.4) * len(models))
        panels = figure.subplots(len(models), 1, squeeze=False)[:, 0]
        for ax, model in zip(panels, models, strict=True):
            part = rows.loc[rows["model"] == model].to_dict("records")
            for y, row in enumerate(part):
                _claim_row(ax, y, row, by_name[row["claim"]])
            places = np.arange(len(part))
            ax.set_yticks(places - 0.17, [by_name[row["claim"]].says for row in part], size=6.3, color=INK)
            measures = [f"{by_name[row['claim']].holds_if}{_n(row['n'])}" for row in part]
            ax.set_yticks(places + 0.22, measures, minor=True, size=5.4, color=SOFT)
            heads = [SUBJECT_NAMES[name].replace(" ", "\n", 1) for name in SUBJECTS]
            ax.set_xticks(range(len(heads)), heads, size=6)
            ax.xaxis.tick_top()
            ax.set(xlim=(-0.5, len(heads) + 1.9), ylim=(len(part) - 0.5, -0.5))
            ax.tick_params(length=0, which="both")
            ax.spines[:].set_visible(False)
            n_held = sum(row["verdict"] == "holds" for row in part)
            title = f"{n_held} of {len(part)} claims hold in the model and in no control that counts"
            ax.set_title(f"{plain(str(model))[:40]}: {title}", size=7.5, x=-0.55, ha="left")
        key: dict[str, Any] = {"title": CLAIM_WORDS, "title_fontsize": 5.4, "fontsize": 6, "alignment": "left"}
        figure.legend(handles=_claim_keys(), loc="outside lower left", ncols=4, handlelength=1.2, **key)
    return figure


def _n(n: float) -> str:
    return f";  n = {n:.0f}" if n == n else ""


def _claim_keys() -> list[Any]:
    from matplotlib.patches import Patch

    return [
        Patch(facecolor=HOLDS, edgecolor=INK, label="the model reaches the bound (≥)"),
        Patch(facecolor="white", edgecolor=INK, label="a control stays below it, as it must"),
        Patch(facecolor=FAILS, edgecolor=INK, label="why a claim fails"),
        Patch(facecolor="none", edgecolor="none", label="grey, no frame: does not count"),
    ]


def _claim_row(ax: Axes, y: int, row: Mapping[Any, Any], claim: Claim) -> None:
    from matplotlib.patches import Rectangle

    for x, subject in enumerate(SUBJECTS):
        value = row[f"in_{subject}"]
        metric = np.nan if value is None else float(value)
        is_known, reaches = bool(np.isfinite(metric)), metric >= claim.bound
        counts = subject == MODEL or subject in claim.fails_in
        if counts and is_known:
            holds = HOLDS if subject == MODEL else "white"
            face = holds if reaches == (subject == MODEL) else FAILS
            ax.add_patch(Rectangle((x - 0.44, y - 0.4), 0.88, 0.8, facecolor=face, edgecolor=INK, linewidth=0.7))
        look: dict[str, Any] = {"size": 6.5 if is_known else 5, "color": INK if counts and is_known else SOFT}
        text = fraction(metric, 2) if is_known else row[f"why_{subject}"]
        ax.text(x, y, text, ha="center", va="center_baseline", **look)
    held = row["verdict"] == "holds"
    ax.text(len(SUBJECTS) - 0.4, y, row["verdict"][:60], va="center_baseline", size=6.5, color=INK if held else SOFT,
            weight="bold" if held else "normal")  # fmt: skip


def leads(results: Results) -> Figure:
    """Return how well states tell each dataset's voids from controls, among their rivals.

    AUROC of probes of the other datasets. Black: the model's states, with their 95 % interval; hollow: without what is
    linear in words, pixels and length. Coloured: the same probe on what anybody sees, and on the model's output. Grey:
    states of the same network with random weights; crosses: answerable items in the place of the voids. The model knows
    of a dataset what no rival tells only where the black dot is right of all other marks.
    """
    rows = lead_rows(results)
    if not len(rows):
        raise NotRun(why_not(results, "the paper has no such rivals"))
    models, datasets = list(dict.fromkeys(rows["model"])), datasets_of(rows.assign(dataset=rows["target"]))
    rivals = [name for name in OTHER_GATES if name in rows and name not in ("first frame", "time stamps")]
    with figure_style():
        figure = new_figure(PAGE_IN, 0.8 + 1.5 * len(models))
        panels = figure.subplots(len(models), 1, squeeze=False)[:, 0]
        for ax, model in zip(panels, models, strict=True):
            for y, dataset in enumerate(datasets):
                part = rows.loc[(rows["model"] == model) & (rows["target"] == dataset)]
                for row in part.to_dict("records"):
                    _lead_marks(ax, y, row, rivals)
            ax.axvline(0.5, color=GRID, linewidth=0.8, zorder=0)
            ax.set_yticks(range(len(datasets)), [TITLE_OF[name].lower() for name in datasets])
            ax.set(xlim=(0, 1.03), ylim=(len(datasets) - 0.4, -0.6), title=plain(str(model))[:40])
        panels[-1].set_xlabel("AUROC of voids against controls (0.5: chance)")
        handles = [
            legend_key("states", INK, "o", "-"),
            legend_key("states, residual", INK, "o", markerfacecolor="white"),
        ]
        handles += [legend_key(name, colour, marker) for name, colour, marker in _rival_looks(rivals)]
        handles += [legend_key("random weights", SOFT, "v"), legend_key("placebo", VOID, "x")]
        figure.legend(handles=handles, loc="outside lower center", ncols=4)
    return figure


def _rival_looks(rivals: Sequence[str]) -> list[tuple[str, str, str]]:
    return [*zip(rivals, COLOURS, ("s", "^", "D", "P", "*"), strict=False)]


def _lead_marks(ax: Axes, y: int, row: Mapping[Any, Any], rivals: Sequence[str]) -> None:
    if row["subject"] != MODEL:
        marker, colour, dy = ("v", SOFT, 0.24) if row["subject"] in RANDOM else ("x", VOID, 0.34)
        ax.plot(row[STATES], y + dy, marker, color=colour, markersize=4, clip_on=False)
        return
    ax.plot([row["low"], row["high"]], [y - 0.25, y - 0.25], color=INK, linewidth=0.9)
    ax.plot(row[RESIDUAL], y - 0.1, "o", color=INK, markerfacecolor="white", markersize=4.5, clip_on=False)
    for name, colour, marker in _rival_looks(rivals):
        ax.plot(row[name], y + 0.08, marker, color=colour, markersize=4, clip_on=False, zorder=3)
    ax.plot(row[STATES], y - 0.25, "o", color=INK, markersize=5, clip_on=False, zorder=4)


def lens(results: Results) -> Figure:
    """Return mean log-odds of abstaining from the state of each layer.

    States pass through the model's own final norm and head (logit lens); shown are means of voids (orange) and controls
    (blue), under both VQA prompts. Where the lines of a side separate, the prompt decides; at the last layer they are
    the output. The dotted line is even odds.
    """
    rows = results.lens
    if not len(rows):
        raise NotRun(why_not(results, "the paper has no such curves"))
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
