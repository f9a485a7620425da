"""Read a provider's error, whatever its status, and the time that it asks to wait.

Tables say where providers put them (`_PLACES`, `_WAIT_HEADERS`) and what their words mean (`_MEANINGS`).
"""

import json
import math
import re
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from email.utils import parsedate_to_datetime
from typing import Any, Literal

from traps_pipeline.models.wire.dialects import ANSWER_FIELDS, OddShapeError, parse_body

Json = Mapping[str, Any]
Meaning = int | Literal["used_up", "filtered"]  # an HTTP status, or what no status says
# Where errors stand, with the numbers that only this place knows and the meaning of each. The body itself is an error
# only without an answer: some gateways write `code` and `message` beside each.
_PLACES: Mapping[tuple[str | int, ...], Mapping[str, Meaning]] = {
    ("error",): {},  # OpenAI, Anthropic, Gemini, OpenRouter, Groq, Together, DeepSeek, DashScope, Moonshot
    ("choices", 0, "error"): {},  # OpenRouter, once a model has begun
    ("base_resp",): {  # MiniMax
        **{"1000": 500, "1001": 504, "1002": 429, "1004": 401, "1008": "used_up", "1013": 500, "1024": 500},
        **{"1026": "filtered", "1027": "filtered", "1033": 500, "1039": 429, "1041": 429, "1042": 400, "2013": 400},
        **{"2045": 429, "2049": 401, "2056": "used_up"},
    },
    ("errors", 0): {},  # Cloudflare
    (): {},  # vLLM and Mistral (`object: error`), DashScope's own API, Spark, Baidu (`error_code`), FastAPI (`detail`)
}
_MESSAGES = ("message", "msg", "status_msg", "error_msg", "detail")
_WORDS = ("code", "type", "status", "reason", "status_code", "error_code", "http_code")
_FINE = {"0", "200", "ok", "success", "succeeded", "none", "null", ""}  # codes of an error object that reports none
# The words of the APIs, by what each stands for. Numbers are Zhipu's.
_MEANINGS: Mapping[Meaning, tuple[str, ...]] = {
    400: ("invalid_request_error", "invalid_argument", "failed_precondition", "invalid_prompt", "badrequesterror"),
    401: ("authentication_error", "unauthenticated", "invalid_api_key", "invalid_authentication_error"),
    403: ("permission_error", "permission_denied"),
    404: ("not_found_error", "not_found", "model_not_found", "1211"),
    408: ("timeout",),
    409: ("aborted", "conflict"),
    413: ("request_too_large",),
    429: (
        *("rate_limit_exceeded", "rate_limit_error", "resource_exhausted", "too_many_requests", "throttling"),
        *("throttling.ratequota", "throttling.allocationquota", "slow_down", "rate_limit_reached_error"),
        *("1302", "1303", "1305", "1312"),
    ),
    500: ("server_error", "api_error", "internal", "internal_error", "internal_server_error"),
    503: ("overloaded", "unavailable", "service_unavailable", "engine_overloaded_error"),
    504: ("deadline_exceeded", "timeout_error"),
    529: ("overloaded_error",),
    "used_up": (  # credit or quota, which no wait brings back; most send it as a 429
        *("insufficient_quota", "billing_hard_limit_reached", "billing_not_active", "account_deactivated"),  # OpenAI
        *("credit_balance_exhausted", "organization_spend_limit_exceeded", "project_spend_limit_exceeded"),
        *("organization_usage_limit_exceeded", "billing_error"),  # OpenAI; Anthropic
        *("exceeded_current_quota_error", "arrearage", "allocationquota.freetieronly"),  # Moonshot, DashScope
        *("insufficient_balance", "insufficient_credits", "credit_limit", "payment_required"),  # DeepSeek, Together
        *("1113", "1304", "1308", "1309", "1310"),
    ),
}
_MEANING_OF: Mapping[str, Meaning] = {word: meaning for meaning, words in _MEANINGS.items() for word in words}
_FILTER_WORDS = re.compile(
    r"content_?filter|content_policy|responsible_?ai_?policy|moderation|safety_violation|data_?inspection_?failed|^1301$",
    re.I,
)
_FILTER_MESSAGES = re.compile(r"new_sensitive|content exists risk", re.I)  # MiniMax, DeepSeek, whose words say nothing
_ABOUT_KEY = re.compile(r"\b(api[ _-]?keys?|keys?|tokens?|auth\w*|unauth\w*|credentials?|permissions?|access)\b", re.I)
# DashScope words a limit of tokens a minute as a used-up quota, and links this anchor of its documentation.
_PASSES = "#token-limit"


