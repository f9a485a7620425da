"""The observer as a model: it answers from a clip's frames and the question alone, the ceiling row of a leaderboard."""

from __future__ import annotations

import asyncio
from functools import lru_cache
from pathlib import Path

from traps_pipeline.models.reference import phrase
from traps_pipeline.models.request import Outcome, Request


@lru_cache(maxsize=100_000)
def seen(media_digest: str, clip: Path, question: str) -> str | None:
    """What the observer says of a clip; one look at a clip serves all regimes and runs."""
    from traps_pipeline.scenes.observe import observe

    return observe(clip, question)


class ObserverBackend:
    """Looks at the clip with classical vision; sees neither the record nor the simulator."""

    async def ask(self, request: Request) -> Outcome:
        """One attempt; see `Backend`."""
        assert request.media is not None, "the observer is asked about clips"
        answer = await asyncio.to_thread(seen, request.media_digest, request.media, request.user)
        text = phrase(answer, str(request.about["regime"]))
        return Outcome("answer", text, finish_reason="stop", served_model=request.participant, cost_usd=0.0)
