"""Answer requests in batches on local models, with one worker thread per device.

For callers it is like an API: one request, one outcome, one row of the ledger. So a crash loses only the running batch.
"""

import asyncio
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from functools import cache
from threading import Event

from traps_pipeline.base.cores import cores
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.models.framing import media_for_dataset
from traps_pipeline.models.reading.first_token import stored_alternatives
from traps_pipeline.models.registry.checkpoint import find_checkpoint
from traps_pipeline.models.registry.entries import Entry, ModelEntry
from traps_pipeline.models.request import Outcome, Request
from traps_pipeline.protocol.datasets import dataset_of
from traps_pipeline.storage.media import Frames, MediaSpec, pick_frames
from traps_pipeline.video.encode import DamagedClip

GATHER_S = 0.01  # wait after the first request for others that become free together


@cache
def worker(device: str) -> ThreadPoolExecutor:
    """Return the executor whose one thread works with the models of a device."""
    return ThreadPoolExecutor(1, thread_name_prefix=f"local-model-{device}")


@dataclass(eq=False)
class _Batch:
    """Requests answered together. abandoned: no caller waits for any of them any more."""

    requests: list[Request] = field(default_factory=list)
    answers: list[asyncio.Future[Outcome]] = field(default_factory=list)
    abandoned: Event = field(default_factory=Event)

    def forget(self, _: asyncio.Future[Outcome]) -> None:
        """Record that an answer is known or no longer wanted."""
        if all(answer.cancelled() for answer in self.answers):
            self.abandoned.set()


class LocalBackend:
    """A backend that answers with an entry's checkpoint, loaded at the first request."""

    def __init__(self, entry: Entry) -> None:
        if not isinstance(entry, ModelEntry) or entry.media is None:
            raise TrapsError(f"{entry.id}: only a model can be a local checkpoint; a judge is asked over the network")
        self._entry, self._spec, self._params = entry, entry.media, entry.local_params()
        self._worker = worker("cuda:0" if entry.device == "cuda" else entry.device or "cpu")
        find_checkpoint(self._params)  # report missing weights before anything is asked
        self._waiting = _Batch()
        self._running: asyncio.Task[None] | None = None

    async def ask(self, request: Request) -> Outcome:
        """Make one attempt (see `Backend`). Raises TrapsError if a retry cannot help."""
        answer: asyncio.Future[Outcome] = asyncio.get_running_loop().create_future()
        self._waiting.requests.append(request)
        self._waiting.answers.append(answer)
        if self._running is None or self._running.done():
            self._running = asyncio.create_task(self._run())
        return await answer

    async def _run(self) -> None:
        """Answer waiting requests, batch after batch, until none is left."""
        while self._waiting.requests:
            await asyncio.sleep(GATHER_S)
            batch, self._waiting = self._waiting, _Batch()
            for answer in batch.answers:
                answer.add_done_callback(batch.forget)
            try:
                outcomes = await asyncio.get_running_loop().run_in_executor(self._worker, self._answer_batch, batch)
            except Exception as error:  # noqa: BLE001 - raised by `ask` in each request's own task
                for answer in batch.answers:
                    if not answer.done():
                        answer.set_exception(error)
            else:
                for answer, outcome in zip(batch.answers, outcomes, strict=True):
                    if not answer.done():
                        answer.set_result(outcome)

    def _answer_batch(self, batch: _Batch) -> list[Outcome]:
        """Load the model, sample frames and generate answers, in the worker thread."""
        from traps_pipeline.models.local.adapter import load_local_model
        from traps_pipeline.models.local.sampling import Sampling

        model = load_local_model(self._entry)
        with ThreadPoolExecutor(cores()) as pool:
            clips = list(pool.map(lambda request: _frames(request, self._spec), batch.requests))
        prompts = [
            model.prompt(request.system, request.user, frames.frames, frames.times_s)
            for request, frames in zip(batch.requests, clips, strict=True)
        ]
        sampling = None
        if self._params.temperature is not None and self._params.top_p is not None:
            sampling = Sampling(self._params.temperature, self._params.top_p, seeds(batch.requests))
        answers = model.generate(prompts, self._params.max_new_tokens, sampling, stopped=batch.abandoned.is_set)
        return [
            replace(
                local_outcome(
                    answer.text,
                    answer.finish_reason,
                    answer.prompt_tokens,
                    answer.completion_tokens,
                    model.served_model,
                ),
                first_token=stored_alternatives(answer.first_token, request.about.get("regime")),
            )
            for request, answer in zip(batch.requests, answers, strict=True)
        ]


def _frames(request: Request, spec: MediaSpec) -> Frames:
    assert request.media is not None, "local models are asked about clips"
    try:
        return pick_frames(request.media, media_for_dataset(spec, dataset_of(str(request.about.get("item_id", "")))))
    except DamagedClip as error:
        raise TrapsError(str(error)) from error


def seeds(requests: Sequence[Request]) -> list[int]:
    """Return a seed per request from its key, so that runs differ and repeats agree."""
    return [int(request.key[:16], 16) for request in requests]


def local_outcome(text: str, finish: str, prompt_tokens: int, completion_tokens: int, served_model: str) -> Outcome:
    """Return an answer's outcome: truncated at the limit, empty without text."""
    text = text.strip()
    kind = ("truncated" if finish == "length" else "answer") if text else "empty"
    return Outcome(
        kind,
        text=text or None,
        finish_reason=finish,
        served_model=served_model,
        prompt_tokens=prompt_tokens,
        completion_tokens=completion_tokens,
        cost_usd=0.0,
    )
