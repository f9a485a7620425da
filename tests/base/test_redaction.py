"""A key is found in any text, in whatever form libraries and servers write it."""

from __future__ import annotations

import base64
import json
import os
import subprocess
import sys
import textwrap
from collections.abc import Callable
from urllib.parse import quote, quote_plus

import pytest

from tests.conftest import ROOT
from traps_pipeline.base import redaction
from traps_pipeline.base.redaction import redact

KEY = "sk-Test+7/aZ%41'q$9\"wE&x=Lm"
FORMS: dict[str, Callable[[str], str]] = {
    "as it stands": str,
    "repr": repr,
    "repr of bytes": lambda key: repr(key.encode("utf-8", "surrogateescape")),
    "repr of a repr": lambda key: repr([repr(key)]),
    "json": json.dumps,
    "json in json": lambda key: json.dumps(json.dumps({"key": key})),
    "percent": lambda key: quote(key, safe="", errors="surrogateescape"),
    "percent twice": lambda key: quote(quote(key, safe="", errors="surrogateescape"), safe=""),
    "percent, with plus": lambda key: quote_plus(key, errors="surrogateescape"),
    "html": lambda key: key.replace("&", "&amp;").replace('"', "&quot;").replace("'", "&#x27;"),
    "base64": lambda key: base64.b64encode(key.encode("utf-8", "surrogateescape")).decode(),
    "base64, one before": lambda key: base64.b64encode(b"u" + key.encode("utf-8", "surrogateescape")).decode(),
    "basic": lambda key: base64.b64encode(b"me:" + key.encode("utf-8", "surrogateescape") + b"\n").decode(),
    "base64 of an address": lambda key: base64.urlsafe_b64encode(
        b"user:" + key.encode("utf-8", "surrogateescape")
    ).decode(),
    "split": lambda key: f"{key[:9]}\n    {key[9:]}",
    "split in a repr": lambda key: repr(f"{key[:9]}\r\n{key[9:]}"),
    "wrapped": lambda key: "\n".join(f"| {line} |" for line in textwrap.wrap(key, 7, drop_whitespace=False)),
    "spaced": lambda key: " ".join(key),
    "cut": lambda key: key[:18],
    "cut at its beginning": lambda key: key[9:],
    "capitals": str.upper,
    "hexadecimal": lambda key: key.encode("utf-8", "surrogateescape").hex(" "),
}
BROKEN = {
    "whole": KEY,
    "line break at its end": f"{KEY}\n",
    "carriage return": f"{KEY}\r\n",
    "space before": f" {KEY}",
    "tab within": f"{KEY[:14]}\t{KEY[14:]}",
    "two lines": f"{KEY}\n{KEY[::-1]}",
    "quoted": f'"{KEY}"',
    "not ASCII": f"{KEY[:13]}ä{KEY[13:]}",
    "no Unicode": f"{KEY}\udcff",
    "base64-like": base64.b64encode(KEY.encode()).decode(),
    "percent signs": f"%%{KEY}%",
    "long": KEY * 40,
}


