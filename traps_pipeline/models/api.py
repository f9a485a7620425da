"""Models over the network, through litellm: one attempt a call, exactly the declared parameters, typed outcomes.

Retries, pace and money are not here (`ask`). litellm is imported when first asked: it takes seconds and would fetch a
price list from the network.
"""

from __future__ import annotations

import json
import logging
import math
import os
import warnings
from collections.abc import Mapping
from functools import cache
from importlib import import_module
from typing import Any

from traps_pipeline.base import progress
from traps_pipeline.base.extras import require
from traps_pipeline.base.network import check_network
from traps_pipeline.base.redaction import redact
from traps_pipeline.base.terminal import plain
from traps_pipeline.models.registry import Account, Entry, load_accounts
from traps_pipeline.models.request import (
    MALFORMED,
    RATE_LIMITED,
    UNREACHABLE,
    WITH_TEXT,
    Outcome,
    OutcomeKind,
    Request,
    TransientError,
)
from traps_pipeline.models.transport import WATCHED, Exchange, watch
from traps_pipeline.models.usage import Sizes, Usage, read_usage
from traps_pipeline.storage.media import Media, data_uris

UNREADABLE = 422  # what litellm makes of a page that is no JSON; no provider here sends it
MOST_KEPT = 4000  # characters of an answer that is out of order
MOST_NAME = 200  # characters of what a provider says in a word: who answered, why it ended
SERVED, REFUSAL = "traps_served_model", "traps_refusal"  # what the hook adds to a response's hidden parameters
TRANSIENT_STATUSES = {408: "timeout", 409: "conflict", 429: RATE_LIMITED}


@cache
def load_litellm() -> Any:
    """The library, told to send and to fetch nothing of its own. Raises TrapsError where it is not installed."""
    require("api")
    os.environ["LITELLM_MODE"] = "PRODUCTION"  # else it takes variables from a .env of any folder above
    os.environ["LITELLM_LOCAL_MODEL_COST_MAP"] = "True"
    os.environ["LITELLM_LOCAL_ANTHROPIC_BETA_HEADERS"] = "True"
    litellm: Any = import_module("litellm")
    warnings.filterwarnings("ignore", "Pydantic serializer warnings")  # of odd answers, which become outcomes here
    logging.getLogger("LiteLLM").setLevel(logging.ERROR)  # it warns at every call of Gemini 3 that has a temperature
    litellm.telemetry = False
    litellm.suppress_debug_info = True
    litellm.drop_params = False  # a parameter that a provider refuses is an error, never left out in silence
    litellm.callbacks = [_hook()]
    watch(import_module("litellm.llms.custom_httpx.http_handler").AsyncHTTPHandler)
    # Its import makes connections of its own, unwatched, and keeps them for whoever has the same time-out.
    litellm.in_memory_llm_clients_cache.flush_cache()
    return litellm


def _hook() -> Any:
    """What is done to a response before litellm goes on with it. Its bridge to OpenAI's Responses API loses a refusal
    in words, and which model answered, but hands hidden parameters on. A response that has a cost is not priced by its
    tables, which takes a tenth of a call's CPU time: prices are the registry's, this number is never read."""
    logger: Any = import_module("litellm.integrations.custom_logger").CustomLogger

    class Hook(logger):
        async def async_post_call_success_deployment_hook(self, _: Any, response: Any, call_type: Any) -> None:
            hidden: dict[str, Any] = response._hidden_params
            hidden["response_cost"] = -1.0
            if call_type == "aresponses":
                hidden |= {SERVED: response.model, REFUSAL: _refusal_of(response)}

    return Hook()


def _refusal_of(response: Any) -> str | None:
    """The words of a refusal in a response of the Responses API."""
    parts = [part for item in response.output for part in getattr(item, "content", None) or ()]
    return next((part.refusal for part in parts if getattr(part, "type", None) == "refusal"), None)


@cache
def _internal_call() -> Any:
    """litellm's own mark of a call that it need not log. Its log of every call, which nobody reads here, takes a sixth
    of a call's CPU time and lags behind, holding what was sent: 5 KB a call without media, without a bound."""
    return import_module("litellm._internal_context").is_internal_call


