"""Real encoded videos, and tables of pairs, for what people bring."""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import av
import numpy as np

WORDS = {
    "category": "balls", "question": "Which side does the ball reach, left or right?", "choices": "left|right",
    "aliases": "the left=left|the right=right", "ill_posed_question": "What is the ball called?",
    "source": "filmed in a test", "licence": "CC0-1.0",
}  # fmt: skip
ANSWERS = ("left", "right")
TWO_EVENTS = {
    "two_events": "the red ball|the blue ball", "question": "Which side does {} reach, left or right?",
    "answer": "left|right", "cover": "1.2 3 0 80 150 160|1.2 3 160 80 160 160",
}  # fmt: skip


def ball(answer: str, number: int = 0, *, n: int = 60, size: tuple[int, int] = (320, 240)) -> list[np.ndarray]:
    """Return frames of a ball that rolls down the middle, and from half time on to a side."""
    width, height = size
    down, across = np.mgrid[:height, :width]
    colour = np.array([30 + 7 * number % 120, 60 + 13 * number % 90, 90 + 29 * number % 90])
    ground = np.clip(colour + (across[..., None] * (1 + number % 3) + down[..., None]) % 40, 0, 255)
    frames = []
    for k in range(n):
        aside = max(0.0, k / n - 0.5) * 0.8 * width * (-1 if answer == "left" else 1)
        x, y = width / 2 + aside, height * (0.15 + 0.7 * k / n)
        is_ball = ((across - x) ** 2 + (down - y) ** 2 < (height / 12) ** 2)[..., None]
        frames.append(np.where(is_ball, [230, 40, 40], ground).astype(np.uint8))
    return frames


def film(
    path: Path, frames: Sequence[np.ndarray], *, rate: int = 20, times: Sequence[int] | None = None,
    codec: str = "libx264", pix_fmt: str = "yuv420p", sound: bool = False, options: Mapping[str, str] | None = None,
    container: Mapping[str, str] | None = None, **stream_fields: Any,
) -> Path:  # fmt: skip
    """Encode frames as a phone would; times: presentation times in ticks of 1/rate s, else even."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with av.open(str(path), "w", options=dict(container or {})) as file:
        file.metadata.update({"title": "a secret title", "comment": "the answer is left"})
        stream: Any = file.add_stream(codec, rate=rate, options=dict(options or {"crf": "12", "preset": "ultrafast"}))
        stream.height, stream.width = frames[0].shape[:2]
        stream.pix_fmt = pix_fmt
        for name, value in stream_fields.items():
            setattr(stream.codec_context, name, value)
        speech: Any = file.add_stream("aac", rate=48000) if sound else None
        for number, picture in enumerate(frames):
            frame = av.VideoFrame.from_ndarray(picture, format="rgba" if picture.shape[2] == 4 else "rgb24")
            frame.pts = number if times is None else times[number]
            file.mux(stream.encode(frame))
        file.mux(stream.encode(None))
        if speech is not None:
            hum = av.AudioFrame.from_ndarray(np.zeros((1, 1024), np.float32), format="fltp", layout="mono")
            hum.sample_rate = 48000
            file.mux(speech.encode(hum))
            file.mux(speech.encode(None))
    return path


def table(folder: Path, rows: Sequence[Mapping[str, Any]]) -> Path:
    """Write pairs.csv; words that a row does not give are those of WORDS."""
    lines = [{**WORDS, **row} for row in rows]
    with (folder / "pairs.csv").open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, [*dict.fromkeys(name for line in lines for name in line)])
        writer.writeheader()
        writer.writerows(lines)
    return folder


def balls(folder: Path, n: int, *, events: int = 0) -> Path:
    """Write n pairs: covered ones with a twin, and ones that are cut, in turn; and recordings of two events."""
    rows: list[dict[str, str]] = []
    for number in range(n):
        answer, other = ANSWERS[number % 2], ANSWERS[1 - number % 2]
        film(folder / f"{number}.mp4", ball(answer, number))
        row = {"id": f"balls-{number + 1:04d}", "control": f"{number}.mp4", "answer": answer}
        if number % 2:
            film(folder / f"{number}-twin.mp4", ball(other, number), options={"qp": "0", "preset": "ultrafast"})
            film(folder / f"{number}.mp4", ball(answer, number), options={"qp": "0", "preset": "ultrafast"})
            row |= {"cover": "1.2 3 0 80 320 160", "control_cover": "2.8 3 0 80 320 160"}
            row |= {"twin": f"{number}-twin.mp4", "twin_answer": other}
        else:
            row["cut_s"] = "1.2"
        rows.append(row)
    for number in range(events):
        pictures = [np.hstack(both) for both in zip(*(ball(a, number, size=(160, 240)) for a in ANSWERS), strict=True)]
        film(folder / f"events-{number}.mp4", pictures)
        rows.append({"id": f"balls-e{number + 1:03d}", "control": f"events-{number}.mp4", **TWO_EVENTS})
    return table(folder, rows)
