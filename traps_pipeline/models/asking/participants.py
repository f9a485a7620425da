"""Send one call to a participant: pace, retries, reservation and ledger row.

This is the one place that sends calls; `models/asking/ask.py` decides which.
"""

import asyncio
import math
import random
import resource
import time
from collections.abc import Awaitable, Callable, Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass, field, replace
from datetime import UTC, datetime
from functools import partial
from typing import Any

from traps_pipeline.base import progress
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.ledger.rows import SIDE_TEXTS
from traps_pipeline.models.asking.traffic import CircuitBreaker, ConnectionLimit, RateLimiter
from traps_pipeline.models.money.budget import (
    Budget,
    BudgetReached,
    Reservation,
    check_money,
    most_tokens,
    worst_case_usd,
)
from traps_pipeline.models.registry.accounts import Account
from traps_pipeline.models.registry.entries import NETWORK, Entry, load_accounts
from traps_pipeline.models.request import (
    MALFORMED,
    RATE_LIMITED,
    UNREACHABLE,
    Backend,
    Outcome,
    Request,
    TransientError,
)
from traps_pipeline.models.wire.exchange import record_exchange
from traps_pipeline.storage.study import Study

Row = Mapping[str, Any]
MAX_BACKOFF_S, MAX_RETRY_AFTER_S = 60.0, 900.0
MALFORMED_TRIES = 2  # each is paid for, and a provider with malformed answers seldom recovers
FILES = 256  # open files besides connections: tables, Dagster's history, the interpreter's own
OVERRUN = 16  # highest plausible cost, in worst cases


@dataclass(frozen=True)
class Participant:
    """A model or judge with its backend, entry, connections, pace and failures."""

    backend: Backend
    entry: Entry
    gate: ConnectionLimit
    meter: RateLimiter
    breaker: CircuitBreaker


def allow_connections(count: int) -> None:
    """Increase the open-file limit for these connections. Raises TrapsError if denied."""
    n_needed = count + FILES
    soft_limit, hard_limit = resource.getrlimit(resource.RLIMIT_NOFILE)
    if soft_limit == resource.RLIM_INFINITY or soft_limit >= n_needed:
        return
    if hard_limit != resource.RLIM_INFINITY and hard_limit < n_needed:
        raise TrapsError(
            f"{count} connections at once need {n_needed} open files, and this shell allows {hard_limit}: raise that "
            f"(`ulimit -n {n_needed}`), or lower limits.concurrency of the models that are asked; nothing was sent"
        )
    resource.setrlimit(resource.RLIMIT_NOFILE, (n_needed, hard_limit))


class Participants:
    """Participants by id, created on first use: an unused one needs no key or budget.

    All evaluations of a run share connections, and all participants of an account its pace. sharers: how many processes
    use an account, if hosts share it.
    """

    def __init__(
        self,
        entries: Mapping[str, Entry],
        make: Callable[[Entry], Backend],
        study: Study,
        accounts: Mapping[str, Account] | None = None,
        sharers: Callable[[str], int] = lambda account: 1,
    ) -> None:
        self._sharers = sharers
        self._entries, self._make, self._study = entries, make, study
        self._accounts = load_accounts() if accounts is None else accounts
        self._made: dict[str, Participant] = {}
        self._meters: dict[str | None, RateLimiter] = {}
        self._connections = 0

    def __getitem__(self, name: str) -> Participant:
        if name not in self._made:
            entry = self._entries[name]
            check_money(self._study, entry)
            if entry.backend == NETWORK:
                self._connections += entry.limits.concurrency
                allow_connections(self._connections)
            account = self._accounts.get(entry.account or "")
            address = account.base_url if account else None
            gate, breaker = ConnectionLimit(entry.limits.concurrency), CircuitBreaker(name, address)
            breaker.check()
            self._made[name] = Participant(self._make(entry), entry, gate, self._meter(entry.account), breaker)
        return self._made[name]

    def _meter(self, account: str | None) -> RateLimiter:
        if account not in self._meters:
            limits = Account() if account is None else self._accounts[account]
            sharers = partial(self._sharers, account or "")
            self._meters[account] = RateLimiter(limits.requests_per_minute, limits.tokens_per_minute, sharers)
        return self._meters[account]


@dataclass(frozen=True)
class CallContext:
    """The conditions under which one call is sent, besides its participant.

    stop: set when the run is to end. halted(): whether to stop sending calls. require(): raises TrapsError if only
    another process may send this one. paid_by: receives the reservations of attempts that cost something.
    """

    budget: Budget
    stop: asyncio.Event
    halted: Callable[[], bool]
    require: Callable[[], Awaitable[None]]
    paid_by: list[Reservation] = field(default_factory=list)


