"""Call network models through litellm: one attempt, declared parameters, outcomes.

Retries, pace and money are handled elsewhere (`ask`). litellm is imported on the first call: it takes seconds and would
fetch a price list from the network.
"""

import logging
import os
import warnings
from collections.abc import Mapping
from functools import cache
from importlib import import_module
from importlib.metadata import version
from typing import Any

from traps_pipeline.base import progress
from traps_pipeline.base.extras import require_extra
from traps_pipeline.base.redaction import redact
from traps_pipeline.base.terminal import plain
from traps_pipeline.base.wording import count_noun
from traps_pipeline.models.money.budget import worst_case_usd
from traps_pipeline.models.reading.endings import Ending
from traps_pipeline.models.reading.first_token import stored_alternatives
from traps_pipeline.models.registry.accounts import Account
from traps_pipeline.models.registry.entries import Entry, load_accounts
from traps_pipeline.models.request import (
    MALFORMED,
    RATE_LIMITED,
    UNFINISHED,
    UNREACHABLE,
    WITH_TEXT,
    Outcome,
    OutcomeKind,
    Request,
    TransientError,
)
from traps_pipeline.models.wire.dialects import OddShapeError, Reply, parse_body, read_reply
from traps_pipeline.models.wire.exchange import Exchange, record_exchange
from traps_pipeline.models.wire.provider_errors import ProviderError, read_error, retry_after_s
from traps_pipeline.models.wire.usage import Sizes, Usage, read_usage
from traps_pipeline.storage.media import Media, data_uris

UNKNOWN_ERROR = 500  # default status of an error object in a 200
REFUSED_CONTENT = "content_policy"  # the error of a call stopped by a provider's content filter
USED_UP = "http_402"  # the error of a call without credit or quota, whatever its status
DENIED = "http_403_denied"  # the error of a 403 that is not about the key
MAX_KEPT = 4000  # characters of a malformed answer
# Message for people, by kind of failure.
_HAPPENED = {
    RATE_LIMITED: "asked too fast",
    UNREACHABLE: "not reached",
    MALFORMED: "its answer cannot be read",
    REFUSED_CONTENT: "its filter refused the content",
    DENIED: "it denies access",
    "server_error": "its server failed",
    "timeout": "no answer in time",
    "connection": "the connection broke",
    "ended": "its answer broke off",
    "usage": "its count of tokens is not believed",
    USED_UP: "its credit or quota is used up",
    "http_401": "it does not accept the key",
    "http_404": "it knows no such model or address",
}
TRANSIENT_STATUSES = {408: "timeout", 409: "conflict", 429: RATE_LIMITED}


@cache
def load_litellm() -> Any:
    """Return litellm, set to send and fetch nothing itself. Raises TrapsError."""
    require_extra("api")
    from traps_pipeline.models.wire.httpx_transport import use_transport_in

    os.environ["LITELLM_MODE"] = "PRODUCTION"  # otherwise it loads a .env file from any folder above
    os.environ["LITELLM_LOCAL_MODEL_COST_MAP"] = "True"
    os.environ["LITELLM_LOCAL_ANTHROPIC_BETA_HEADERS"] = "True"
    litellm: Any = import_module("litellm")
    warnings.filterwarnings("ignore", "Pydantic serializer warnings")  # malformed answers become outcomes here
    warnings.filterwarnings("ignore", "coroutine 'OpenAIChatCompletion")  # about calls cancelled before they began
    logging.getLogger("LiteLLM").setLevel(logging.ERROR)  # it warns at every call of Gemini 3 that has a temperature
    litellm.telemetry = False
    litellm.suppress_debug_info = True
    litellm.drop_params = False  # a parameter that a provider refuses is an error, never silently dropped
    litellm.callbacks = [_hook()]
    use_transport_in(import_module("litellm.llms.custom_httpx.http_handler").AsyncHTTPHandler)
    # Its import opens unwatched connections, and keeps them for callers with the same time-out.
    litellm.in_memory_llm_clients_cache.flush_cache()
    return litellm


def _hook() -> Any:
    """Return the hook that keeps litellm from pricing responses, a tenth of a call's CPU time, by its own tables."""
    logger: Any = import_module("litellm.integrations.custom_logger").CustomLogger

    class Hook(logger):
        async def async_post_call_success_deployment_hook(self, _: Any, response: Any, call_type: Any) -> None:
            response._hidden_params["response_cost"] = -1.0

    return Hook()


@cache
def client_version() -> str:
    """Return name and version of the library that builds and sends calls."""
    return f"litellm {version('litellm')}"


@cache
def _internal_call() -> Any:
    """Return litellm's mark of a call that it need not log: its log takes CPU time, and holds what was sent."""
    return import_module("litellm._internal_context").is_internal_call


