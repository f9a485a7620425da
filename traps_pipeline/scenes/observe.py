"""Answer questions from frames by classical vision (the observer).

It shows that the benchmark is solvable from pixels. It finds the family by the words of the question, so a question
that no family asks, an ill-posed one above all, is one it cannot answer.
"""

from functools import cache
from pathlib import Path

from traps_pipeline.scenes.family_registry import families
from traps_pipeline.scenes.parts.lane_vision import scenes_of_lane
from traps_pipeline.scenes.parts.wording import lane_asked, match_slots
from traps_pipeline.scenes.physics.kit import Family
from traps_pipeline.video.encode import decode_sampled
from traps_pipeline.video.policies import SAMPLED, FramePolicy


@cache
def family_asking(question: str) -> Family | None:
    """Return the family whose templates fit the question, None if there is none."""
    return next((family for family in families() if match_slots(family.questions, question) is not None), None)


def observe(clip: Path, question: str, policy: FramePolicy = SAMPLED) -> str | None:
    """Return the answer that the observer reads from a clip's frames (5 per second); None if unknown."""
    strip, question = lane_asked(question) or (None, question)
    family = family_asking(question)
    if family is None or family.observe is None:
        return None
    frames = decode_sampled(clip, policy)
    scenes = [frames] if strip is None else scenes_of_lane(frames, strip)
    return next((answer for scene in scenes if (answer := family.observe(scene, question)) is not None), None)
