"""Describe a scenario's answer, intervention and certificates from SCENE_SPECS."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from typing import Any

from traps_pipeline.base.wording import in_percent
from traps_pipeline.protocol.datasets import RECORDED


def closes_frame(spec: Mapping[str, Any]) -> int | None:
    """Return the frame at which an occluder closes the control; None if none does."""
    control = json.loads(spec["control"])
    return None if control is None else control["closes_frame"]


def answer_of_control(spec: Mapping[str, Any]) -> str:
    """Return the control's answer, and the time until which its outcome is visible."""
    frame, fps = closes_frame(spec), json.loads(spec["physics"])["fps"]
    return spec["ground_truth"] if frame is None else f"{spec['ground_truth']}, in view until {frame / fps:.1f} s"


def intervention(spec: Mapping[str, Any]) -> str:
    """Return in words how the void was made from the control: hidden or cut at a time, or another clip."""
    moment = f"{spec['void_from_s']:.1f} s"
    if spec["family"] == RECORDED and not json.loads(spec["void"]).get("cover") and spec["void_kind"] == "occluder":
        return "another clip"
    return f"hidden from {moment}" if spec["void_kind"] == "occluder" else f"cut at {moment}"


_SHARES = ("panel_covers", "top_share")
_PHRASES = {
    "commit_s": "outcome settled at {} s",
    "read_s": "in view for {:.1f} s before an occluder comes",
    "margin_m": "margin {} m",
    "least_visible_px": "at least {:.0f} pixels when last in view",
    "ablation_px": "{} pixels change without what is hidden",
    "cause_moving_s": "cause seen moving for {} s",
    "panel_covers": "the occluder covers {} of where things move",
    "twin_px": "{} pixels between void and twin's void",
    "entropy_bits": "futures disagree by {:.2f} bits",
    "top_share": "the best guess is right in {} of them",
    "accepted": "{} futures look alike",
    "twin_largest_difference": "twin differs by at most {} of 255 before the cut",
}


def certificate_phrases(evidence: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    """Yield the name, and the value in words, of each number that supports a scenario's certificates."""
    for name, phrase in _PHRASES.items():
        if evidence.get(name) is not None:
            value = in_percent(evidence[name]) if name in _SHARES else evidence[name]
            yield name, phrase.format(value)
