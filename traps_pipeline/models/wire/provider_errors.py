"""Read a provider's error object, whatever its status, and its waiting time.

One reader serves OpenAI, Anthropic, Gemini and the proxies and servers that copy them.
"""

from __future__ import annotations

import json
import math
import re
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from datetime import datetime
from email.utils import parsedate_to_datetime
from typing import Any

# The words of the APIs (`code`, `type`, `status`), by the HTTP status that each stands for.
_STATUSES: dict[int, tuple[str, ...]] = {
    400: ("invalid_request_error", "invalid_argument", "failed_precondition", "invalid_prompt", "badrequesterror"),
    401: ("authentication_error", "unauthenticated", "invalid_api_key"),
    402: ("billing_error",),
    403: ("permission_error", "permission_denied"),
    404: ("not_found_error", "not_found", "model_not_found"),
    408: ("timeout",),
    409: ("aborted", "conflict"),
    413: ("request_too_large",),
    429: ("rate_limit_exceeded", "rate_limit_error", "resource_exhausted", "too_many_requests", "insufficient_quota"),
    500: ("server_error", "api_error", "internal", "internal_error", "internal_server_error"),
    503: ("overloaded", "unavailable", "service_unavailable"),
    504: ("deadline_exceeded", "timeout_error"),
    529: ("overloaded_error",),
}
_STATUS_OF = {word: status for status, words in _STATUSES.items() for word in words}
_FILTERED = re.compile(
    r"content_filter|content_policy|responsible_?ai_?policy|moderation|safety_violation|data_?inspection_?failed", re.I
)
_ABOUT_KEY = re.compile(r"\b(api[ _-]?keys?|keys?|tokens?|auth\w*|unauth\w*|credentials?|permissions?|access)\b", re.I)
_AMOUNT = re.compile(r"(\d{1,15}(?:\.\d{1,15})?)(ms|h|m|s)")
_UNIT_S = {"h": 3600.0, "m": 60.0, "s": 1.0, "ms": 0.001}


@dataclass(frozen=True)
class ProviderError:
    """An error object.

    status: the HTTP status that it carries or stands for, None if unknown; words: the provider's codes and types;
    details: other fields; is_beside_answer: whether the body also holds choices or a usage, so that something was
    generated.
    """

    message: str
    words: tuple[str, ...] = ()
    status: int | None = None
    details: tuple[Mapping[str, Any], ...] = ()
    is_beside_answer: bool = False

    @property
    def is_filtered(self) -> bool:
        """Whether a filter, a policy or a moderation refused the content."""
        return any(_FILTERED.search(word) for word in self.words) or any(
            "flagged_input" in detail for detail in self.details
        )

    @property
    def is_about_key(self) -> bool:
        """Whether a 401 or 403 with it is about the key; assumed if it has no words."""
        text = " ".join((self.message, *self.words)).replace("_", " ")
        return not text.strip() or bool(_ABOUT_KEY.search(text))

    def __str__(self) -> str:
        codes = [word for word in self.words if not word.isdigit() and word not in self.message]
        return (
            ": ".join(part for part in (", ".join(dict.fromkeys(codes)), self.message) if part) or "no reason is given"
        )


def read_error(content: bytes | None) -> ProviderError | None:
    """Return the error object in a body; None if it holds none, or is no JSON."""
    try:
        body = json.loads(content or b"null")
    except (ValueError, RecursionError):
        return None
    if isinstance(body, list):  # Gemini's streams
        body = next(iter(body), None)
    if not isinstance(body, Mapping):
        return None
    error = body.get("error") or _choice_error(body.get("choices"))
    if not error and (body.get("object") == "error" or _is_flat(body)):  # vLLM; gateways
        error = body
    if isinstance(error, str):
        provider_error = ProviderError(error, tuple(_words(body)), _status(body))
    else:
        provider_error = _read(error) if isinstance(error, Mapping) else None
    is_beside_answer = any(body.get(name) for name in ("choices", "usage", "usageMetadata"))
    return provider_error and replace(provider_error, is_beside_answer=is_beside_answer)


