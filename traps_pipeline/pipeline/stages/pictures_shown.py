"""Previews of tables and pictures for Dagster's UI."""

import math
from typing import TYPE_CHECKING

from traps_pipeline.pipeline.previews import Markdown

if TYPE_CHECKING:
    import pandas as pd

THUMBNAIL_WIDTH = 480  # px, about 15 KB in an event; the full picture is in the reports folder


def rows_shown(frame: "pd.DataFrame", rows: int = 60) -> Markdown | str:
    """The first rows as a Markdown table. Use it only for figures and ids, never for text that a model wrote."""
    if frame.empty:
        return "not run"
    head = frame.head(rows)
    lines = [[str(name) for name in head.columns], ["---"] * len(head.columns)]
    lines += [[_plain(value) for value in row] for row in head.itertuples(index=False)]
    return Markdown("\n".join("| " + " | ".join(line) + " |" for line in lines))


def thumbnail(png: bytes) -> Markdown:
    """A small JPEG of a picture."""
    import base64

    import cv2
    import numpy as np

    picture = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR)
    assert picture is not None, "our own PNG"
    scale = min(1.0, THUMBNAIL_WIDTH / picture.shape[1])
    small = cv2.resize(picture, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    jpeg = cv2.imencode(".jpg", small, [cv2.IMWRITE_JPEG_QUALITY, 70])[1].tobytes()
    return Markdown(f"![preview](data:image/jpeg;base64,{base64.b64encode(jpeg).decode()})")


def _plain(value: object) -> str:
    if isinstance(value, float):
        return "" if math.isnan(value) else f"{value:.4g}"
    return "" if value is None else str(value).replace("|", "\\|")
