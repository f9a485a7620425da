"""What new calls will take: tokens, dollars and minutes of each participant that is asked over the network.

Experience comes first: means over what the ledger holds of a participant. Without any, the registry's estimates stand.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from traps_pipeline.models.budget import BYTES_A_TOKEN, OVERHEAD_TOKENS
from traps_pipeline.models.registry import Entry, ModelEntry, load_accounts
from traps_pipeline.storage.ledger import AVERAGED, Totals

TYPICAL_TEXT_BYTES = 1500  # system prompt, question and, for a judge, the answer
# Until the ledger holds a call: seconds to the first token of an answer about a clip, and completion tokens a second.
FIRST_TOKEN_S, TOKENS_A_S = 4.0, 60.0
TYPICAL_BYTES_A_TOKEN = 4
LOW_SHARE = 0.4  # of the expected completion: what a terse model takes


@dataclass(frozen=True)
class Experience:
    """Means over answered calls: tokens of prompt and completion, seconds. None where nothing is known."""

    prompt_tokens: float | None = None
    completion_tokens: float | None = None
    latency_s: float | None = None


@dataclass(frozen=True)
class Forecast:
    """What calls take. Tokens are expected ones; dollars are low, expected, high, or None: unknown, never 0."""

    participant: str
    calls: int
    prompt_tokens: int
    completion_tokens: int
    dollars: tuple[float, float, float] | None
    minutes: float
    batch_price: float = 1.0  # of a call in a batch, relative to a live one


def experience(totals: Iterable[Totals]) -> Experience:
    """What the ledgers' rows of one participant say."""
    joined = Totals()
    for part in totals:
        joined.join(part)
    return Experience(*(joined.mean(column) for column in AVERAGED))


def forecast(entry: Entry, calls: int, seen: Experience) -> Forecast:
    """What so many new calls to an entry take. The high end is each call's worst case, which a budget reserves."""
    media = _media_tokens(entry)
    prompt = seen.prompt_tokens or media + TYPICAL_TEXT_BYTES / TYPICAL_BYTES_A_TOKEN
    completion = seen.completion_tokens or entry.expected_completion_tokens
    most_prompt = max(prompt, media + TYPICAL_TEXT_BYTES / BYTES_A_TOKEN + OVERHEAD_TOKENS)
    dollars = None
    if entry.prices is not None:
        cost = entry.prices.cost
        low, expected = cost(prompt, LOW_SHARE * completion), cost(prompt, completion)
        dollars = (calls * low, calls * expected, calls * max(expected, cost(most_prompt, entry.max_tokens)))
    minutes = _minutes(entry, calls, seen, prompt, completion)
    batch_price = load_accounts()[str(entry.account)].batch_price
    return Forecast(entry.id, calls, round(calls * prompt), round(calls * completion), dollars, minutes, batch_price)


def _media_tokens(entry: Entry) -> int:
    if not isinstance(entry, ModelEntry) or entry.media is None:
        return 0
    return entry.tokens_per_frame * (entry.media.uniform or entry.media.most)


def _minutes(entry: Entry, calls: int, seen: Experience, prompt_tokens: float, completion_tokens: float) -> float:
    """Minutes at the entry's concurrency and its account's pace, whichever is slower."""
    latency_s = seen.latency_s or FIRST_TOKEN_S + completion_tokens / TOKENS_A_S
    minutes = [calls * latency_s / entry.limits.concurrency / 60]
    account = load_accounts()[str(entry.account)]
    if account.requests_per_minute:
        minutes.append(calls / account.requests_per_minute)
    if account.tokens_per_minute:
        minutes.append(calls * (prompt_tokens + entry.max_tokens) / account.tokens_per_minute)
    return max(minutes)
