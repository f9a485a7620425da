"""A page of all pairs that opens from disk: control, void and twin side by side, questions, answers, certificates.

The page plays the clips in the workspace and makes no network request. All text is escaped by Jinja2.
"""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from traps_pipeline.report.writing import environment
from traps_pipeline.video.encode import decode

POSTER_WIDTH, POSTER_HEIGHT = 240, 180
POSTERS = "gallery"  # folder beside the page
SIDES = ("control", "void", "twin")


@dataclass(frozen=True)
class Picture:
    """A clip on the page: its paths relative to the page, and its caption."""

    side: str
    clip: str
    poster: str
    caption: str


@dataclass(frozen=True)
class ShownScenario:
    """A scenario on the page."""

    scenario_id: str
    question: str
    labels: str
    ill_posed_question: str
    pictures: tuple[Picture, ...]
    certificate: Mapping[str, str]


@dataclass(frozen=True)
class Poster:
    """The picture of a clip on the page: its last frame, or the last one before a panel closes the clip.

    name: its file under the reports folder; clip: under the study's folder; before: the frame that the panel closes.
    """

    name: str
    clip: str
    before: int | None

    def jpeg(self, root: Path) -> bytes:
        """The picture, of a clip under root. Raises DamagedClip when it cannot be decoded."""
        import cv2

        frames, _ = decode(root / self.clip)
        small = cv2.resize(frames[: self.before][-1], (POSTER_WIDTH, POSTER_HEIGHT), interpolation=cv2.INTER_AREA)
        _, jpeg = cv2.imencode(".jpg", np.ascontiguousarray(small[..., ::-1]), [cv2.IMWRITE_JPEG_QUALITY, 82])
        return jpeg.tobytes()


def gallery(specs: pd.DataFrame, videos: pd.DataFrame, title: str) -> tuple[bytes, list[Poster]]:
    """`gallery.html` and the posters that it shows. specs are SCENE_SPECS rows, videos VIDEOS rows."""
    clips = {(row["scenario_id"], row["side"]): str(row["path"]) for row in videos.to_dict("records")}
    posters = list[Poster]()
    sections: defaultdict[str, list[ShownScenario]] = defaultdict(list)
    for spec in specs.sort_values("scenario_id").to_dict("records"):
        scenario_id = spec["scenario_id"]
        if all((scenario_id, side) in clips for side in SIDES):
            for side in SIDES:
                before = closes_frame(spec) if side == "control" else None
                posters.append(Poster(_poster(scenario_id, side), clips[scenario_id, side], before))
            sections[spec["family"]].append(_entry(spec, clips))
    return _render(title, dict(sorted(sections.items()))).encode(), posters


def _poster(scenario_id: str, side: str) -> str:
    return f"{POSTERS}/{scenario_id}-{side}.jpg"


def _entry(spec: Mapping[str, Any], clips: Mapping[tuple[str, str], str]) -> ShownScenario:
    scenario_id, evidence, twin = spec["scenario_id"], json.loads(spec["evidence"]), json.loads(spec["twin"])
    captions = {
        "control": f"control: {answer_of_control(spec)}",
        "void": f"void: {intervention(spec)}",
        "twin": f"twin, same void: {twin['ground_truth']}",
    }
    pictures = tuple(
        Picture(side, f"../{clips[scenario_id, side]}", _poster(scenario_id, side), captions[side]) for side in SIDES
    )
    labels = ", ".join(spec["labels"])
    certificate = dict(certificate_phrases(evidence))
    return ShownScenario(scenario_id, spec["question"], labels, spec["ill_posed_question"], pictures, certificate)


def closes_frame(spec: Mapping[str, Any]) -> int | None:
    """The frame from which a panel closes the control of a SCENE_SPECS row; None if none does."""
    control = json.loads(spec["control"])
    return None if control is None else control["closes_frame"]


def answer_of_control(spec: Mapping[str, Any]) -> str:
    """The control's answer and until when its outcome is in view, from a SCENE_SPECS row."""
    frame, fps = closes_frame(spec), json.loads(spec["physics"])["fps"]
    return spec["ground_truth"] if frame is None else f"{spec['ground_truth']}, in view until {frame / fps:.1f} s"


def intervention(spec: Mapping[str, Any]) -> str:
    """What was done to the control's clip to make the void, from a SCENE_SPECS row."""
    at = f"{spec['void_from_s']:.1f} s"
    return f"hidden from {at}" if spec["void_kind"] == "occluder" else f"cut at {at}"


_PHRASES = {
    "commit_s": "outcome settled at {} s",
    "read_s": "in view for {:.1f} s before a panel comes",
    "margin_m": "margin {} m",
    "least_visible_px": "at least {:.0f} pixels when last in view",
    "ablation_px": "{} pixels change without what is hidden",
    "cause_moving_s": "cause seen moving for {} s",
    "panel_covers": "the panel covers {:.0%} of where things move",
    "twin_px": "{} pixels between void and twin's void",
    "entropy_bits": "futures disagree by {:.2f} bits",
    "top_share": "the best guess is right in {:.0%} of them",
    "accepted": "{} futures look alike",
    "twin_largest_difference": "twin differs by at most {} of 255 before the cut",
}


def certificate_phrases(evidence: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    """Name and words of each number that the certificates of a scenario rest on, from its evidence."""
    for name, phrase in _PHRASES.items():
        if evidence.get(name) is not None:
            yield name, phrase.format(evidence[name])


def _render(title: str, sections: Mapping[str, list[ShownScenario]]) -> str:
    count = sum(len(entries) for entries in sections.values())
    return environment().get_template("gallery.html.j2").render(title=title, sections=sections, count=count)
