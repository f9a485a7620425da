"""Forecast tokens, dollars and minutes of new network calls, by participant.

Means over a participant's ledger rows come first; without any, the registry's estimates apply.
"""

import json
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from types import MappingProxyType
from urllib.parse import urlsplit

from traps_pipeline.base.digests import digest
from traps_pipeline.base.files import write_text
from traps_pipeline.base.network import is_loopback
from traps_pipeline.base.paths import user_cache
from traps_pipeline.ledger.rows import AVERAGED_COLUMNS, Totals
from traps_pipeline.models.money.budget import BYTES_A_TOKEN, OVERHEAD_TOKENS
from traps_pipeline.models.money.media_tokens import clip_tokens
from traps_pipeline.models.registry.entries import Entry, ModelEntry, load_accounts

TYPICAL_TEXT_BYTES = 1500  # system prompt, question and, for a judge, the answer
# Of an entry without `expected_latency_s`: seconds to the first token of an answer, and completion tokens a second.
FIRST_TOKEN_S, TOKENS_A_S = 4.0, 60.0
TYPICAL_BYTES_A_TOKEN = 4
_LATENCIES = "latencies.json"  # in the user's cache
LOW_SHARE = 0.4  # share of the expected completion that a terse model takes


@dataclass(frozen=True)
class Experience:
    """The mean tokens and seconds of a participant's answered calls; None if unknown."""

    prompt_tokens: float | None = None
    completion_tokens: float | None = None
    latency_s: float | None = None


@dataclass(frozen=True)
class Forecast:
    """The predicted tokens, dollars and minutes of a participant's calls.

    Tokens are expected ones; dollars are low, expected, high, or None: unknown, never 0. minutes: of these calls alone;
    paced_minutes: at the pace of their account, which all its calls share. queued_minutes: if a server of this
    machine takes one call at a time, as its live check measured; 0 if nothing says so.
    """

    participant: str
    calls: int
    prompt_tokens: int
    completion_tokens: int
    dollars: tuple[float, float, float] | None
    minutes: float
    account: str
    paced_minutes: float
    queued_minutes: float = 0.0
    batch_price: float = 1.0  # cost of a batch call, relative to a live one


def experience(totals: Iterable[Totals]) -> Experience:
    """Return the mean tokens and seconds of one participant's ledger rows."""
    sum_of_totals = Totals()
    for part in totals:
        sum_of_totals.join(part)
    return Experience(*(sum_of_totals.mean(column) for column in AVERAGED_COLUMNS))


def forecast(entry: Entry, calls: int, seen: Experience, items: Mapping[str, int] = MappingProxyType({})) -> Forecast:
    """Return the forecast of new calls; the high end is what a budget reserves. items: their number by dataset."""
    frames, most_frames = _clip_tokens(entry, items)
    prompt = seen.prompt_tokens or frames + TYPICAL_TEXT_BYTES / TYPICAL_BYTES_A_TOKEN
    completion = seen.completion_tokens or entry.expected_completion_tokens
    most_prompt = max(prompt, most_frames + TYPICAL_TEXT_BYTES / BYTES_A_TOKEN + OVERHEAD_TOKENS)
    dollars = None
    if entry.prices is not None:
        cost = entry.prices.cost
        low, expected = cost(prompt, LOW_SHARE * completion), cost(prompt, completion)
        dollars = (calls * low, calls * expected, calls * max(expected, cost(most_prompt, entry.max_tokens)))
    account = load_accounts()[str(entry.account)]
    paced_minutes = [calls / account.requests_per_minute] if account.requests_per_minute else [0.0]
    if account.tokens_per_minute:
        paced_minutes.append(calls * (prompt + entry.max_tokens) / account.tokens_per_minute)
    checked_s, queued_s = _latencies().get(_address(entry, account.base_url), (0.0, 0.0))
    own_s = seen.latency_s or entry.expected_latency_s
    latency_s = own_s or checked_s or FIRST_TOKEN_S + completion / TOKENS_A_S
    is_here = is_loopback(urlsplit(account.base_url or "").hostname or "")
    waves = max(1.0, calls / entry.limits.concurrency) if calls else 0.0
    return Forecast(
        participant=entry.id,
        calls=calls,
        prompt_tokens=round(calls * prompt),
        completion_tokens=round(calls * completion),
        dollars=dollars,
        minutes=max(waves * latency_s / 60, *paced_minutes),
        account=str(entry.account),
        paced_minutes=max(paced_minutes),
        queued_minutes=calls * queued_s / 60 if is_here and not own_s else 0.0,
        batch_price=account.batch_price,
    )


def remember_latencies(entry: Entry, base_url: str | None, seconds: Sequence[float]) -> None:
    """Store how long the calls of a live check took, which were sent at once, for plans of any study."""
    means = sum(seconds) / len(seconds), max(seconds) / len(seconds)
    with suppress(OSError):  # a plan can do without
        write_text(user_cache() / _LATENCIES, json.dumps(_latencies() | {_address(entry, base_url): means}))


def _latencies() -> dict[str, tuple[float, float]]:
    """Return seconds by participant: of a call, and between two answers."""
    with suppress(OSError, ValueError, TypeError, AttributeError):  # a damaged file counts as none
        kept = json.loads((user_cache() / _LATENCIES).read_text(encoding="utf-8"))
        return {name: (float(call), float(between)) for name, (call, between) in kept.items()}
    return {}


def _address(entry: Entry, base_url: str | None) -> str:
    return digest([base_url, entry.provider_id])[:16]


def minutes_of(forecasts: Iterable[Forecast]) -> float:
    """Return the minutes of calls sent in parallel: the slowest participant's, or at an account's pace."""
    rows, minutes_by_account = list(forecasts), dict[str, float]()
    for row in rows:
        minutes_by_account[row.account] = minutes_by_account.get(row.account, 0.0) + row.paced_minutes
    return max([row.minutes for row in rows] + [*minutes_by_account.values()], default=0.0)


def _clip_tokens(entry: Entry, items: Mapping[str, int]) -> tuple[float, float]:
    """Return the prompt tokens of a clip, means over items: expected, and maximum."""
    if not isinstance(entry, ModelEntry):
        return 0.0, 0.0
    weights = items if sum(items.values()) else {"": 1}
    sums = [(clip_tokens(entry, dataset), n) for dataset, n in weights.items()]
    expected, most = (sum(tokens[k] * n for tokens, n in sums) / sum(weights.values()) for k in range(2))
    return min(expected, most), most
