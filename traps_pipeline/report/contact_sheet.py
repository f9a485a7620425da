"""Contact sheets: frames of controls above frames of voids, for a reviewer's first look (docs/spec.md 10)."""

from __future__ import annotations

import textwrap
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from traps_pipeline.protocol.datasets import DATASETS
from traps_pipeline.report.writing import figure_bytes, figure_style, new_figure
from traps_pipeline.scenes.parts.vision import before_panel
from traps_pipeline.video.encode import decode

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

MOMENTS = 4  # frames per clip
GAP = 8  # pixels between frames
FOOTER_IN = 0.2  # room for the times below a pair's frames
MOST_PAIRS = 80


@dataclass(frozen=True)
class Layout:
    """Widths (inches), dots per inch, and the number of letters of a question that fit on a line of a pair."""

    block: float = 6.4
    header: float = 0.95  # room for the words above a pair's frames
    gap: float = 0.5
    dpi: int = 150
    size: float = 8
    letters: int = 108
    questions: int = 2  # lines of each question at most
    ids: bool = True  # whether scenarios are named
    moments: int = MOMENTS  # frames per clip


# For a screen, and for the width of a printed page, on which no text may be smaller than 6 points.
SCREEN = Layout()
PAGE = Layout(
    block=1.98, header=0.86, gap=0.28, dpi=300, size=6.5, letters=41, questions=4, ids=False, moments=3
)  # fmt: skip


@dataclass(frozen=True)
class SampledClip:
    """Frames (moments, H, W, 3) uint8 at the control's times; those with index `known` or more lie after the clip's end
    (s)."""

    frames: np.ndarray
    known: int
    end_s: float


def contact_sheet(items: pd.DataFrame, root: Path, per_family: int | None = 1, columns: int = 2) -> bytes:
    """The PNG of `pairs_figure`."""
    return figure_bytes(pairs_figure(items, root, per_family, columns))


def pairs_figure(
    items: pd.DataFrame, root: Path, per_family: int | None = 1, columns: int = 2, layout: Layout = SCREEN
) -> Figure:
    """For each pair, a row of control frames above a row of void frames at the same times, from start to end.

    items are ITEMS rows with both sides of each pair, and clips lie under root. Of every dataset and sub-scenario the
    first `per_family` pairs by id are shown, or all if it is None. Times after a truncated void's end are hatched.
    Raises ValueError when there is no whole pair or more than 80, and DamagedClip when a clip cannot be decoded.
    """
    pairs = chosen_pairs(items, per_family)
    columns = min(columns, len(pairs))
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
            tall = layout.block * ratio_of(block[0])
            axes = figure.add_axes((left / width, (top - tall) / height, layout.block / width, tall / height))
            draw_pair(axes, pair, *block, layout)
    return figure


def six_pairs(items: pd.DataFrame) -> pd.DataFrame:
    """ITEMS rows of six visual pairs for a figure like the paper's: three of each taxonomy, no two of one sub-scenario
    and of different categories where possible; fewer if there are fewer sub-scenarios."""
    visual = items.loc[items["dataset"].isin(["occlusion", "chaotic"])]
    chosen: list[str] = []
    for _, rows in visual.groupby("taxonomy", sort=True):
        pairs = rows.drop_duplicates("pair_id").sort_values(["category", "sub_scenario", "pair_id"])
        pairs = pairs.drop_duplicates("sub_scenario")
        firsts = [*pairs.drop_duplicates("category")["pair_id"], *pairs["pair_id"]]
        chosen += list(dict.fromkeys(firsts))[:3]
    return visual.loc[visual["pair_id"].isin(chosen)]


def chosen_pairs(items: pd.DataFrame, per_family: int | None) -> list[pd.DataFrame]:
    """The pairs to show, as frames of two rows indexed by side. Raises ValueError for none or more than 80."""
    whole = items.loc[items.groupby("pair_id")["side"].transform("nunique") == 2].sort_values(
        by=["dataset", "sub_scenario", "pair_id"], key=_in_order
    )
    firsts = whole.drop_duplicates("pair_id").groupby(["dataset", "sub_scenario"], sort=False)["pair_id"]
    ids = list(firsts.head(per_family) if per_family is not None else whole["pair_id"].unique())
    if not 0 < len(ids) <= MOST_PAIRS:
        raise ValueError(
            f"a contact sheet shows 1 to {MOST_PAIRS} pairs, not {len(ids)}: pass other items or a smaller per_family"
        )
    by_pair = dict(list(whole[whole["pair_id"].isin(ids)].groupby("pair_id")))
    return [by_pair[pair_id].set_index("side") for pair_id in ids]


def _in_order(values: pd.Series) -> pd.Series:
    """Datasets in the benchmark's order, occlusion first; other columns as they are."""
    return values.map(DATASETS.index) if values.name == "dataset" else values


