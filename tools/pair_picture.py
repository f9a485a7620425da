"""Draw a released pair from its frozen trajectories: control, void and twin side by side."""

from __future__ import annotations

from collections.abc import Sequence
from io import BytesIO
from pathlib import Path

import numpy as np
from matplotlib import get_data_path
from PIL import Image, ImageDraw, ImageFont

from traps_pipeline.scenes.worlds.spec import SceneSpec, load_trajectory
from traps_pipeline.scenes.worlds.world import World

SIZE, GAP, HEAD = (320, 240), 6, 24  # pixels: a frame, between two, and the words above


def pair_picture(folder: Path, spec: SceneSpec) -> bytes:
    """Return a JPEG of a record of `folder`, when both outcomes are seen; a void that is cut ends before."""
    path = folder / "trajectories" / f"{spec.scenario_id}.npz"
    control = World.of_record(spec, load_trajectory(path, spec.trajectory_sha256))
    twin = World.of_record(spec, load_trajectory(path, spec.twin.trajectory_sha256, "twin"), twin=True)
    at = next((i for i, place in enumerate(control.board) if place is not None), len(control.qpos)) - 1
    is_cut = control.occluder is None
    with control.renderer(supersample=1) as renderer:
        frames = [*renderer.frames([control.qpos[at]])]
        void = control.qpos[spec.void["cut_frame"] - 1 if is_cut else at]
        frames += renderer.frames([void], occluder=not is_cut)
    with twin.renderer(supersample=1) as renderer:
        frames += renderer.frames([twin.qpos[at]])
    return _sheet(frames, [f"control: {spec.ground_truth}", "void", f"twin: {spec.twin.ground_truth}"])


def _sheet(frames: Sequence[np.ndarray], words: Sequence[str]) -> bytes:
    """Return frames side by side below their words, as JPEG."""
    step = SIZE[0] + GAP
    sheet = Image.new("RGB", (len(frames) * step - GAP, HEAD + SIZE[1]), "white")
    font = ImageFont.truetype(f"{get_data_path()}/fonts/ttf/DejaVuSans.ttf", 14)
    for i, (frame, text) in enumerate(zip(frames, words, strict=True)):
        ImageDraw.Draw(sheet).text((i * step, 3), text, fill="black", font=font)
        sheet.paste(Image.fromarray(frame).resize(SIZE, Image.Resampling.BOX), (i * step, HEAD))
    buffer = BytesIO()
    sheet.save(buffer, "JPEG", quality=85)
    return buffer.getvalue()
