"""Models over the network, through litellm: one attempt a call, exactly the declared parameters, typed outcomes.

Retries, pace and money are not here (`ask`). litellm is imported when first asked: it takes seconds and would fetch a
price list from the network.
"""

from __future__ import annotations

import logging
import os
from collections.abc import Mapping
from functools import cache
from importlib import import_module
from typing import Any

from traps_pipeline import progress
from traps_pipeline.models.registry import Account, Entry, load_accounts
from traps_pipeline.models.request import JUDGED, RATE_LIMITED, Outcome, OutcomeKind, Request, TransientError
from traps_pipeline.storage.media import Media, data_uris

UNREADABLE = 422  # what litellm makes of a page that is no JSON; no provider here sends it
SERVED, REFUSAL = "traps_served_model", "traps_refusal"  # what the hook adds to a response's hidden parameters
TRANSIENT_STATUSES = {408: "timeout", 409: "conflict", 429: RATE_LIMITED}


@cache
def load_litellm() -> Any:
    """The library, told to send and to fetch nothing of its own."""
    os.environ["LITELLM_LOCAL_MODEL_COST_MAP"] = "True"
    os.environ["LITELLM_LOCAL_ANTHROPIC_BETA_HEADERS"] = "True"
    litellm: Any = import_module("litellm")
    logging.getLogger("LiteLLM").setLevel(logging.ERROR)  # it warns at every call of Gemini 3 that has a temperature
    litellm.telemetry = False
    litellm.suppress_debug_info = True
    litellm.drop_params = False  # a parameter that a provider refuses is an error, never left out in silence
    litellm.callbacks = [_hook()]
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
        self._entry, self._secret = entry, account.secret()
        self._fixed: dict[str, Any] = {
            "model": entry.provider_id,
            "api_key": self._secret or "none",  # a client without a key would look for one in the environment
            "timeout": entry.limits.timeout_s,
            "num_retries": 0,
            "max_retries": 0,
            **({"api_base": account.base_url} if account.base_url else {}),
        }
        self._told: set[str] = set()

    async def ask(self, request: Request) -> Outcome:
        """One attempt; see `Backend`."""
        litellm, asked = load_litellm(), messages(self._entry, request)
        _internal_call().set(True)
        try:
            response = await litellm.acompletion(messages=asked, **request.params, **self._fixed)
        except Exception as error:  # noqa: BLE001 - litellm raises its own, the SDKs' and httpx's errors
            return self._failure(error, litellm)
        return read_response(response, self._entry)

    def _failure(self, error: Exception, litellm: Any) -> Outcome:
        """A failure as TransientError or as an outcome. Its text goes to a person, never into the ledger."""
        if isinstance(error, litellm.ContentPolicyViolationError):
            return Outcome("refused", error="content_policy", cost_usd=0.0)
        kind = failure_kind(error, litellm)
        self._tell(kind, error)
        if kind.startswith("http_4"):
            return Outcome("error", error=kind)
        raise TransientError(kind, retry_after_s(error)) from None

    def _tell(self, kind: str, error: Exception) -> None:
        """Say once for each kind what the provider said, without the key."""
        if kind in self._told:
            return
        self._told.add(kind)
        text = " ".join(str(error).split())
        text = text.replace(self._secret, "***") if self._secret else text  # before it is cut: a cut key is a key
        progress.current().note(f"{self._entry.id}: {kind}: {text[:300]}")


def failure_kind(error: Exception, litellm: Any) -> str:
    """What went wrong in a word: http_<status> is final, anything else is worth another try."""
    if isinstance(error, litellm.Timeout):
        return "timeout"
    if isinstance(error, litellm.APIConnectionError) or _broke_off(error):
        return "connection"
    status = getattr(error, "status_code", None)
    if not isinstance(status, int) or status < 400 or status == UNREADABLE:
        return "bad_response"
    if status in TRANSIENT_STATUSES:
        return TRANSIENT_STATUSES[status]
    return f"http_{status}" if 400 <= status < 500 else "server_error"


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


def read_response(response: Any, entry: Entry) -> Outcome:
    """The outcome in a response: what is seen, what was thought, what it took."""
    if not response.choices:
        raise TransientError("bad_response")
    choice = response.choices[0]
    message, finish = choice.message, choice.finish_reason
    text = _storable((message.content or "").strip())
    usage = getattr(response, "usage", None)
    prompt, completion = (getattr(usage, f"{kind}_tokens", None) for kind in ("prompt", "completion"))
    if not prompt:  # litellm makes zeros of a usage that is not there; no prompt is empty
        prompt = completion = None
    details = getattr(usage, "completion_tokens_details", None)
    fields: Mapping[str, Any] = getattr(message, "provider_specific_fields", None) or {}
    hidden: Mapping[str, Any] = getattr(response, "_hidden_params", None) or {}
    refusal = fields.get("refusal") or getattr(message, "refusal", None) or hidden.get(REFUSAL)
    kind = _kind(text, finish, refusal)
    return Outcome(
        kind,
        text=text if kind in JUDGED else None,
        reasoning=_storable(getattr(message, "reasoning_content", None) or "") or None,
        finish_reason=finish,
        served_model=hidden.get(SERVED) or getattr(response, "model", None),
        prompt_tokens=prompt,
        completion_tokens=completion,
        reasoning_tokens=getattr(details, "reasoning_tokens", None),
        cost_usd=_cost(entry, prompt, completion),
    )


def _storable(text: str) -> str:
    """Text without halves of surrogate pairs, which a cut in the middle of an emoji leaves and no file takes."""
    return text.encode("utf-8", "replace").decode("utf-8")


def _cost(entry: Entry, prompt_tokens: int | None, completion_tokens: int | None) -> float | None:
    """Dollars; None where the price or what was used is unknown."""
    if entry.prices is None or prompt_tokens is None or completion_tokens is None:
        return None
    return entry.prices.cost(prompt_tokens, completion_tokens)


def _kind(text: str, finish: str | None, refusal: str | None) -> OutcomeKind:
    if refusal or finish in ("content_filter", "refusal"):
        return "refused"
    if not text:
        return "empty"
    return "truncated" if finish == "length" else "answer"