def moments_of(pair: pd.DataFrame, root: Path, moments: int) -> tuple[SampledClip, SampledClip, np.ndarray]:
    """Control, void and the times (moments,) in seconds, from the control's first frame to its last. Of a control that
    a panel closes they end with the last frame that shows its outcome, and, where there is room, the very last one."""
    control, at = decode(root / str(pair.at["control", "clip"]))
    void, void_at = decode(root / str(pair.at["void", "clip"]))
    times = telling_times(control, at, moments)
    return sampled(control, at, times), sampled(void, void_at, times), times


def telling_times(frames: np.ndarray, at: np.ndarray, moments: int) -> np.ndarray:
    """Times (moments,) from the first to the last of a clip's, `at`; where a panel closes the clip (frames, RGB), to
    the last one before it comes, and if there are four or more, the clip's last one too."""
    seen = len(before_panel(frames))
    closed = [len(at) - 1] if seen < len(at) and moments > 3 else []
    return at[np.append(np.linspace(0, seen - 1, moments - len(closed)).round(), closed).astype(int)]


def sampled(frames: np.ndarray, at: np.ndarray, times: np.ndarray) -> SampledClip:
    """The frames nearest to the times; a clip ends one frame after its last frame begins."""
    step = float(at[1] - at[0]) if len(at) > 1 else 0.0
    end = float(at[-1]) + step
    nearest = np.abs(at[:, None] - times).argmin(axis=0)
    return SampledClip(frames[nearest], int((times < end - step / 4).sum()), end)


def ratio_of(clip: SampledClip) -> float:
    """Height over width of a pair's block of frames."""
    moments, height, width, _ = clip.frames.shape
    return (2 * height + GAP) / (moments * width + (moments - 1) * GAP)


def draw_pair(
    axes: Axes, pair: pd.DataFrame, control: SampledClip, void: SampledClip, times: np.ndarray, layout: Layout
) -> None:
    """Draw what `moments_of` gives of a pair: its frames with their times, below the words of `pair`."""
    from matplotlib.patches import Rectangle

    moments, height, width, _ = control.frames.shape
    canvas = np.full((2 * height + GAP, moments * width + (moments - 1) * GAP, 3), 255, np.uint8)
    for row, (side, clip) in enumerate({"control": control, "void": void}.items()):
        top = row * (height + GAP)
        axes.text(-GAP, top + height / 2, side, rotation=90, ha="right", va="center", size=layout.size, weight="bold")
        for k in range(moments):
            left = k * (width + GAP)
            if k < clip.known:
                canvas[top : top + height, left : left + width] = _fitted(clip.frames[k], height, width)
                continue
            hatch = {"hatch": "////", "facecolor": "#f2f4f7", "edgecolor": "#c3c9d2", "linewidth": 0.5}
            axes.add_patch(Rectangle((left, top), width - 1, height - 1, **hatch))
            box = {"facecolor": "white", "edgecolor": "none", "pad": 2}
            axes.text(
                left + width / 2,
                top + height / 2,
                f"cut at {clip.end_s:.1f} s",
                ha="center",
                va="center",
                size=min(layout.size, 7),
                bbox=box,
            )
    axes.imshow(canvas, interpolation="antialiased")
    for k, time in enumerate(times):
        axes.text(
            k * (width + GAP) + width / 2,
            2 * height + 2 * GAP,
            f"{time:.1f} s",
            ha="center",
            va="top",
            size=min(layout.size, 7),
            color="#667085",
        )
    axes.set_axis_off()
    _draw_header(axes, pair, layout)


def _draw_header(axes: Axes, pair: pd.DataFrame, layout: Layout) -> None:
    """Draw scenario and ground truth in bold (without ids the truth below), and the question below them; also the
    void's question if it differs."""
    by_side = {side: str(pair.at[side, "question"]) for side in ("control", "void")}
    same = by_side["control"] == by_side["void"]
    questions = [by_side["control"]] if same else [f"{side}: {question}" for side, question in by_side.items()]
    fit = {"max_lines": layout.questions, "placeholder": " …"}
    lines = [line for question in questions for line in textwrap.wrap(question, layout.letters, **fit)]
    truth = pair.at["control", "ground_truth"]
    scenario, sub_scenario, dataset = (pair.at["control", c] for c in ("scenario_id", "sub_scenario", "dataset"))
    title = f"{sub_scenario} ({dataset})"
    if layout.ids:
        title = f"{scenario}   {title}   ground truth: {truth}"
    else:  # a narrow block has the truth on a line of its own
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


def _fitted(frame: np.ndarray, height: int, width: int) -> np.ndarray:
    """The frame resized to the control's size, so that a void clip of another size does not break the sheet."""
    if frame.shape[:2] == (height, width):
        return frame
    import cv2

    return cv2.resize(frame, (width, height), interpolation=cv2.INTER_AREA)
