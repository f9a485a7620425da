"""Remove keys from text before it is printed, logged, stored or displayed.

Secrets are the values of environment variables that hold keys: those that a registry names, those that a run has read
(`remember`), and those whose names say so. They are found verbatim, in any case, escaped, percent-encoded, in base64 or
in hexadecimal, also when white space, quotes or line breaks split them, and when either end is cut off.
"""

import logging
import os
import re
import sys
import threading
import traceback
import warnings
from base64 import b64encode
from collections.abc import Iterator
from functools import lru_cache
from html import unescape
from typing import Any

MASK = "***"
MIN_SECRET_LENGTH = 8  # characters: anything shorter could be an ordinary word
# A secret is looked for by pieces, one after another; what stands around a piece is compared with the secret. So each
# part of a secret that has as many characters as two pieces is found.
_PIECE = 6
_NAMES = re.compile(r"(KEY|TOKEN|SECRET|PASSWORD|PASSWD)$", re.IGNORECASE)
_PASSWORD = re.compile(r"://[^/\s:@]*:([^/\s@]+)@|\bpassword=([^\s&]+)")  # in an address of a database or a proxy
_EXAMPLE = "PASSWORD"  # placeholder in our own sentences
_ENCODED = re.compile(
    r"(?<!\\)\\+(?:[abfnrtv0]|x[0-9a-f]{2}|u[0-9a-f]{4}|U[0-9a-f]{8})|%(?:25)*[0-9a-f]{2}|&(?:amp|lt|gt|quot|apos|#\d{1,7}|#x[0-9a-f]{1,6});",
    re.IGNORECASE,
)
_IGNORED = bytes((*range(33), 127, *b"\"'`\\|"))
_VALUE = r"""(?=[^\s"'\\]{0,15}\d|[^\s"'\\]{16})[^\s"'\\,;&<>(){}\[\]]{6,}"""  # has a digit, or is longer than a word
# Secrets that no registry names: in a header, a parameter or an address.
_UNKNOWN = re.compile(
    r"""((?:\b(?:authorization|password)|api[-_]?key|secret|[?&](?:key|sig|access_token))"""
    rf"""["'\\]*\s*[:=,]\s*b?["'\\]*(?:(?:bearer|basic)\s+)?|\b(?:bearer|basic)\s+){_VALUE}"""
    r"""|(://[^/\s:@"']*:)(?!PASSWORD@)[^/\s@"']+(?=@)""",
    re.IGNORECASE,
)
_SIGNS = ("authorization", "api", "secret", "password", "key=", "sig=", "access_token=", "bearer", "basic", "://")

_variables = set[str]()
_values = set[str]()
# What the needles were made of, and the needles: the environment, and how many values and variables there were.


def redact_environment_variable(variable: str) -> None:
    """Treat the value of this environment variable as a secret."""
    _variables.add(variable)


def remember(value: str) -> None:
    """Treat this value as a secret until the process ends."""
    _values.add(value)


def redact(text: str) -> str:
    """Replace secrets, known or recognizable by their header, by `***`."""
    if len(text) < MIN_SECRET_LENGTH:  # most cells of a table
        return text
    environment = frozenset(os.environb.items())  # `os.environ` decodes each name and value anew
    secrets = _secrets(environment, frozenset(_variables), frozenset(_values))
    pieces, spans = _pieces(secrets), list[tuple[int, int]]()
    for is_decoded in (False, True) if _ENCODED.search(text) else (False,):
        search_text = _search_text(text, is_decoded)
        windows = (search_text[place : place + _PIECE] for place in range(len(search_text) - _PIECE + 1))
        if not pieces.keys().isdisjoint(windows):
            spans += _spans(text, pieces, is_decoded)
    starts, ends = zip(*_merge(spans), strict=True) if spans else ((), ())
    text = MASK.join(text[start:end] for start, end in zip((0, *ends), (*starts, None), strict=True))
    lower_text = text.lower()
    if any(sign in lower_text for sign in _SIGNS):  # searching with the expression alone takes ten times as long
        text = _UNKNOWN.sub(lambda match: f"{match[1] or match[2]}{MASK}", text)
    return text


def redact_tracebacks() -> None:
    """Redact this process's log records, tracebacks and warnings."""
    make = logging.getLogRecordFactory()
    if getattr(make, "__module__", "") == __name__:
        return

    def redacted_record(*args: Any, **named: Any) -> logging.LogRecord:
        record = make(*args, **named)
        try:
            message = record.getMessage()
        except (TypeError, ValueError):
            message = f"{record.msg} {record.args}"
        if (clean_message := redact(message)) != message:  # else it stays as it is: formatters read its arguments
            record.msg, record.args = clean_message, ()
        if record.exc_info and record.exc_info[0]:
            record.exc_text = redact("".join(traceback.format_exception(*record.exc_info)).rstrip())
        return record

    format_warning = warnings.formatwarning
    logging.setLogRecordFactory(redacted_record)
    warnings.formatwarning = lambda *args, **named: redact(format_warning(*args, **named))
    sys.excepthook = lambda *error: print(redact("".join(traceback.format_exception(*error))), end="", file=sys.stderr)
    # What a thread or a finalizer raises.
    threading.excepthook = sys.unraisablehook = lambda error: sys.excepthook(
        error.exc_type, error.exc_value or error.exc_type(), error.exc_traceback
    )