async def ask_once(
    participant: Participant, request: Request, allowed: CallContext
) -> tuple[Outcome, int, float] | None:
    """Return the outcome of a call, the number of attempts, and the last one's seconds.

    This is the one retry layer: exponential backoff with full jitter, and never sooner than the provider asks. The
    outcome's cost includes what earlier attempts may have cost. None if halted before anything was spent.
    """
    limits, tokens = participant.entry.limits, most_tokens(participant.entry, request)
    lost_usd, seconds, n_malformed = 0.0, 0.0, 0
    for number in range(1, limits.retries + 2):
        async with participant.gate.connection():
            await participant.meter.admit(tokens.prompt + tokens.completion, allowed.halted)
            if allowed.halted():
                return _final_failure("interrupted", number - 1, seconds, lost_usd)
            started_at = time.monotonic()
            try:
                outcome = await _send(participant, request, allowed)
            except TransientError as error:
                failure, seconds = error, time.monotonic() - started_at
            except BudgetReached:
                if lost_usd:  # record lost money in the ledger first; the next call meets the cap again
                    return _final_failure("budget", number - 1, seconds, lost_usd)
                raise
            else:
                participant.gate.answered()
                participant.breaker.connected()
                participant.breaker.answered()
                if lost_usd:
                    outcome = replace(outcome, cost_usd=(outcome.cost_usd or 0.0) + lost_usd)
                return outcome, number, time.monotonic() - started_at
        if failure.kind == RATE_LIMITED:
            participant.gate.slow_down()
        if failure.kind == UNREACHABLE and not lost_usd:  # record what may be billed in the ledger first
            participant.breaker.no_connection(failure.why)
        elif failure.kind != UNREACHABLE:
            participant.breaker.connected()
        is_hopeless = False
        if failure.billed:
            lost_usd += _believed_cost(failure.cost_usd, worst_case_usd(participant.entry, request))
            is_hopeless = lost_usd > 0 and not participant.breaker.is_worth_another_try(failure.kind)
        n_malformed += failure.kind == MALFORMED
        if number > limits.retries or n_malformed == MALFORMED_TRIES or is_hopeless:
            return _final_failure(failure.kind, number, seconds, lost_usd, failure.raw)
        progress.current().retried(participant.entry.id)
        longest = min(limits.backoff_s * 2 ** (number - 1), MAX_BACKOFF_S)
        wait = max(min(failure.retry_after_s or 0.0, MAX_RETRY_AFTER_S), random.uniform(0, longest))
        if await _is_stopped_within(allowed.stop, wait):
            return _final_failure("interrupted", number, seconds, lost_usd)
    raise AssertionError("unreachable: the last attempt returns")


def _final_failure(
    kind: str, attempts: int, seconds: float, lost_usd: float, raw: str | None = None
) -> tuple[Outcome, int, float] | None:
    """Return a ledger failure; None for a call never sent, or free and to be retried."""
    if kind in ("interrupted", "budget") and not lost_usd:
        return None
    if kind == MALFORMED:
        return Outcome("malformed", error=kind, cost_usd=lost_usd or None, raw=raw), attempts, seconds
    return Outcome("error", error=kind, cost_usd=lost_usd or None), attempts, seconds


async def _send(participant: Participant, request: Request, allowed: CallContext) -> Outcome:
    """Send one attempt under a reservation and return its outcome.

    Raises TransientError and BudgetReached, and TrapsError before it is sent. A call costs its worst case from the
    moment that bytes of it are handed to a server until the provider credibly says otherwise: one that timed out may be
    billed. A call that was never sent is free.
    """
    entry = participant.entry
    worst_usd = worst_case_usd(entry, request)
    reservation = await allowed.budget.reserve(entry.id, worst_usd)
    cost_usd = 0.0
    with record_exchange() as exchange:
        try:
            # Check last: waiting for a connection, the pace or the budget may have taken long, and a host may have
            # slept.
            await allowed.require()
            cost_usd = worst_usd
            with progress.current().in_flight(entry.id):
                async with asyncio.timeout(entry.limits.timeout_s):
                    outcome = await participant.backend.ask(request)
            if entry.prices is not None:
                cost_usd = _believed_cost(outcome.cost_usd, worst_usd)
                outcome = replace(outcome, cost_usd=cost_usd)
            return outcome
        except TimeoutError:
            if exchange.is_unsent:
                reason = f"no connection was made within {entry.limits.timeout_s:g} s"
                raise TransientError(UNREACHABLE, billed=False, why=reason) from None
            raise TransientError("timeout") from None
        except asyncio.CancelledError:
            if (task := asyncio.current_task()) and not task.cancelling():  # nobody stops this call: its backend fails
                raise TransientError("cancelled") from None
            raise
        except TransientError as failure:
            cost_usd = _believed_cost(failure.cost_usd, worst_usd) if failure.billed else 0.0
            raise
        finally:
            if exchange.is_unsent:  # also for a call that is cancelled before it is sent
                cost_usd = 0.0
            if reservation is not None and cost_usd > 0:
                allowed.paid_by.append(reservation)
            await allowed.budget.settle(reservation, cost_usd)


def _believed_cost(cost_usd: float | None, worst_usd: float) -> float:
    """Return an answer's cost; the worst case if unknown, and at most a bound, so that no count ends the study."""
    if cost_usd is None or not math.isfinite(cost_usd) or cost_usd < 0:
        return worst_usd
    return min(cost_usd, OVERRUN * worst_usd)


async def _is_stopped_within(stop: asyncio.Event, seconds: float) -> bool:
    with suppress(TimeoutError):
        await asyncio.wait_for(stop.wait(), seconds)
    return stop.is_set()


def ledger_row(
    request: Request, outcome: Outcome, attempts: int, latency_s: float, epoch: str
) -> tuple[Row, dict[str, str]]:
    """Return the ledger's row of an outcome, and side texts: reasoning trace, malformed answer."""
    fields = asdict(outcome)
    side_texts = {name: text for name in SIDE_TEXTS if (text := fields.pop(name)) is not None}
    if fields["first_token"] is None:
        del fields["first_token"]  # few calls have it, so it is left out otherwise
    row = {
        "key": request.key,
        "outcome": fields.pop("kind"),
        **fields,
        "attempts": attempts,
        "latency_s": round(latency_s, 6),
    }
    row |= {"epoch": epoch, "created_at": datetime.now(UTC).isoformat(), "components": request.components}
    return row, side_texts


def call_time_columns(row: Row) -> Row:
    """Return the epoch and time of a row's call as columns, which all tables from a ledger have."""
    return {"epoch": row["epoch"], "created_at": datetime.fromisoformat(row["created_at"])}
