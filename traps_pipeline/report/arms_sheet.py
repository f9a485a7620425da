"""Draw contact sheets of one scenario: the clips of two events, or every arm's, and the right answers."""

from __future__ import annotations

import textwrap
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from traps_pipeline.protocol.datasets import ARMS, OCCLUDER_DOSES, OCCLUDER_LOOKS, TWO_EVENTS
from traps_pipeline.protocol.two_events import CLIPS, LANES
from traps_pipeline.report.contact_sheet import SampledClip, hatch, sample_clip, telling_times
from traps_pipeline.report.writing import figure_style, new_figure
from traps_pipeline.video.encode import decode

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

MOMENTS = 6  # frames per row
FRAME_IN, WORDS_IN, GAP_IN, HEAD_IN, LINE_IN = 1.5, 2.9, 0.06, 0.8, 0.18
SOFT = "#667085"
_SHEETS = {"arms": ARMS, "occluders": (*OCCLUDER_LOOKS, *OCCLUDER_DOSES)}


@dataclass(frozen=True)
class Row:
    """A clip on the sheet with its captions."""

    name: str
    right: str
    clip: SampledClip


def arms_sheets(items: pd.DataFrame, arms: pd.DataFrame, root: Path) -> dict[str, Figure]:
    """Return the figures `two_events`, `arms_<taxonomy>` and `occluders_occlusion`.

    They show the first scenario of two events, that with the most arms, and that with the most looks. items: ITEMS rows
    of the pairs; arms: ARMS rows; clips lie under root. Raises DamagedClip.
    """
    pairs = items.loc[items["dataset"].isin(["occlusion", "chaotic"])]
    figures = _two_events_sheet(arms.loc[arms["arm"] == TWO_EVENTS].sort_values("scenario_id"), root)
    for (name, arm_names), (taxonomy, sides) in product(_SHEETS.items(), pairs.groupby("taxonomy", sort=True)):
        filmed = arms.loc[arms["clip"].notna() & arms["arm"].isin(arm_names)]
        arms_shown = filmed.loc[filmed["scenario_id"].isin(sides["scenario_id"])]
        if len(arms_shown):
            counts = arms_shown.groupby("scenario_id")["arm"].nunique().sort_index()
            scenario = str(counts.idxmax())
            control = sides.loc[(sides["scenario_id"] == scenario) & (sides["side"] == "control"), "clip"]
            times = _moments(root / str(control.iloc[0]))
            rows = list(_rows(sides, arms_shown, scenario, root, times))
            question = str(sides.loc[sides["scenario_id"] == scenario, "question"].iloc[0])
            figures[f"{name}_{taxonomy}"] = _sheet(scenario, [question], rows, times)
    return figures


def _two_events_sheet(rows: pd.DataFrame, root: Path) -> dict[str, Figure]:
    """Return the sheet of the first scenario's four clips, by name; none without rows."""
    if not len(rows):
        return {}
    scenario = str(rows["scenario_id"].iloc[0])
    row_of = {str(row["item"]): row for row in rows.loc[rows["scenario_id"] == scenario].to_dict("records")}
    clips = {name: root / str(row_of[f"{LANES[0]}.{name}"]["clip"]) for name in CLIPS}
    times, sheet = _moments(clips["neither"]), list[Row]()
    for name, clip in clips.items():
        asked = {lane: row_of[f"{lane}.{name}"] for lane in LANES}
        right = [f"{lane}: {_right(row)}" for lane, row in asked.items()]
        sheet.append(Row(f"{name} hidden", "\n".join(right), sample_clip(*decode(clip), times)))
    questions = [f"{lane.capitalize()}: {row_of[f'{lane}.neither']['question']}" for lane in LANES]
    return {TWO_EVENTS: _sheet(scenario, questions, sheet, times)}


def _moments(clip: Path) -> np.ndarray:
    """Return informative times (MOMENTS,) of a control, in seconds."""
    return telling_times(*decode(clip), MOMENTS)


def _rows(sides: pd.DataFrame, arms: pd.DataFrame, scenario: str, root: Path, times: np.ndarray) -> Iterator[Row]:
    """Yield control and void, then arms to be answered, then arms to be abstained on."""
    pair = sides.loc[sides["scenario_id"] == scenario].sort_values("side")
    scenario_arms = arms.loc[arms["scenario_id"] == scenario].sort_values(["side", "arm"])
    for row in (*pair.to_dict("records"), *scenario_arms.to_dict("records")):
        frames, times_s = decode(root / str(row["clip"]))
        truth = row["ground_truth"]
        name = str(row.get("arm") or row["side"])
        right = f"no void, {truth} shows through" if name in OCCLUDER_DOSES else _right(row)
        yield Row(name, right, sample_clip(frames, times_s, times))


def _right(row: Mapping[Any, Any]) -> str:
    return "must be abstained on" if row["side"] == "void" else f"must be answered: {row['ground_truth']}"


def _sheet(scenario: str, questions: list[str], rows: list[Row], times: np.ndarray) -> Figure:
    """Draw one row per clip: its caption, then frames at the control's times. Frames after a clip's end are hatched."""
    _, frame_height, frame_width, _ = rows[0].clip.frames.shape
    row_in = FRAME_IN * frame_height / frame_width + GAP_IN
    head_in = HEAD_IN + LINE_IN * (len(questions) - 1)
    width, height = WORDS_IN + MOMENTS * (FRAME_IN + GAP_IN), head_in + len(rows) * row_in
    with figure_style():
        figure = new_figure(width, height, 150, layout=None)
        figure.text(0.1 / width, 1 - 0.1 / height, scenario, size=11, weight="bold", va="top", parse_math=False)
        for line, question in enumerate(questions):
            place = (0.1 / width, 1 - (0.34 + LINE_IN * line) / height)
            words = textwrap.shorten(question, 150, placeholder=" …")
            figure.text(*place, words, size=9, va="top", parse_math=False)
        for m, time in enumerate(times):
            centre = WORDS_IN + m * (FRAME_IN + GAP_IN) + FRAME_IN / 2
            place = (centre / width, 1 - (head_in - 0.05) / height)
            figure.text(*place, f"{time:.1f} s", size=7.5, color=SOFT, ha="center", va="bottom")
        for k, row in enumerate(rows):
            top = height - head_in - k * row_in
            look: dict[str, Any] = {"va": "top", "linespacing": 1.3, "parse_math": False}
            name = row.name.replace("_", " ")
            figure.text(0.1 / width, (top - 0.2) / height, name, size=9, weight="bold", **look)
            figure.text(0.1 / width, (top - 0.42) / height, row.right, size=7.5, color=SOFT, **look)
            for m in range(MOMENTS):
                left = WORDS_IN + m * (FRAME_IN + GAP_IN)
                bottom = height - head_in - (k + 1) * row_in + GAP_IN
                box = (left / width, bottom / height, FRAME_IN / width, (row_in - GAP_IN) / height)
                _draw_frame(figure.add_axes(box), row.clip, m)
    return figure


def _draw_frame(axes: Axes, clip: SampledClip, moment: int) -> None:
    axes.set_axis_off()
    if moment < clip.known:
        axes.imshow(clip.frames[moment], interpolation="antialiased", aspect="auto")
        return
    hatch(axes, (0, 0, 1, 1), f"ends at {clip.end_s:.1f} s", 7, transform=axes.transAxes)