def media_parts(media: Media, route: str) -> list[dict[str, Any]]:
    """The message parts that carry a clip. Gemini drops a `video_url` without a word, and samples a video without
    metadata at 1 FPS: it gets a file part that says its rate."""
    uris = data_uris(media)
    if media.profile == "images":
        return [{"type": "image_url", "image_url": {"url": uri}} for uri in uris]
    if route in ("gemini", "vertex_ai"):
        file = {"file_data": uris[0], "format": "video/mp4", "video_metadata": {"fps": media.fps}}
        return [{"type": "file", "file": file}]
    return [{"type": "video_url", "video_url": {"url": uris[0]}, "fps": media.fps}]


def messages(entry: Entry, request: Request) -> list[dict[str, Any]]:
    """System prompt, then the clip and the question, nothing else (docs/spec.md 3.3)."""
    user: str | list[dict[str, Any]] = request.user
    if request.sent is not None:
        route = str(entry.provider_id).split("/")[0]
        user = [*media_parts(request.sent, route), {"type": "text", "text": request.user}]
    return [{"role": "system", "content": request.system}, {"role": "user", "content": user}]


class ApiBackend:
    """Asks one entry of the registry through litellm."""

    def __init__(self, entry: Entry, account: Account | None = None) -> None:
        account = account or load_accounts()[str(entry.account)]
        check_network()
        self._entry = entry
        self._fixed: dict[str, Any] = {
            "model": entry.provider_id,
            "api_key": account.secret() or "none",  # a client without a key would look for one in the environment
            "timeout": entry.limits.timeout_s,
            "num_retries": 0,
            "max_retries": 0,
            **({"api_base": account.base_url} if account.base_url else {}),
        }
        self._litellm = load_litellm()  # here, since its import takes seconds: no call's time-out runs yet
        self._told: set[str] = set()

    async def ask(self, request: Request) -> Outcome:
        """One attempt; see `Backend`."""
        asked, exchange = messages(self._entry, request), Exchange()
        _internal_call().set(True)
        watched = WATCHED.set(exchange)
        try:
            response = await self._litellm.acompletion(messages=asked, **request.params, **self._fixed)
            if exchange.status is None:  # a defect of ours, or of a new version of the client library
                self._tell("unseen", "the answer came over a connection that is not watched; its worst case is booked")
            return read_response(response, self._entry, request, exchange)
        except Exception as error:  # noqa: BLE001 - litellm's, the SDKs' and httpx's errors; and of shapes none expected
            return self._failure(error, exchange)
        finally:
            WATCHED.reset(watched)

    def _failure(self, error: Exception, exchange: Exchange) -> Outcome:
        """A failure as TransientError or as an outcome. Its text goes to a person, never into the ledger."""
        status = getattr(error, "status_code", None)
        billed = exchange.may_be_billed(status if isinstance(status, int) else None)
        free = None if billed else 0.0
        if isinstance(error, self._litellm.ContentPolicyViolationError):
            return Outcome("refused", error="content_policy", cost_usd=free)
        kind = failure_kind(error, self._litellm, exchange)
        if kind == "connection" and exchange.unsent:
            kind = UNREACHABLE
        if kind == MALFORMED:
            kept = redact((exchange.content or b"").decode("utf-8", "replace"))
            self._tell(kind, str(error) or type(error).__name__)
            raise TransientError(kind, raw=kept[:MOST_KEPT]) from None
        self._tell(kind, str(error))
        if kind.startswith("http_"):
            return Outcome("error", error=kind, cost_usd=free)
        raise TransientError(kind, retry_after_s(error), billed=billed) from None

    def _tell(self, kind: str, said: str) -> None:
        """Say once for each kind what the provider said, without the key."""
        if kind not in self._told:
            self._told.add(kind)
            said = redact(" ".join(said.split()))  # before it is cut
            progress.current().note(f"{self._entry.id}: {kind}: {plain(said)[:300]}")