@dataclass(frozen=True)
class ProviderError:
    """An error that a provider reports in the body of its response.

    words: its codes and types; status: the HTTP status that it carries or stands for, None if unknown; details: the
    error object and those in it; is_filtered: whether a filter, a policy or a moderation refused the content;
    is_used_up: whether credit or quota is; is_beside_answer: whether something was generated; usage: as it is counted.
    """

    message: str
    words: tuple[str, ...] = ()
    status: int | None = None
    details: tuple[Json, ...] = ()
    is_filtered: bool = False
    is_used_up: bool = False
    is_beside_answer: bool = False
    usage: Json = field(default_factory=dict)

    @property
    def is_about_key(self) -> bool:
        """Whether a 401 or 403 with this error is about the key; assumed if it has no words."""
        text = " ".join((self.message, *self.words)).replace("_", " ")
        return not text.strip() or bool(_ABOUT_KEY.search(text))

    def __str__(self) -> str:
        codes = [word for word in self.words if not word.isdigit() and word not in self.message]
        return (
            ": ".join(part for part in (", ".join(dict.fromkeys(codes)), self.message) if part) or "no reason is given"
        )


def read_error(content: bytes | None) -> ProviderError | None:
    """Return the error in a body; None if it holds none, or is no JSON."""
    try:
        body = parse_body(content or b"")
    except OddShapeError:
        return None
    is_answer = any(body.get(name) for name in ANSWER_FIELDS)
    usage = next((value for name in ("usage", "usageMetadata") if isinstance(value := body.get(name), dict)), {})
    for path, codes in _PLACES.items():
        error = _at(body, path)
        if isinstance(error, str):  # Ollama, TGI, which has a code beside it
            error = {name: body.get(name) for name in _WORDS} | {"message": error}
        if not isinstance(error, dict) or (not path and (is_answer or not _is_error(error))):
            continue
        is_beside_answer = is_answer or any(type(count) is int and count > 0 for count in usage.values())
        if (provider_error := _read(error, codes)) is not None:
            return replace(provider_error, is_beside_answer=is_beside_answer, usage=usage)
    return None


def _at(value: Any, path: tuple[str | int, ...]) -> Any:
    for step in path:
        if isinstance(value, dict):
            value = value.get(step)
        elif isinstance(value, list) and value:
            value = value[0]
        else:
            return None
    return value


def _is_error(body: Json) -> bool:
    """Return whether a body without an answer is itself an error: a message with a code."""
    has_message = any(isinstance(body.get(name), str) for name in _MESSAGES) and any(_words(body))
    return has_message or body.get("object") == "error" or bool(body.get("detail"))


def _read(error: Json, codes: Mapping[str, Meaning]) -> ProviderError | None:
    """Return an error object; None if it reports that all is well."""
    inner, listed = (error.get("innererror"), error.get("metadata")), error.get("details")
    candidates = (error, *inner, *(listed if isinstance(listed, list) else ()))
    details = tuple(detail for detail in candidates if isinstance(detail, dict))
    words = tuple(word for detail in details for word in _words(detail))
    text = next((error[name] for name in _MESSAGES if error.get(name)), "")
    message = text if isinstance(text, str) else json.dumps(text)
    if all(word.lower() in _FINE for word in words) and (words or not message):
        return None
    known = [codes.get(word) or _MEANING_OF.get(word.lower()) for word in words]
    meanings = [*(int(word) for word in words if re.fullmatch(r"[45]\d\d", word)), *known]
    return ProviderError(
        message,
        words,
        next((meaning for meaning in meanings if isinstance(meaning, int)), None),
        details,
        is_filtered="filtered" in meanings
        or any(map(_FILTER_WORDS.search, words))
        or _FILTER_MESSAGES.search(message) is not None
        or any("flagged_input" in detail for detail in details),
        is_used_up="used_up" in meanings and _PASSES not in message,
    )


def _words(error: Json) -> Iterator[str]:
    for name in _WORDS:
        value = error.get(name)
        if isinstance(value, str) or type(value) is int:
            yield str(value)


# --- how long to wait -------------------------------------------------------------------------------------------------

