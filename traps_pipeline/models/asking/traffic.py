"""Pace calls by connections, rate limits and a breaker; no answer is affected."""

import asyncio
import time
from collections import deque
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import asynccontextmanager, contextmanager
from typing import NoReturn

from traps_pipeline.base.errors import TrapsError
from traps_pipeline.models.request import MALFORMED, Outcome

SAME_REFUSALS = 20
UNMADE_IN_A_ROW, UNMADE_S = 5, 12.0  # calls that were never sent, and seconds since the first of them
MALFORMED_IN_A_ROW = 3
LOST_IN_A_ROW = 60  # attempts that were paid for and brought no answer
ERROR_WINDOW, ERROR_SHARE = 100, 0.10
LOOK_S = 0.2  # how often a waiting call checks whether it is still wanted
BURST_S = 2.0  # burst size, in seconds of the rate


class ConnectionLimit:
    """A participant's connection limit, halved on a 429, raised by rounds of answers."""

    def __init__(self, most: int) -> None:
        self.most, self.limit, self.open = most, most, 0
        self._answers, self._slowed_at = 0, float("-inf")
        self._waiting: deque[asyncio.Future[None]] = deque()

    @asynccontextmanager
    async def connection(self) -> AsyncIterator[None]:
        """Wait for a free connection and hold it."""
        while self.open >= self.limit:
            free = asyncio.get_running_loop().create_future()
            self._waiting.append(free)
            try:
                await free
            finally:
                if free in self._waiting:
                    self._waiting.remove(free)
        self.open += 1
        try:
            yield
        finally:
            self.open -= 1
            self._wake()

    def slow_down(self) -> None:
        """Reduce the limit after a 429."""
        now = time.monotonic()
        if now - self._slowed_at >= 1.0:
            self.limit, self._slowed_at, self._answers = max(1, self.limit // 2), now, 0

    def answered(self) -> None:
        """Count an answer, and raise the limit after a full round."""
        self._answers += 1
        if self.limit < self.most and self._answers >= self.limit:
            self.limit, self._answers = self.limit + 1, 0
            self._wake()

    def _wake(self) -> None:
        for _ in range(self.limit - self.open):
            while self._waiting:
                free = self._waiting.popleft()
                if not free.done():
                    free.set_result(None)
                    break


class RateLimiter:
    """An account's rate limiter: token buckets for calls and for tokens per minute.

    sharers: the number of processes that use the account at this moment; each gets an equal part of the rate.
    """

    def __init__(
        self, requests_per_minute: int | None, tokens_per_minute: int | None, sharers: Callable[[], int] = lambda: 1
    ) -> None:
        self._sharers = sharers
        self._rates = [None if rate is None else rate / 60 for rate in (requests_per_minute, tokens_per_minute)]
        self._levels = [self._capacity(rate, 1.0) for rate in self._shared_rates()]
        self._at = time.monotonic()

    def _shared_rates(self) -> list[float | None]:
        """Return this process's rates per second."""
        return [None if rate is None else rate / self._sharers() for rate in self._rates]

    @staticmethod
    def _capacity(rate: float | None, least: float) -> float:
        return float("inf") if rate is None else max(rate * BURST_S, least)

    async def admit(self, tokens: int, halted: Callable[[], bool] = lambda: False) -> None:
        """Wait until a call with these tokens may be sent, or calls are halted; later calls wait longer for it."""
        send_at = time.monotonic() + self._take((1.0, float(tokens)))
        while (wait_s := send_at - time.monotonic()) > 0 and not halted():
            await asyncio.sleep(min(wait_s, LOOK_S))

    def _take(self, amounts: tuple[float, float]) -> float:
        """Take from the buckets; return the seconds until they are at zero again."""
        now, wait = time.monotonic(), 0.0
        for k, (rate, amount) in enumerate(zip(self._shared_rates(), amounts, strict=True)):
            if rate is None:
                continue
            self._levels[k] = min(self._capacity(rate, 1.0), self._levels[k] + (now - self._at) * rate) - amount
            wait = max(wait, -self._levels[k] / rate)
        self._at = now
        return wait


class ParticipantStopped(TrapsError):
    """Raised for a participant that is no longer asked; the others go on."""


_stopped: list[dict[str, str]] = []  # one per active `remembering_stops`: participant to message


@contextmanager
def remembering_stops() -> Iterator[None]:
    """Keep stopped participants stopped for all callers in the block, with the reason."""
    _stopped.append({})
    try:
        yield
    finally:
        _stopped.pop()


class CircuitBreaker:
    """A circuit breaker for one participant: it stops the asking after repeated failures."""

    def __init__(self, participant: str, address: str | None = None) -> None:
        self._participant, self._address = participant, address
        self._unmade, self._unmade_since = 0, 0.0  # consecutive unsent calls, and when the first was tried
        self._refusal, self._in_a_row = "", 0
        self._malformed = 0  # consecutive
        self._lost = dict.fromkeys((MALFORMED, ""), 0)  # consecutive attempts without an answer: malformed, of any kind
        self._window: deque[bool] = deque(maxlen=ERROR_WINDOW)

    def check(self) -> None:
        """Raise ParticipantStopped if the participant was stopped (`remembering_stops`)."""
        for stops in _stopped:
            if self._participant in stops:
                raise ParticipantStopped(stops[self._participant])

    def no_connection(self, why: str = "") -> None:
        """Count an unsent call; raise ParticipantStopped after five in a row over some time."""
        self._unmade += 1
        self._unmade_since = self._unmade_since or time.monotonic()
        if self._unmade >= UNMADE_IN_A_ROW and time.monotonic() - self._unmade_since >= UNMADE_S:
            address_text = f" to {self._address}" if self._address else ""
            self._stop(f"{self._unmade} calls in a row{address_text} could not be sent{why and f': {why}'}")

    def connected(self) -> None:
        """Record that a call was sent."""
        self._unmade, self._unmade_since = 0, 0.0

    def is_worth_another_try(self, kind: str) -> bool:
        """Count a paid attempt without an answer; return whether to try its call again."""
        self._lost[""] += 1
        self._lost[MALFORMED] = self._lost[MALFORMED] + 1 if kind == MALFORMED else 0
        return self._lost[MALFORMED] < MALFORMED_IN_A_ROW and self._lost[""] < LOST_IN_A_ROW

    def answered(self) -> None:
        """Record that an attempt brought an answer."""
        self._lost = dict.fromkeys(self._lost, 0)

    def watch(self, outcome: Outcome) -> None:
        """Raise ParticipantStopped after repeated failures.

        These are a redirect, 20 consecutive refusals of the same kind, three consecutive malformed answers, 60
        consecutive attempts that were paid for and lost, or more than 10 failures in the last 100 calls.
        """
        refusal = _refusal(outcome)
        self._in_a_row = self._in_a_row + 1 if refusal and refusal == self._refusal else int(bool(refusal))
        self._refusal = refusal
        self._malformed = self._malformed + 1 if outcome.kind == "malformed" else 0
        self._window.append(outcome.kind in ("error", "malformed"))
        errors = sum(self._window)
        if refusal.startswith("http_3"):
            reason = f"its address redirects each call ({refusal}), which is not followed: mend its `base_url`"
        elif self._lost[""] >= LOST_IN_A_ROW:
            reason = f"{self._lost['']} attempts in a row that may be billed brought no answer (last: {outcome.error})"
        elif self._in_a_row >= SAME_REFUSALS:
            reason = f"{self._in_a_row} refusals in a row ({refusal})"
        elif self._malformed >= MALFORMED_IN_A_ROW:
            reason = f"{self._malformed} answers in a row are out of order (they lie in the ledger, beside its rows)"
        elif len(self._window) == ERROR_WINDOW and errors > ERROR_SHARE * ERROR_WINDOW:
            reason = f"{errors} of its last {ERROR_WINDOW} calls failed (last: {outcome.error or 'an answer'})"
        else:
            return
        self._stop(reason)

    def _stop(self, why: str) -> NoReturn:
        message = (
            f"{self._participant} is stopped: {why}; its answers so far are kept. Mend the cause and run the same "
            "command again: only what is missing is asked"
        )
        for stops in _stopped:
            message = stops.setdefault(self._participant, message)  # calls in flight return later, and raise it, too
        raise ParticipantStopped(message)


def _refusal(outcome: Outcome) -> str:
    """Return the kind of a provider's refusal of content or call; empty if it is none."""
    if outcome.kind == "refused":
        return outcome.error or outcome.finish_reason or "refused"
    return (outcome.error or "") if outcome.kind == "error" and (outcome.error or "").startswith("http_") else ""
