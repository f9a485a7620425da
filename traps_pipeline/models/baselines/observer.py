"""Answer by classical vision (the observer), the leaderboard's upper-bound row."""

from functools import lru_cache
from pathlib import Path

from traps_pipeline.models.baselines.reference import phrase
from traps_pipeline.models.framing import observer_frames
from traps_pipeline.models.request import Outcome, Request
from traps_pipeline.protocol.datasets import dataset_of
from traps_pipeline.video.policies import FramePolicy


@lru_cache(maxsize=100_000)
def observer_answer(media_digest: str, clip: Path, question: str, frames: FramePolicy) -> str | None:
    """Return the answer that the observer reads from these frames; None if it abstains."""
    from traps_pipeline.scenes.observe import observe

    return observe(clip, question, frames)


class ObserverBackend:
    """A backend that answers by classical vision on the clip, without the scenario's record."""

    async def ask(self, request: Request) -> Outcome:
        """Return the outcome of one attempt to answer a request."""
        assert request.media is not None, "the observer is asked about clips"
        frames = observer_frames(dataset_of(str(request.about["item_id"])))
        import asyncio

        answer = await asyncio.to_thread(observer_answer, request.media_digest, request.media, request.user, frames)
        text = phrase(answer, request)
        return Outcome("answer", text, finish_reason="stop", served_model=request.participant, cost_usd=0.0)
