"""Draws pictures of README and docs: a moving pair and two pairs on a sheet, from clips of a study, and the finding,
from the paper's numbers.

    python tools/readme_pictures.py .workspaces/demo        # after `make demo`

Writes docs/moving_pair.gif, docs/two_pairs.png and docs/finding.png; the same clips and numbers give the same bytes.
"""

from __future__ import annotations

import sys
import textwrap
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from traps_pipeline.report.contact_sheet import Layout, pairs_figure
from traps_pipeline.report.figures.looks import family_colour, model_family
from traps_pipeline.report.writing import INK, SOFT, figure_bytes, figure_style, new_figure
from traps_pipeline.scoring.published import published_overall
from traps_pipeline.storage.benchmark_tables import ITEMS
from traps_pipeline.storage.workspace import Workspace
from traps_pipeline.video.encode import decode

DOCS = Path(__file__).resolve().parents[1] / "docs"
SCENARIO, SHOWN_S = "hidden_drop-0001", 3.1  # then an occluder closes the control
SHEET = Layout(6.4, 0.95, 0.5, letters=108, questions=2, ids=True, moments=4, columns=2, dpi=150, size=8)
ON_SHEET = ("tumbling_dice-0006", "domino_chain-0005")
HOLD_MS = 2600  # the last frame, with the answers
WIDTH, HEIGHT, HEAD, FOOT, GAP = 420, 315, 100, 62, 8  # px: a clip, the texts above and below it, between the clips
MAX_BYTES = 1_500_000
NEARLY_WHITE = 245


def moving_pair(workspace: Workspace) -> bytes:
    """Return an animated GIF of a pair: control and void side by side, and at the end what may be answered."""
    items = workspace.tables.read_all(ITEMS).query("scenario_id == @SCENARIO and dataset == 'occlusion'")
    control, void = (items.loc[items["side"] == side].iloc[0] for side in ("control", "void"))
    (left, times), (right, _) = (decode(workspace.resolve(row["clip"])) for row in (control, void))
    count = int(np.searchsorted(times, SHOWN_S))
    answers = f"control: {control['ground_truth']}", "void: nobody can know"
    frames = [
        _frame((left[at], right[at]), control["question"], answers if at == count - 1 else None) for at in range(count)
    ]
    palette = _beside([frames[0], frames[count // 4], frames[-1]]).quantize(256, kmeans=4)  # of all that is seen
    colours = np.reshape(palette.getpalette() or [], (-1, 3))
    colours[(colours > NEARLY_WHITE).all(axis=1)] = 255  # the ground is the page's
    palette.putpalette(colours.ravel().tolist())
    small = [frame.quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames]
    step = round(1000 * float(times[1] - times[0]))
    out = DOCS / "moving_pair.gif"
    durations = [step] * (count - 1) + [HOLD_MS]
    small[0].save(out, save_all=True, append_images=small[1:], duration=durations, loop=0, optimize=True)
    return out.read_bytes()


def _frame(pair: Sequence[np.ndarray], question: str, answers: tuple[str, str] | None) -> Image.Image:
    frame = Image.new("RGB", (2 * WIDTH + GAP, HEAD + HEIGHT + FOOT), "white")
    draw = ImageDraw.Draw(frame)
    draw.multiline_text((0, 4), textwrap.fill(question, 56), fill=INK, font=_font(22, bold=True))
    for at, (picture, said) in enumerate(zip(pair, ("the outcome can be seen", "an occluder hides it"), strict=True)):
        x = at * (WIDTH + GAP)
        draw.text((x, 68), f"{('control', 'void')[at]}: {said}", fill=SOFT, font=_font(21))
        frame.paste(Image.fromarray(picture).resize((WIDTH, HEIGHT), Image.Resampling.LANCZOS), (x, HEAD))
        if answers is not None:
            draw.text((x, HEAD + HEIGHT + 12), answers[at].partition(": ")[2], fill=INK, font=_font(30, bold=True))
    return frame


def _beside(frames: Sequence[Image.Image]) -> Image.Image:
    return Image.fromarray(np.concatenate([np.asarray(frame) for frame in frames], axis=1))


def _font(size: int, *, bold: bool = False) -> ImageFont.FreeTypeFont:
    """Return the font of all figures, which matplotlib brings along."""
    from matplotlib import get_data_path

    return ImageFont.truetype(f"{get_data_path()}/fonts/ttf/DejaVuSans{'-Bold' if bold else ''}.ttf", size)


def finding() -> bytes:
    """Return a PNG: how often each of the paper's models abstains on voids, asked plainly and told not to guess."""
    shares = published_overall().pivot(index="model", columns="regime", values="abs_rec").mul(100)
    shares = shares.loc[:, ["standard", "guided"]].dropna().sort_values("standard")
    with figure_style():
        figure = new_figure(4.6, 3.6, dpi=220)
        axes = figure.add_subplot()
        for y, (model, row) in enumerate(shares.iterrows()):
            colour = family_colour(model_family(str(model)))
            axes.plot([row["standard"], row["guided"]], [y, y], color=colour, linewidth=1.2, zorder=1)
            axes.scatter(row["standard"], y, s=26, facecolors="white", edgecolors=colour, zorder=2)
            axes.scatter(row["guided"], y, s=26, color=colour, zorder=2)
        axes.set_yticks(range(len(shares)), [str(model) for model in shares.index])
        axes.set_xlim(0, 100)
        axes.set_xlabel("share of voids abstained on, %\nhollow: asked plainly; filled: told not to guess")
        axes.spines[["top", "right"]].set_visible(False)
        axes.grid(axis="x", color="#e4e7ec", linewidth=0.6)
        axes.set_axisbelow(True)
    return figure_bytes(figure)


def main() -> None:
    """Draw all, from the workspace that the first argument names."""
    (root,) = map(Path, sys.argv[1:])
    workspace = Workspace.open(root)
    moving = moving_pair(workspace)
    if len(moving) > MAX_BYTES:
        raise SystemExit(f"docs/moving_pair.gif has {len(moving)} bytes, more than {MAX_BYTES}; shorten SHOWN_S")
    items = workspace.tables.read_all(ITEMS).query("scenario_id in @ON_SHEET and dataset in ('chaotic', 'occlusion')")
    (DOCS / "two_pairs.png").write_bytes(figure_bytes(pairs_figure(items, workspace.root, SHEET)))
    (DOCS / "finding.png").write_bytes(finding())
    print(f"docs/moving_pair.gif: {len(moving)} bytes; docs/two_pairs.png, docs/finding.png")


if __name__ == "__main__":
    main()