def _is_flat(body: Mapping[str, Any]) -> bool:
    """Return whether a body itself is an error: a message with a code, no answer."""
    return (
        isinstance(body.get("message"), str)
        and "code" in body
        and not body.keys() & {"choices", "output", "content", "candidates"}
    )


def _choice_error(choices: Any) -> Any:
    """Return an error in the place of a choice, as OpenRouter sends it."""
    first = choices[0] if isinstance(choices, list) and choices else None
    return first.get("error") if isinstance(first, Mapping) else None


def _read(error: Mapping[str, Any]) -> ProviderError:
    message = error.get("message") or error.get("detail")
    inner = error.get("innererror"), error.get("metadata")
    detail_list = error.get("details")
    listed_details = detail_list if isinstance(detail_list, list) else []
    details = tuple(detail for detail in (*inner, *listed_details) if isinstance(detail, Mapping))
    words = [word for detail in (error, *details) for word in _words(detail)]
    return ProviderError(message if isinstance(message, str) else "", tuple(words), _status(error), details)


def _words(error: Mapping[str, Any]) -> Iterator[str]:
    for name in ("code", "type", "status", "reason"):
        value = error.get(name)
        if isinstance(value, str) or type(value) is int:
            yield str(value)


def _status(error: Mapping[str, Any]) -> int | None:
    """Return an error object's numeric status, or the status that its words stand for."""
    words = list(_words(error))
    numbers = [int(word) for word in words if re.fullmatch(r"[45]\d\d", word)]
    statuses = [_STATUS_OF[word.lower()] for word in words if word.lower() in _STATUS_OF]
    return next(iter(numbers + statuses), None)


# --- how long to wait -------------------------------------------------------------------------------------------------


def retry_after_s(headers: Mapping[str, str], error: ProviderError | None = None) -> float | None:
    """Return the seconds that a provider asks to wait; None if it does not say.

    Read in this order: `retry-after-ms`, `retry-after` (seconds, "7s", a date), Gemini's RetryInfo, and the reset times
    of exhausted limits (`x-ratelimit-reset-*`, `anthropic-ratelimit-*-reset`).
    """
    values = {name.lower(): value.strip() for name, value in headers.items()}
    now = _date(values.get("date")) or time.time()
    milliseconds = _seconds(values.get("retry-after-ms"), now)
    if milliseconds is not None:
        return milliseconds / 1000
    delay_s = _seconds(values.get("retry-after"), now)
    if delay_s is None and error is not None:
        delays = [_seconds(detail.get("retryDelay"), now) for detail in error.details]
        delay_s = next((delay for delay in delays if delay is not None), None)
    return _reset_s(values, now) if delay_s is None else delay_s


def _reset_s(named: Mapping[str, str], now: float) -> float | None:
    seconds = []
    for name, value in named.items():
        if "ratelimit-remaining-" in name:
            reset_name = name.replace("-remaining-", "-reset-")
        elif "ratelimit" in name and name.endswith("-remaining"):
            reset_name = name.removesuffix("-remaining") + "-reset"
        else:
            continue
        wait = _seconds(named.get(reset_name), now)
        if value == "0" and wait is not None:
            seconds.append(wait)
    return max(seconds, default=None)


def _seconds(value: Any, now: float) -> float | None:
    """Parse a number, an amount ("1m30s") or a date into seconds; else None."""
    text = str(value).strip() if isinstance(value, str | int | float) else ""
    try:
        number = float(text)
    except ValueError:
        pass
    else:
        return number if math.isfinite(number) and number >= 0 else None
    if text and _AMOUNT.sub("", text) == "":
        return sum(float(amount) * _UNIT_S[unit] for amount, unit in _AMOUNT.findall(text))
    date = _date(text)
    return None if date is None else max(0.0, date - now)


def _date(text: str | None) -> float | None:
    for parse in (parsedate_to_datetime, datetime.fromisoformat):
        try:
            return parse(text or "").timestamp()
        except (ValueError, OverflowError):
            continue
    return None
