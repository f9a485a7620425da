"""Abstain by one cue, without understanding: the baseline that a model must beat.

A cue uses the clip or the question alone, never the record. Without its cue a rule gives the observer's answer, and if
that has none the commonest answer of the sub-scenario: it abstains by its cue alone.
"""

import re
from collections.abc import Callable, Mapping
from functools import lru_cache
from pathlib import Path

from traps_pipeline.models.baselines.observer import observer_answer
from traps_pipeline.models.baselines.reference import phrase
from traps_pipeline.models.framing import observer_frames
from traps_pipeline.models.request import Outcome, Request
from traps_pipeline.protocol.datasets import dataset_of

# Minimum connected pixels of an occluder. Released voids have 7,700 and more; shade in a control at most 300.
OCCLUDER_PX = 1000
CUT_FRAMES = 24  # frames of the shortest control; each cut clip has fewer (docs/spec.md 2.5)


@lru_cache(maxsize=100_000)
def _has_occluder(media_digest: str, clip: Path) -> bool:
    from traps_pipeline.scenes.parts.vision import largest_board
    from traps_pipeline.video.encode import decode_first

    return largest_board(decode_first(clip), OCCLUDER_PX) is not None


@lru_cache(maxsize=100_000)
def _is_cut(media_digest: str, clip: Path) -> bool:
    from traps_pipeline.video.encode import count_frames

    return count_frames(clip) < CUT_FRAMES


def has_no_choices(question: str) -> bool:
    """Return whether a question offers no choice: it has no `or`."""
    return re.search(r"\bor\b", question) is None


Cue = Callable[[str, Path, str], bool]  # digest of the clip, clip, question -> whether the rule abstains
CUES: Mapping[str, Cue] = {
    "occluder": lambda digest, clip, question: _has_occluder(digest, clip),
    "length": lambda digest, clip, question: _is_cut(digest, clip),
    "wording": lambda digest, clip, question: has_no_choices(question),
}
RULES: Mapping[str, tuple[str, ...]] = {**{name: (name,) for name in CUES}, "any": tuple(CUES)}  # the cues of each rule


class RuleBackend:
    """A reference strategy that plays the rule that `params.rule` names."""

    async def ask(self, request: Request) -> Outcome:
        """Return the outcome of one attempt to answer a request."""
        assert request.media is not None, "a rule is asked about clips"
        import asyncio

        answer = await asyncio.to_thread(_answer, request, request.media)
        text = phrase(answer, request)
        return Outcome("answer", text, finish_reason="stop", served_model=request.participant, cost_usd=0.0)


def _answer(request: Request, clip: Path) -> str | None:
    question = request.user
    if any(CUES[cue](request.media_digest, clip, question) for cue in RULES[str(request.params["rule"])]):
        return None
    frames = observer_frames(dataset_of(str(request.about["item_id"])))
    return observer_answer(request.media_digest, clip, question, frames) or str(request.secret["commonest_answer"])