def failure_kind(error: Exception, litellm: Any, exchange: Exchange) -> str:
    """What went wrong in a word: http_<status> is final, anything else is worth another try. A status that was seen
    counts more than what litellm makes of it."""
    if exchange.answered:
        return MALFORMED if exchange.content is not None else "connection"
    status = exchange.status
    if status is None:
        if isinstance(error, litellm.Timeout):
            return "timeout"
        if isinstance(error, litellm.APIConnectionError) or _broke_off(error):
            return "connection"
        status = getattr(error, "status_code", None)
    if not isinstance(status, int) or status < 300 or status == UNREADABLE:
        return "bad_response"
    if status in TRANSIENT_STATUSES:
        return TRANSIENT_STATUSES[status]
    return f"http_{status}" if status < 500 else "server_error"


def _broke_off(error: BaseException | None) -> bool:
    """Whether the connection failed below what litellm calls a server error: the answer may have been on its way."""
    while error is not None:
        if (
            type(error).__module__.split(".")[0] in ("httpx", "httpcore", "aiohttp")
            and "Status" not in type(error).__name__
        ):
            return True
        error = error.__cause__ or error.__context__
    return False


def retry_after_s(error: Exception) -> float | None:
    """Seconds that the provider asks to wait; None if it does not say so in seconds."""
    headers: Mapping[str, str] = getattr(error, "litellm_response_headers", None) or {}
    try:
        return max(0.0, float(headers.get("retry-after", "")))
    except ValueError:
        return None


def read_response(response: Any, entry: Entry, request: Request, exchange: Exchange) -> Outcome:
    """The outcome in a response: what is seen, what was thought, what it took. Raises what it does not understand,
    which is malformed: ValueError where something is of a type that it cannot have."""
    body = json.loads(exchange.content or b"null")
    choice = response.choices[0]
    message, finish = choice.message, _word(choice.finish_reason)
    text = _storable(_text(message.content)).strip()
    fields: Mapping[str, Any] = getattr(message, "provider_specific_fields", None) or {}
    hidden: Mapping[str, Any] = getattr(response, "_hidden_params", None) or {}
    refusal = _text(fields.get("refusal") or getattr(message, "refusal", None) or hidden.get(REFUSAL))
    kind = _kind(text, finish, refusal)
    prompt_bytes = len((request.system + request.user).encode("utf-8", "replace"))
    frames = request.sent.n_frames if request.sent else 0
    usage = read_usage(body, Sizes(prompt_bytes, frames, len((text or refusal).encode())))
    return Outcome(
        kind,
        text=text if kind in WITH_TEXT else None,
        reasoning=_storable(_text(getattr(message, "reasoning_content", None))) or None,
        finish_reason=finish,
        served_model=_word(hidden.get(SERVED) or getattr(response, "model", None)),
        prompt_tokens=usage and usage.prompt,
        completion_tokens=usage and usage.completion,
        reasoning_tokens=usage and usage.reasoning,
        cost_usd=_cost(entry, usage),
    )


def _text(value: Any) -> str:
    """A text that may be missing. Raises ValueError for anything else."""
    if value is None or isinstance(value, str):
        return value or ""
    raise ValueError(f"a text was expected, and not {type(value).__name__}")


def _word(value: Any) -> str | None:
    """What a provider says in a word, for a column of a table; None where it is none."""
    return _storable(value)[:MOST_NAME] if isinstance(value, str) else None


def _storable(text: str) -> str:
    """Text without halves of surrogate pairs, which a cut in the middle of an emoji leaves and no file takes."""
    return text.encode("utf-8", "replace").decode("utf-8")


def _cost(entry: Entry, usage: Usage | None) -> float | None:
    """Dollars; None where the price or what was used is unknown."""
    if entry.prices is None or usage is None:
        return None
    cost = entry.prices.cost(usage.prompt, usage.completion)
    return cost if math.isfinite(cost) else None


def _kind(text: str, finish: str | None, refusal: str) -> OutcomeKind:
    if refusal or finish in ("content_filter", "refusal"):
        return "refused"
    if not text:
        return "empty"
    return "truncated" if finish == "length" else "answer"