def redact_exception(error: Exception) -> Exception:
    """Return the exception, or a replacement if its traceback would show a key."""
    text = "".join(traceback.format_exception(error))
    clean_text = redact(text)
    return error if clean_text == text else RuntimeError(clean_text).with_traceback(error.__traceback__)


@lru_cache(maxsize=8)
def _secrets(
    environment: frozenset[tuple[bytes, bytes]], variables: frozenset[str], values: frozenset[str]
) -> frozenset[str]:
    secrets = {*values}
    for name, value in ((os.fsdecode(name), os.fsdecode(value)) for name, value in environment):
        is_address = "://" in value or "password=" in value
        if not is_address and (name in variables or _NAMES.search(name)):
            secrets.add(value)
        if is_address:
            groups = (group for match in _PASSWORD.finditer(value) for group in match.groups())
            secrets |= {group for group in groups if group not in (None, _EXAMPLE)}
    return frozenset(secrets)


@lru_cache(maxsize=64)
def _pieces(secrets: frozenset[str]) -> dict[str, list[tuple[str, int]]]:
    """Index the pieces of all secrets' forms: piece -> forms, each with its offset."""
    forms = set[str]()
    for secret in secrets:
        for part in {secret, *re.split(r"[^!-~]+", secret)}:
            if len(_search_text(part, is_decoded=False)) >= MIN_SECRET_LENGTH:
                forms |= {_search_text(part, is_decoded=False), _search_text(part, is_decoded=True), *_encodings(part)}
    pieces = dict[str, list[tuple[str, int]]]()
    for form in forms:
        places = range(0, len(form) - _PIECE + 1, _PIECE) if len(form) >= MIN_SECRET_LENGTH else ()
        for piece, place in {form[place : place + _PIECE]: place for place in reversed(places)}.items():
            pieces.setdefault(piece, []).append((form, place))
    return pieces


def _encodings(secret: str) -> Iterator[str]:
    """Yield a secret in hexadecimal, and inside base64 at each of three offsets."""
    content = secret.encode("utf-8", "surrogateescape")
    yield content.hex()
    for prefix_length, skip_length in ((0, 0), (1, 2), (2, 3)):
        encodings = (
            b64encode(bytes(prefix_length) + content)
            .decode()[skip_length : (prefix_length + len(content)) * 8 // 6]
            .lower()
        )
        yield from (encodings, encodings.replace("+", "-").replace("/", "_"))


def _search_text(text: str, is_decoded: bool) -> str:
    """Reduce a text to the lower-case printable ASCII characters to search."""
    if is_decoded:
        text = _ENCODED.sub(lambda match: _decode(match[0]), text)
    return text.encode("ascii", "ignore").translate(None, _IGNORED).lower().decode()


def _decode(code: str) -> str:
    if code[0] == "&":
        return unescape(code)
    if code[0] == "%":
        return chr(int(code[-2:], 16))
    digits = code.lstrip("\\")
    return chr(min(int(digits[1:], 16), 0xFFFF)) if digits[1:] else ""  # without digits it is a control character


def _spans(text: str, pieces: dict[str, list[tuple[str, int]]], is_decoded: bool) -> Iterator[tuple[int, int]]:
    """Yield the start and end of each secret, or part of one, in a text."""
    characters = list[str]()
    places = list[tuple[int, int]]()
    codes = {match.start(): match for match in _ENCODED.finditer(text)} if is_decoded else {}
    place = 0
    while place < len(text):
        code = codes.get(place)
        end = code.end() if code else place + 1
        for character in _search_text(_decode(code[0]) if code else text[place], is_decoded=False):
            characters.append(character)
            places.append((place, end))
        place = end
    search_text = "".join(characters)
    for piece, (form, place) in (
        (piece, candidate_match) for piece, matches in pieces.items() for candidate_match in matches
    ):
        start = search_text.find(piece)
        while start >= 0:
            prefix, candidate = (
                search_text[max(0, start - place) : start],
                search_text[start : start + len(form) - place],
            )
            first, last = (
                start - _common_prefix_length(prefix[::-1], form[:place][::-1]),
                start + _common_prefix_length(candidate, form[place:]),
            )
            is_part = last - first >= min(2 * _PIECE, len(form))
            if is_part:
                yield places[first][0], places[last - 1][1]
            start = search_text.find(piece, last if is_part else start + 1)


def _common_prefix_length(text: str, reference: str) -> int:
    """Return how many characters two texts have in common at their beginnings."""
    differences = (k for k, (char, other_char) in enumerate(zip(text, reference, strict=False)) if char != other_char)
    return next(differences, min(len(text), len(reference)))


def _merge(spans: list[tuple[int, int]]) -> list[tuple[int, int]]:
    result = list[tuple[int, int]]()
    for start, end in sorted(spans):
        if result and start <= result[-1][1]:
            result[-1] = result[-1][0], max(end, result[-1][1])
        else:
            result.append((start, end))
    return result