@pytest.fixture(autouse=True)
def _no_other_keys(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(redaction, "_values", set[str]())
    monkeypatch.setattr(redaction, "_variables", set[str]())


@pytest.mark.parametrize("form", FORMS)
def test_every_form_of_a_key_is_blanked_and_nothing_around_it(form: str, monkeypatch: pytest.MonkeyPatch) -> None:
    for broken, key in BROKEN.items():
        monkeypatch.setenv("MY_API_KEY", key)
        shown = redact(f"before it <{FORMS[form](key)}> after it")
        assert shown.startswith("before it <") and shown.endswith("> after it"), broken
        core = shown.removeprefix("before it <").removesuffix("> after it").replace("***", "")
        assert len("".join(c for c in core if c.isalnum())) < 12, broken
        assert not any(part in core for part in (KEY[:8], KEY[-8:])), broken


def test_a_text_without_a_key_is_left_as_it_is(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MY_API_KEY", KEY)
    text = 'The ball rolls 100%25 of\nthe ramp, \\n and "rests" & waits. Basic authentication wants a bearer token.'
    assert redact(text) == text


def test_a_short_key_blanks_no_ordinary_text_and_is_blanked_in_a_header(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MY_API_KEY", "left1")
    assert redact("left1 or right") == "left1 or right"
    assert redact("{'authorization': 'Bearer left123'}") == "{'authorization': 'Bearer ***'}"


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("Authorization: Bearer abc.def-123", "Authorization: Bearer ***"),
        ("[(b'x-api-key', b'sk-ant-0123')]", "[(b'x-api-key', b'***')]"),
        ('{"x-goog-api-key": "AIza0123456789"}', '{"x-goog-api-key": "***"}'),
        ("OPENAI_API_KEY=sk-0123456789", "OPENAI_API_KEY=***"),
        ("{'client_secret': 'abc-0123456789'}", "{'client_secret': '***'}"),
        ("GET https://h/v1?key=AIza0123456789&alt=sse", "GET https://h/v1?key=***&alt=sse"),
        ("postgresql://lab:pw@db:5432/traps", "postgresql://lab:***@db:5432/traps"),
        ("give postgresql://USER:PASSWORD@HOST:5432/DATABASE", "give postgresql://USER:PASSWORD@HOST:5432/DATABASE"),
        ("api_key: Field required", "api_key: Field required"),
    ],
    ids=range(9),  # pytest puts the id into the environment
)
def test_a_key_that_nobody_named_is_known_by_its_place(text: str, shown: str) -> None:
    assert redact(text) == shown


def test_the_password_of_an_address_and_a_key_with_any_name_are_secrets(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("LAB_DATABASE", "postgresql://lab:s3cret%2Fpassword@db/traps")
    monkeypatch.setenv("LAB", "token-of-the-lab")
    redaction.redact_environment_variable("LAB")
    assert redact("password s3cret/password of token-of-the-lab") == "password *** of ***"


TRACEBACK = """
import logging, threading, warnings
from traps_pipeline.base.redaction import redact_tracebacks, redact_exception
redact_tracebacks()
redact_tracebacks()
key = __import__("os").environ["MY_API_KEY"]
def fail():
    raise ValueError({"Authorization": f"Bearer {key}"})
logging.error("sent %s", key)
logging.error("sent %s", 1)
try:
    fail()
except ValueError as error:
    logging.exception("it failed")
    print(redact_exception(error), redact_exception(KeyError("x")).__class__)
thread = threading.Thread(target=fail)
thread.start()
thread.join()
warnings.warn(f"sent {key}")
type("Finalized", (), {"__del__": lambda self: fail()})()
fail()
"""


def test_logs_tracebacks_and_warnings_of_a_process_hold_no_key() -> None:
    environment = {**os.environ, "MY_API_KEY": KEY, "PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-c", TRACEBACK]
    ran = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert ran.returncode == 1
    shown = ran.stdout + ran.stderr
    assert KEY[:9] not in shown
    assert ran.stderr.count("Traceback") == 4
    assert ran.stderr.count("Bearer ***") == 4
    assert "UserWarning: sent ***" in ran.stderr
    assert "ERROR:root:sent ***" in ran.stderr
    assert "ERROR:root:sent 1" in ran.stderr
    assert "Bearer ***" in ran.stdout
    assert "<class 'KeyError'>" in ran.stdout


def test_a_key_is_hidden_from_the_moment_that_it_is_set_changed_or_named(monkeypatch: pytest.MonkeyPatch) -> None:
    first, second, named = "sk-first-0123456789", "sk-second-0123456789", "quiet-0123456789"
    assert redact(f"{first} {second}") == f"{first} {second}"
    monkeypatch.setenv("SOME_API_KEY", first)
    assert redact(f"{first} {second}") == f"*** {second}"
    monkeypatch.setenv("SOME_API_KEY", second)
    assert redact(f"{first} {second}") == f"{first} ***"
    monkeypatch.setenv("SOME_VALUE", named)
    assert redact(named) == named
    redaction.redact_environment_variable("SOME_VALUE")
    assert redact(named) == "***"