# Where a wait stands, with its unit in seconds: in headers, and in an error object or what is in it. Headers that say
# when a limit is renewed have "limit" and "reset" in their names, and "remaining" in place of "reset" what is left.
_WAIT_HEADERS = {"retry-after-ms": 1e-3, "x-ms-retry-after-ms": 1e-3, "retry-after": 1.0, "x-retry-after": 1.0}
_WAIT_HEADERS |= {"x-ratelimit-retry-after": 1.0}
_WAIT_FIELDS = {"retryDelay": 1.0, "retry_after_ms": 1e-3, "retry_after": 1.0, "retry_after_seconds": 1.0}
_WAIT_FIELDS |= {"retryAfter": 1.0, "reset_at": 1.0}  # above, `retryDelay` is Gemini's
_WAIT_MESSAGE = re.compile(r"\b(?:try again|retry) (?:in|after) ((?:\d{1,9}(?:\.\d{1,9})? ?[a-z]{1,12} ?){1,4})", re.I)
_QUOTA = re.compile(r"\br=(-?\d{1,18})\b[^,]{0,200}?\bt=(\d{1,18})")  # of the header RateLimit
_AMOUNT = re.compile(r"(\d{1,15}(?:\.\d{1,15})?) ?([a-z\u00b5]{1,12}) ?", re.I)
_UNITS = (("d", 86400.0), ("h", 3600.0), ("m", 60.0), ("s", 1.0), ("ms", 1e-3), ("us", 1e-6), ("\u00b5s", 1e-6))
_UNITS += (("ns", 1e-9), ("day", 86400.0), ("hour", 3600.0), ("hr", 3600.0), ("minute", 60.0), ("min", 60.0))
_UNITS += (("second", 1.0), ("sec", 1.0), ("millisecond", 1e-3))
_SECONDS_OF = {name + plural: seconds for name, seconds in _UNITS for plural in ("", "s")[: len(name)]}
_TIME = 1e9  # a number above it is a time since 1970, in seconds or in thousandths, millionths of one


def retry_after_s(headers: Mapping[str, str], error: ProviderError | None = None) -> float | None:
    """Return the seconds that a provider asks to wait; None if it does not say.

    Read in this order: headers and fields that say it, the latest reset of an exhausted limit, words of the message.
    Headers may also stand in an error object (OpenRouter: `error.metadata.headers`).
    """
    details = error.details if error else ()
    values: dict[str, str] = {}
    for holder in (*(detail.get("headers") for detail in details), headers):
        if isinstance(holder, Mapping):
            values |= {str(name).lower(): str(value).strip() for name, value in holder.items()}
    now = _date(values.get("date", "")) or time.time()
    stated = [_seconds(values.get(name), now, unit) for name, unit in _WAIT_HEADERS.items()]
    stated += [_seconds(detail.get(name), now, unit) for detail in details for name, unit in _WAIT_FIELDS.items()]
    if (wait_s := next((seconds for seconds in stated if seconds is not None), None)) is not None:
        return wait_s
    if resets := [*_resets_s(values, now)]:
        return max(resets)
    match = _WAIT_MESSAGE.search(error.message[:2000]) if error else None
    return _seconds(match[1], now) if match else None


def _resets_s(values: Mapping[str, str], now: float) -> Iterator[float]:
    """Yield the seconds until each exhausted limit is renewed."""
    for name, value in values.items():
        if "limit" in name and "reset" in name:
            remaining = _seconds(values.get(name.replace("reset", "remaining"), "0"), now)
            wait_s = _seconds(value, now)
            if wait_s is not None and remaining is not None and remaining <= 0:
                yield wait_s
    for remaining, seconds in _QUOTA.findall(values.get("ratelimit", "")[:2000]):
        if int(remaining) <= 0:
            yield float(seconds)


def _seconds(value: Any, now: float, unit: float = 1.0) -> float | None:
    """Parse a number of units, an amount ("1m30s"), or a point in time into seconds; else None."""
    text = str(value).strip()[:100] if isinstance(value, str | int | float) else ""
    try:
        number = float(text)
    except ValueError:
        pass
    else:
        while abs(number) > _TIME * 1e3 and math.isfinite(number):
            number /= 1e3
        wait_s = number - now if number > _TIME else number * unit
        return max(0.0, wait_s) if math.isfinite(number) and number >= 0 else None
    amounts = _AMOUNT.findall(text)
    units = [_SECONDS_OF.get(name.lower()) for _, name in amounts]
    if amounts and None not in units and not _AMOUNT.sub("", text).strip():
        return sum(float(amount) * (seconds or 0.0) for (amount, _), seconds in zip(amounts, units, strict=True))
    date = _date(text)
    return None if date is None else max(0.0, date - now)


def _date(text: str) -> float | None:
    for parse in (parsedate_to_datetime, datetime.fromisoformat):
        try:
            date = parse(text)
            return (date if date.tzinfo else date.replace(tzinfo=UTC)).timestamp()
        except (ValueError, OverflowError):
            continue
    return None
