"""Draw pairs of clips (docs/spec.md 10): control frames above void frames."""

from __future__ import annotations

import textwrap
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from traps_pipeline.protocol.datasets import DATASETS
from traps_pipeline.report.writing import figure_style, new_figure
from traps_pipeline.scenes.parts.vision import before_occluder
from traps_pipeline.video.encode import decode

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

GAP = 8  # pixels between frames
FOOTER_IN = 0.2  # pixels for the times below a pair's frames


@dataclass(frozen=True)
class Layout:
    """The layout of a drawn pair: widths and heights in inches, size and length of its texts.

    The defaults fit the width of a printed page, on which no text may be smaller than 6 points. header: room for the
    words above its frames; letters: letters of a question per line; questions: maximum lines of each question; ids:
    whether its scenario is named; moments: frames per clip; columns: pairs side by side.
    """

    block: float = 1.98
    header: float = 0.86
    gap: float = 0.28
    letters: int = 41
    questions: int = 4
    ids: bool = False
    moments: int = 3
    columns: int = 3
    dpi: int = 300
    size: float = 6.5

    @property
    def small(self) -> float:
        """The font size of texts between and below frames."""
        return min(self.size, 7)


PAGE = Layout()


@dataclass(frozen=True)
class SampledClip:
    """A clip's frames at the drawn times, (moments, H, W, 3) uint8; from index `known` on, after its end."""

    frames: np.ndarray
    known: int
    end_s: float


def pairs_figure(items: pd.DataFrame, root: Path, layout: Layout = PAGE) -> Figure:
    """Draw each pair of ITEMS rows: control frames above void frames of equal times.

    Clips lie under root. Times after a truncated void's end are hatched. Raises DamagedClip.
    """
    pairs = whole_pairs(items)
    columns = min(layout.columns, len(pairs))
    with figure_style():
        blocks = [moments_of(pair, root, layout.moments) for pair in pairs]
        heights = [layout.block * ratio_of(control) + layout.header + FOOTER_IN for control, _, _ in blocks]
        rows = [max(heights[k : k + columns]) for k in range(0, len(heights), columns)]
        width, height = columns * (layout.block + layout.gap), sum(rows) + 0.1
        figure = new_figure(width, height, layout.dpi, layout=None)
        for k, (pair, block) in enumerate(zip(pairs, blocks, strict=True)):
            row, column = divmod(k, columns)
            left = column * (layout.block + layout.gap) + 0.8 * layout.gap
            top = height - 0.1 - sum(rows[:row]) - layout.header
            block_height = layout.block * ratio_of(block[0])
            axes = figure.add_axes(
                (left / width, (top - block_height) / height, layout.block / width, block_height / height)
            )
            draw_pair(axes, pair, *block, layout)
    return figure


def six_pairs(items: pd.DataFrame) -> pd.DataFrame:
    """Return ITEMS rows of six visual pairs, three per taxonomy, as in the paper.

    No two are of one sub-scenario, and their categories differ if possible; fewer if there are fewer sub-scenarios.
    """
    is_whole = items.groupby("pair_id")["side"].transform("nunique") == 2  # a held-out set asks one side of each
    visual = items.loc[items["dataset"].isin(["occlusion", "chaotic"]) & is_whole]
    pair_ids: list[str] = []
    for _, rows in visual.groupby("taxonomy", sort=True):
        pairs = rows.drop_duplicates("pair_id").sort_values(["category", "sub_scenario", "pair_id"])
        pairs = pairs.drop_duplicates("sub_scenario")
        firsts = [*pairs.drop_duplicates("category")["pair_id"], *pairs["pair_id"]]
        pair_ids += list(dict.fromkeys(firsts))[:3]
    return visual.loc[visual["pair_id"].isin(pair_ids)]


def whole_pairs(items: pd.DataFrame) -> list[pd.DataFrame]:
    """Return complete pairs as frames of two rows indexed by side, occlusion first."""
    complete_items = items.loc[items.groupby("pair_id")["side"].transform("nunique") == 2]
    complete_items = complete_items.assign(place=complete_items["dataset"].map(DATASETS.index)).sort_values(
        ["place", "sub_scenario", "pair_id"]
    )
    return [pair.set_index("side") for _, pair in complete_items.groupby("pair_id", sort=False)]


def moments_of(pair: pd.DataFrame, root: Path, moments: int) -> tuple[SampledClip, SampledClip, np.ndarray]:
    """Return a pair's control and void, sampled at the control's informative times, and these times (s)."""
    control, times_s = decode(root / str(pair.at["control", "clip"]))
    void, void_at = decode(root / str(pair.at["void", "clip"]))
    times = telling_times(control, times_s, moments)
    return _sample_clip(control, times_s, times), _sample_clip(void, void_at, times), times


