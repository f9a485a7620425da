"""Define the table of models' answers."""

from dataclasses import dataclass
from typing import Annotated

from traps_pipeline.storage import columns as shared
from traps_pipeline.storage.tables import Table


@dataclass(frozen=True, kw_only=True, slots=True)  # a large cell has 100,000
class ResponseRow(shared.CellRow):
    """One answer of one model in one run."""

    item_id: shared.ItemId
    pair_id: shared.PairId
    side: shared.Side
    outcome: shared.AnswerOutcome
    text: Annotated[str | None, "the visible answer; null unless outcome is answer"]
    fragment: Annotated[str | None, "the beginning of a text that is no answer: cut off, degenerate; never judged"]
    reasoning: Annotated[str | None, "the trace, where the provider returns it"]
    is_json: Annotated[bool | None, "JSON regime: whether the text is the object that the prompt asks for"]
    first_token: Annotated[str | None, "regime logprobs: JSON object, token to log-probability, likeliest first"]
    finish_reason: Annotated[str | None, "as the provider sent it"]
    error: Annotated[str | None, "kind of a failure, or why a text is no answer; never shown to a judge"]
    served_model: Annotated[str | None, "what the provider says answered"]
    client: Annotated[str | None, "library and version that built and sent the call; null where none did"]
    prompt_tokens: shared.Tokens
    completion_tokens: shared.Tokens
    reasoning_tokens: shared.Tokens
    cost_usd: Annotated[
        float | None, "dollars, with the worst case of attempts that may be billed; null where the price is unknown"
    ]
    latency_s: Annotated[float, "seconds of the last attempt"]
    attempts: Annotated[int, "calls made for this row"]
    request_key: shared.LedgerKey
    epoch: shared.Epoch
    created_at: shared.AskedAt
    benchmark_version: shared.BenchmarkVersion


RESPONSES = Table(
    "responses",
    ResponseRow,
    partition_by=("dataset", "model", "regime", "run"),
    key=("item_id", "model", "regime", "run"),
)
