"""Describe metrics: name, heading, range, direction, and the items counted.

`scoring.metrics` computes them, `scoring.bootstrap` resamples them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass


@dataclass(frozen=True)
class Metric:
    """A model's figure; `side` is the side whose items it counts ("" for both)."""

    name: str
    heading: str
    meaning: str
    side: str = ""
    lowest: float = 0.0
    less_is_better: bool = False

    @property
    def is_share(self) -> bool:
        """Whether it is a share of the items of one side, printed in percent."""
        return bool(self.side)


# In the order in which figures of one entry are printed.
METRIC_WORDS: Mapping[str, Metric] = {
    metric.name: metric
    for metric in (
        Metric("pecs", "PECS", "PECS = Acc x max(0, AbsRec - FalseAbs)"),
        Metric("acc", "Acc %", "share of controls answered correctly", "control"),
        Metric("abs_rec", "AbsRec %", "share of voids abstained on", "void"),
        Metric("false_abs", "FalseAbs %", "share of controls abstained on", "control", less_is_better=True),
        Metric("j", "J", "AbsRec - FalseAbs", lowest=-1.0),
    )
}
SHARES = tuple(name for name, metric in METRIC_WORDS.items() if metric.is_share)