def media_parts(media: Media, route: str) -> list[dict[str, Any]]:
    """Return the message parts that carry a clip.

    Gemini silently drops a `video_url`, and samples a video without metadata at 1 FPS: it gets a file part that states
    its rate.
    """
    uris = data_uris(media)
    if media.profile == "images":
        return [{"type": "image_url", "image_url": {"url": uri}} for uri in uris]
    if route in ("gemini", "vertex_ai"):
        file = {"file_data": uris[0], "format": "video/mp4", "video_metadata": {"fps": media.fps}}
        return [{"type": "file", "file": file}]
    return [{"type": "video_url", "video_url": {"url": uris[0]}, "fps": media.fps}]


def messages(entry: Entry, request: Request) -> list[dict[str, Any]]:
    """Return the messages of a call: system prompt, then clip and question, nothing else (docs/spec.md 3.3)."""
    user: str | list[dict[str, Any]] = request.user
    if request.sent is not None:
        route = str(entry.provider_id).split("/")[0]
        user = [*media_parts(request.sent, route), {"type": "text", "text": request.user}]
    return [{"role": "system", "content": request.system}, {"role": "user", "content": user}]


class ApiBackend:
    """A backend that asks one entry of the registry through litellm."""

    def __init__(self, entry: Entry, account: Account | None = None) -> None:
        account = account or load_accounts()[str(entry.account)]
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
        """Return the outcome of one attempt to answer a request."""
        prompt = messages(self._entry, request)
        _internal_call().set(True)
        with record_exchange() as exchange:
            exchange.sent = False  # until the wire says otherwise
            try:
                await self._litellm.acompletion(messages=prompt, **request.params, **self._fixed)
            except Exception as error:  # noqa: BLE001 - litellm's, the SDKs' and httpx's errors
                if not exchange.is_answered or exchange.content is None:
                    return self._failure(error, request, exchange)
            if exchange.status is None:  # a bug of ours, or of a new version of the client library
                exchange.sent = None
            elif (provider_error := read_error(exchange.content)) is not None:
                return self._provider_outcome(provider_error, request, exchange)
            return self._read(request, exchange)  # whatever exception the library raises for it

    def _read(self, request: Request, exchange: Exchange) -> Outcome:
        """Return the outcome from the provider's own bytes."""
        if exchange.content is None:  # a bug of ours, or a litellm route with its own connections
            raise self._malformed_error(
                "the answer came over a connection that is not watched, so its bytes cannot be read"
            )
        try:
            body = parse_body(exchange.content)
            reply = read_reply(body, str(self._entry.provider_id))
        except OddShapeError as error:
            raise self._malformed_error(str(error), exchange.content) from None
        if reply.ending == "transient":
            self._tell("ended", f"its answer ended with {reply.finish!r}", passes=True)
            cost_usd = self._outcome(reply, request).cost_usd
            raise TransientError(f"ended_{reply.finish.strip().lower()}", cost_usd=cost_usd)
        return self._outcome(reply, request)

    def _malformed_error(self, why: str, content: bytes = b"") -> TransientError:
        self._tell(MALFORMED, why, passes=True)
        raw = redact(content.decode("utf-8", "replace"))[:MAX_KEPT]
        return TransientError(MALFORMED, raw=raw, why=redact(why))

    def _outcome(self, reply: Reply, request: Request) -> Outcome:
        """Return the outcome of an answer: visible text, thinking, and usage."""
        usage = read_usage(reply.usage, _sizes(request, reply.text or reply.reasoning))
        believed_usage = usage if usage and usage.believed else None
        kind = _kind(reply)
        return Outcome(
            kind,
            text=reply.text if kind in (*WITH_TEXT, UNFINISHED) else None,
            reasoning=reply.reasoning or None,
            finish_reason=reply.finish,
            served_model=reply.served_model,
            client=client_version(),
            prompt_tokens=believed_usage and believed_usage.prompt,
            completion_tokens=believed_usage and believed_usage.completion,
            reasoning_tokens=believed_usage and believed_usage.reasoning,
            cost_usd=self._cost(usage, request),
            first_token=stored_alternatives(reply.first_token, request.about.get("regime")),
        )

    def _cost(self, usage: Usage | None, request: Request) -> float | None:
        """Return dollars; None if price or usage is unknown, and at least the worst case for an implausible usage."""
        if self._entry.prices is None or usage is None:
            return None
        cost, worst_usd = self._entry.prices.cost(usage.prompt, usage.completion), worst_case_usd(self._entry, request)
        if not usage.believed and cost > worst_usd:
            counts = f"{usage.prompt} tokens of prompt and {usage.completion} of the answer"
            self._tell("usage", f"contradicts itself; the most that it says is booked, {counts}")
        return cost if usage.believed else max(cost, worst_usd)

    def _failure(self, error: Exception, request: Request, exchange: Exchange) -> Outcome:
        """Return a failure as an outcome, without its text, or raise it as TransientError."""
        from traps_pipeline.models.wire.httpx_transport import cause_of

        if exchange.is_unsent:
            reason = redact(plain(exchange.problem or cause_of(error)))
            self._tell(UNREACHABLE, reason, passes=True)
            raise TransientError(UNREACHABLE, billed=False, why=reason) from None
        provider_error = read_error(exchange.content)
        if provider_error is not None or (exchange.status is not None and not exchange.is_answered):
            return self._provider_outcome(provider_error, request, exchange)
        if exchange.is_unreadable:
            raise self._malformed_error(str(exchange.problem)) from None
        kind = "timeout" if isinstance(error, self._litellm.Timeout) else "connection"
        self._tell(kind, exchange.problem or cause_of(error), passes=True)
        raise TransientError(kind) from None

    def _provider_outcome(self, error: ProviderError | None, request: Request, exchange: Exchange) -> Outcome:
        """Return a provider's error (None: the body holds none) as an outcome, or raise it as TransientError."""
        provider_error = error or ProviderError(self._quote_beginning(exchange))
        status = (provider_error.status or UNKNOWN_ERROR) if exchange.is_answered else exchange.status
        assert status is not None
        is_explained = error is not None and not error.is_beside_answer
        is_billed = exchange.is_billable(status, is_explained=is_explained)
        wait_s = retry_after_s(exchange.headers, provider_error)
        if provider_error.is_used_up and wait_s is None:
            status = int(USED_UP.removeprefix("http_"))
        origin = " (an error object in an HTTP 200)" if exchange.is_answered else ""
        origin += f" (through the proxy of {exchange.proxy})" if exchange.proxy else ""
        if provider_error.is_filtered and status not in TRANSIENT_STATUSES:
            self._tell(REFUSED_CONTENT, f"{provider_error}{origin}")
            usage = read_usage(provider_error.usage, _sizes(request, ""))
            return Outcome("refused", error=REFUSED_CONTENT, cost_usd=self._cost(usage, request) if is_billed else 0.0)
        kind = failure_kind(status, provider_error)
        is_final = kind.startswith("http_")
        self._tell(kind, f"{provider_error}{origin}", passes=not is_final)
        if is_final:
            return Outcome("error", error=kind, cost_usd=None if is_billed else 0.0)
        raise TransientError(kind, wait_s, billed=is_billed) from None

    def _quote_beginning(self, exchange: Exchange) -> str:
        """Return the beginning of an answer without an error object, for people."""
        text = redact((exchange.content or b"").decode("utf-8", "replace"))  # before it is cut
        if 300 <= (exchange.status or 0) < 400:
            target = redact(exchange.headers.get("location", "nowhere"))
            return f"HTTP {exchange.status} to {target}: no redirect is followed, name the right address as `base_url`"
        kind = exchange.headers.get("content-type", "no content type").partition(";")[0]
        quotation = f", beginning {text[:60]!r}" if text.strip() else ""
        return f"HTTP {exchange.status}, {kind}, {len(exchange.content or b'')} bytes{quotation}"

    def _tell(self, kind: str, message: str, *, passes: bool | None = None) -> None:
        """Report a message once per kind, without the key, and whether a retry may help (None: no need)."""
        if kind not in self._told:
            self._told.add(kind)
            message = redact(" ".join(message.split())).removeprefix(f"{kind}: ")  # before it is cut
            event_text = _HAPPENED.get(kind, "a call failed")
            max_retries = self._entry.limits.retries if passes else 0
            retries = min(max_retries, 1) if kind == MALFORMED else max_retries
            retry_text = f"again, at most {count_noun(retries, 'time')}" if retries else "only once"
            retry_note = "" if passes is None else f"; a run tries such a call {retry_text}"
            progress.current().note(f"{self._entry.id}: {event_text}{retry_note} ({kind}: {plain(message)[:300]})")


def failure_kind(status: int, reported: ProviderError) -> str:
    """Return a failure's kind: http_<status> if final, anything else if worth a retry."""
    if status in TRANSIENT_STATUSES:
        return TRANSIENT_STATUSES[status]
    if status >= 500:
        return "server_error"
    return DENIED if status == 403 and not reported.is_about_key else f"http_{status}"


def _sizes(request: Request, text: str) -> Sizes:
    """Return our measure of a call whose answer has this text."""
    prompt_bytes = len((request.system + request.user).encode("utf-8", "replace"))
    return Sizes(prompt_bytes, request.sent.n_frames if request.sent else 0, len(text.encode()))


def _kind(reply: Reply) -> OutcomeKind:
    if reply.refusal or reply.ending == "refused":
        return "refused"
    if not reply.text:
        return "empty"
    kinds: Mapping[Ending, OutcomeKind] = {"complete": "answer", "truncated": "truncated"}
    return kinds.get(reply.ending, UNFINISHED)