def telling_times(frames: np.ndarray, at: np.ndarray, moments: int) -> np.ndarray:
    """Return the informative ones (moments,) of a clip's times `at`: evenly spread while its scene is visible.

    If an occluder closes the clip (frames, RGB), the last one is just before it, and of four or more the clip's last
    time is also included.
    """
    visible_frames = len(before_occluder(frames))
    closed_indices = [len(at) - 1] if visible_frames < len(at) and moments > 3 else []
    return at[
        np.append(np.linspace(0, visible_frames - 1, moments - len(closed_indices)).round(), closed_indices).astype(int)
    ]


def _sample_clip(frames: np.ndarray, at: np.ndarray, times: np.ndarray) -> SampledClip:
    """Return the frames nearest to the times; a clip ends a frame after its last one."""
    step = float(at[1] - at[0]) if len(at) > 1 else 0.0
    end = float(at[-1]) + step
    nearest = np.abs(at[:, None] - times).argmin(axis=0)
    return SampledClip(frames[nearest], int((times < end - step / 4).sum()), end)


def ratio_of(clip: SampledClip) -> float:
    """Return the aspect ratio (height over width) of a pair's block of frames."""
    moments, height, width, _ = clip.frames.shape
    return (2 * height + GAP) / (moments * width + (moments - 1) * GAP)


def draw_pair(
    axes: Axes, pair: pd.DataFrame, control: SampledClip, void: SampledClip, times: np.ndarray, layout: Layout
) -> None:
    """Draw the result of `moments_of`: timed frames below the texts of `pair`."""
    moments, height, width, _ = control.frames.shape
    canvas = np.full((2 * height + GAP, moments * width + (moments - 1) * GAP, 3), 255, np.uint8)
    for row, (side, clip) in enumerate({"control": control, "void": void}.items()):
        top = row * (height + GAP)
        axes.text(-GAP, top + height / 2, side, rotation=90, ha="right", va="center", size=layout.size, weight="bold")
        for k in range(moments):
            left = k * (width + GAP)
            if k < clip.known:
                canvas[top : top + height, left : left + width] = _fit(clip.frames[k], height, width)
                continue
            _hatch(axes, (left, top, width - 1, height - 1), f"cut at {clip.end_s:.1f} s", layout.small)
    axes.imshow(canvas, interpolation="antialiased")
    for k, time in enumerate(times):
        place = (k * (width + GAP) + width / 2, 2 * height + 2 * GAP)
        axes.text(*place, f"{time:.1f} s", ha="center", va="top", size=layout.small, color="#667085")
    axes.set_axis_off()
    _plot_header(axes, pair, layout)


def _hatch(axes: Axes, box: tuple[int, int, int, int], words: str, size: float) -> None:
    """Hatch a box (left, top, width, height) that has no frame, and write in its middle why."""
    from matplotlib.patches import Rectangle

    left, top, width, height = box
    look: dict[str, Any] = {"hatch": "////", "facecolor": "#f2f4f7", "edgecolor": "#c3c9d2", "linewidth": 0.5}
    axes.add_patch(Rectangle((left, top), width, height, **look))
    look = {"bbox": {"facecolor": "white", "edgecolor": "none", "pad": 2}, "ha": "center", "va": "center"}
    axes.text(left + width / 2, top + height / 2, words, size=size, **look)


def _plot_header(axes: Axes, pair: pd.DataFrame, layout: Layout) -> None:
    """Draw scenario and ground truth in bold, and the questions below them."""
    question_of = {side: str(pair.at[side, "question"]) for side in ("control", "void")}
    is_same = question_of["control"] == question_of["void"]
    questions = (
        [question_of["control"]] if is_same else [f"{side}: {question}" for side, question in question_of.items()]
    )
    wrap_options = {"max_lines": layout.questions, "placeholder": " …"}
    lines = [line for question in questions for line in textwrap.wrap(question, layout.letters, **wrap_options)]
    truth = pair.at["control", "ground_truth"]
    scenario, sub_scenario, dataset = (pair.at["control", c] for c in ("scenario_id", "sub_scenario", "dataset"))
    title = f"{sub_scenario} ({dataset})"
    if layout.ids:
        title = f"{scenario}   {title}   ground truth: {truth}"
    else:  # in a narrow block the truth has its own line
        lines.append(f"ground truth: {truth}")
    place: dict[str, Any] = {
        "xycoords": "axes fraction",
        "textcoords": "offset points",
        "va": "bottom",
        "parse_math": False,
    }
    axes.annotate("\n".join(lines), (0, 1), (0, 5), size=layout.size - 0.5, linespacing=1.15, **place)
    axes.annotate(
        title, (0, 1), (0, 9 + 1.25 * layout.size * len(lines)), size=layout.size + 0.5, weight="bold", **place
    )


def _fit(frame: np.ndarray, height: int, width: int) -> np.ndarray:
    """Return the frame resized to the control's size, so that clips align."""
    if frame.shape[:2] == (height, width):
        return frame
    import cv2

    return cv2.resize(frame, (width, height), interpolation=cv2.INTER_AREA)
