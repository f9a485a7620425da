"""Pace and stops: connections that follow 429s, an account's calls a minute, when a participant is given up."""

from __future__ import annotations

import asyncio
import subprocess
import sys
import time

import pytest

from tests.build.errors import raises
from traps_pipeline.models.asking.traffic import (
    CircuitBreaker,
    ConnectionLimit,
    ParticipantStopped,
    RateLimiter,
    remembering_stops,
)
from traps_pipeline.models.request import Outcome

ANSWER, ERROR = Outcome("answer", "left"), Outcome("error", error="timeout")


def test_a_429_halves_the_connections_once_a_second_and_answers_win_them_back(monkeypatch: pytest.MonkeyPatch) -> None:
    now = [0.0]
    monkeypatch.setattr(time, "monotonic", lambda: now[0])
    gate = ConnectionLimit(24)
    gate.slow_down()
    gate.slow_down()  # of the same burst
    assert gate.limit == 12
    now[0] = 1.0
    gate.slow_down()
    assert gate.limit == 6
    for _ in range(6 + 7):
        gate.answered()
    assert gate.limit == 8
    for _ in range(1000):
        gate.answered()
    assert gate.limit == 24
    for second in range(2, 12):
        now[0] = second
        gate.slow_down()
    assert gate.limit == 1


def test_no_more_calls_are_open_than_there_are_connections() -> None:
    async def run() -> int:
        gate, most = ConnectionLimit(3), 0

        async def call() -> None:
            nonlocal most
            async with gate.connection():
                most = max(most, gate.open)
                await asyncio.sleep(0.001)
                gate.answered()

        await asyncio.gather(*(call() for _ in range(50)))
        assert gate.open == 0
        return most

    assert asyncio.run(run()) == 3


def test_a_cancelled_wait_frees_its_place_in_the_queue() -> None:
    async def run() -> None:
        gate = ConnectionLimit(1)
        async with gate.connection():
            connections = [gate.connection() for _ in range(2)]
            waiting = [asyncio.create_task(connection.__aenter__()) for connection in connections]
            await asyncio.sleep(0)
            waiting[0].cancel()
        await asyncio.wait_for(waiting[1], 1)
        assert gate.open == 1

    asyncio.run(run())


def admitted(meter: RateLimiter, calls: int, tokens: int) -> float:
    """Return the seconds until a meter has let all calls through."""

    async def run() -> float:
        began = time.monotonic()
        await asyncio.gather(*(meter.admit(tokens) for _ in range(calls)))
        return time.monotonic() - began

    return asyncio.run(run())


def test_an_account_sends_no_more_calls_and_tokens_a_minute_than_it_may() -> None:
    # 20 calls at once, 5 more at ten a second; 2,000 tokens at once, 500 more at a thousand a second.
    assert admitted(RateLimiter(600, None), 25, 1000) >= 0.45
    assert admitted(RateLimiter(None, 60_000), 5, 500) >= 0.45


def test_processes_that_share_an_account_share_its_pace() -> None:
    assert admitted(RateLimiter(1200, None, lambda: 2), 25, 1000) >= 0.45  # ten a second of twenty, a burst of 20


def test_twenty_refusals_of_one_kind_in_a_row_stop_a_model_and_nineteen_do_not() -> None:
    breaker, refusal = CircuitBreaker("m"), Outcome("refused", error="content_policy")
    for _ in range(19):
        breaker.watch(refusal)
    breaker.watch(ANSWER)
    for _ in range(19):
        breaker.watch(refusal)
    breaker.watch(Outcome("refused", finish_reason="content_filter"))  # another kind
    for _ in range(19):
        breaker.watch(refusal)
    with raises(ParticipantStopped, "models.asking.traffic.CircuitBreaker._stop"):
        breaker.watch(refusal)


def test_a_call_that_the_provider_refuses_as_it_is_counts_as_a_refusal() -> None:
    breaker = CircuitBreaker("m")
    with raises(ParticipantStopped, "models.asking.traffic.CircuitBreaker._stop", " 20 ", "(http_401)"):
        for _ in range(20):
            breaker.watch(Outcome("error", error="http_401"))


def test_a_stop_lasts_for_the_whole_run_and_no_longer() -> None:
    def stop(name: str) -> None:
        for _ in range(20):
            CircuitBreaker(name).check()
            breaker.watch(Outcome("refused"))

    with remembering_stops():
        breaker = CircuitBreaker("m")
        with pytest.raises(ParticipantStopped) as first:
            stop("m")
        with pytest.raises(ParticipantStopped) as again:
            CircuitBreaker("m").check()  # as the next batch of the run makes it
        assert str(again.value) == str(first.value)
        CircuitBreaker("n").check()
    CircuitBreaker("m").check()


def test_more_than_ten_errors_in_a_hundred_calls_stop_a_model() -> None:
    breaker = CircuitBreaker("m")
    for n in range(100):
        breaker.watch(ERROR if n % 10 == 0 else ANSWER)  # ten: at the limit
    with raises(ParticipantStopped, "models.asking.traffic.CircuitBreaker._stop", " 11 ", " 100 "):
        for n in range(1, 12):
            breaker.watch(ERROR if n % 2 else ANSWER)


@pytest.mark.slow
def test_connections_that_a_shell_does_not_allow_are_refused_before_anything_is_sent() -> None:
    asking = """
import resource
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.models.asking.participants import allow_connections
resource.setrlimit(resource.RLIMIT_NOFILE, (180, 400))
allow_connections(100)
print(resource.getrlimit(resource.RLIMIT_NOFILE))
try:
    allow_connections(200)
except TrapsError as error:
    print(error)
"""
    ran = subprocess.run([sys.executable, "-c", asking], capture_output=True, check=True, text=True)
    raised, refused = ran.stdout.splitlines()
    assert raised == "(356, 400)"
    assert "200" in refused and "400" in refused and "`ulimit -n 456`" in refused


def test_five_calls_in_a_row_that_never_left_over_twelve_seconds_stop_a_model_and_name_the_last_cause(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    now = [1000.0]
    monkeypatch.setattr(time, "monotonic", lambda: now[0])
    breaker = CircuitBreaker("m", "http://127.0.0.1:8000/v1")
    for _ in range(24):  # all connections at once, while the server is started again
        breaker.no_connection()
    now[0] += 11
    breaker.no_connection()
    breaker.connected()  # it is back
    now[0] += 100
    for _ in range(5):
        breaker.no_connection()
    now[0] += 12
    with raises(
        ParticipantStopped, "models.asking.traffic.CircuitBreaker._stop", "http://127.0.0.1:8000/v1", "no such name"
    ):
        breaker.no_connection("no such name")
