"""The figure of graded cuts: decisions and probabilities each have their own side, and each model one entry."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import pandas as pd

from traps_pipeline.report.figures.graded_figure import graded
from traps_pipeline.report.writing import freeze_layout

TOPS = (0.5, 0.7, 0.9)


def rows(model: str, regime: str, coverage: float, stated: float | None) -> list[dict[str, Any]]:
    fields = {"model": model, "regime": regime, "coverage": coverage, "stated": stated}
    return [fields | {"scope": f"about {top}", "top": top} for top in TOPS]


def test_decisions_stand_left_probabilities_right_and_a_model_has_one_entry() -> None:
    table = pd.DataFrame(
        [
            *rows("oracle", "priced", 1.0, None),
            *rows("prior", "priced", 0.25, None),
            *rows("oracle", "probabilities", 0.0, 0.6),
            *rows("oracle", "logprobs", 0.0, 0.4),
            {"model": "oracle", "regime": "priced", "scope": "all", "coverage": 1.0, "stated": None, "top": 0.7},
        ]
    )
    figure = graded(cast(Any, SimpleNamespace(graded=table)))
    left, right = ([line for line in axes.lines if len(line.get_xdata()) == len(TOPS)] for axes in figure.axes)
    assert [set(line.get_ydata()) for line in left] == [{0.0}, {0.75}]
    assert [set(line.get_ydata()) for line in right] == [{0.6}, {0.4}]
    freeze_layout(figure)
    assert all(axes.get_position().width > 0.4 for axes in figure.axes)
    entries = [text.get_text() for text in figure.legends[0].get_texts()]
    assert entries == [
        "ideal observer", "oracle", "prior", "regime priced", "regime probabilities", "regime logprobs"
    ]  # fmt: skip
