"""One attempt over the network, by three APIs: what each failure becomes, and what is read of an answer."""

from __future__ import annotations

import asyncio
import datetime
import json
import os
import subprocess
import sys
from ast import literal_eval
from importlib.metadata import version
from math import log
from pathlib import Path
from typing import Any

import pytest

from tests.conftest import KEY, ROOT, SECRET
from tests.providers.server import Provider, answer_to
from traps_pipeline.base import progress
from traps_pipeline.models.registry.entries import Account, Entry, Limits, Prices
from traps_pipeline.models.request import Outcome, Request, TransientError
from traps_pipeline.models.wire.api import ApiBackend

pytestmark = pytest.mark.slow  # asks a server
FINISHES = {"openai/m": "stop", "gemini/gemini-2.5-pro": "STOP", "openai/responses/m": "completed"}
ROUTES = {"openai/m": "/v1", "gemini/gemini-2.5-pro": "/v1beta", "openai/responses/m": "/v1"}
QUESTION = "Does the ball clear the barrier?"


def backend(provider: Provider, route: str, limits: Limits | None = None, **params: Any) -> ApiBackend:
    account = Account(key=KEY, base_url=provider.url + ROUTES[route])
    fields = {
        "id": "m",
        "backend": "api",
        "account": "a",
        "provider_id": route,
        "params": {"temperature": 0.8, "top_p": 0.95, "max_tokens": 8000} | params,
        "limits": limits or Limits(timeout_s=1.0),
        "prices": Prices(input=1.0, output=10.0, as_of=datetime.date(2026, 11, 1)),
    }
    return ApiBackend(Entry.model_validate(fields, context={"accounts": {"a": account}}), account)


def ask(provider: Provider, route: str, regime: str = "standard", **params: Any) -> Outcome:
    asking = backend(provider, route, **params)
    sent = asking._entry.params  # the request of a real run holds the same
    return asyncio.run(
        asking.ask(Request("m", route, sent, "You watch a clip.", QUESTION, {"item_id": "x", "regime": regime}))
    )


@pytest.mark.promise
@pytest.mark.parametrize("route", ROUTES)
def test_an_answer_is_read_with_what_it_took(provider: Provider, route: str) -> None:
    thinking: dict[str, dict[str, Any]] = {
        "openai/m": {},
        "gemini/gemini-2.5-pro": {"thinkingConfig": {"includeThoughts": True, "thinkingBudget": -1}},
        "openai/responses/m": {"reasoning": {"effort": "high", "summary": "auto"}},
    }
    provider.configure(served_suffix="-2026-11")
    outcome = ask(provider, route, **thinking[route])
    assert (outcome.kind, outcome.text) == ("answer", f"The answer is: {answer_to(QUESTION)}.")
    assert outcome.reasoning == f"Looking at the clip for {answer_to(QUESTION)}."
    assert outcome.finish_reason == FINISHES[route]
    assert outcome.client == f"litellm {version('litellm')}"
    assert outcome.served_model == route.split("/")[-1] + "-2026-11"
    assert outcome.prompt_tokens and outcome.completion_tokens and outcome.reasoning_tokens
    assert outcome.cost_usd == pytest.approx((outcome.prompt_tokens + 10 * outcome.completion_tokens) / 1e6)
    (record,) = provider.requests()
    assert SECRET not in str(record)


def test_log_probabilities_of_the_first_word_are_kept_where_they_are_scored(provider: Provider) -> None:
    asked, route = {"logprobs": True, "top_logprobs": 2}, "openai/m"
    kept = ask(provider, route, regime="logprobs", **asked)
    assert kept.text == f"The answer is: {answer_to(QUESTION)}."
    assert json.loads(str(kept.first_token)) == pytest.approx({"The": log(0.75), "No": log(0.25)}, abs=1e-6)
    assert ask(provider, route, regime="logprobs").first_token is None  # they were not asked for
    assert ask(provider, route, regime="standard", **asked).first_token is None


IN_A_LOOP = """
import asyncio, sys
from types import SimpleNamespace
import tests.models.test_api as test
from traps_pipeline.models.registry.entries import Limits
from traps_pipeline.models.request import Request

async def ask():  # the first backend is made, and the client library imported, while the loop runs
    asking = test.backend(SimpleNamespace(url=sys.argv[1]), "gemini/gemini-2.5-pro", limits=Limits(timeout_s=600.0))
    request = Request("m", "gemini", asking._entry.params, "You watch.", test.QUESTION, {"item_id": "x"})
    return await asking.ask(request)

outcome = asyncio.run(ask())
print(outcome.prompt_tokens, outcome.cost_usd)
"""


def test_no_connection_that_the_client_library_made_at_its_import_is_used(provider: Provider) -> None:
    command = [sys.executable, "-W", "ignore", "-c", IN_A_LOOP, provider.url]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True)
    tokens, dollars = done.stdout.split()
    assert int(tokens) > 0 and float(dollars) > 0, "the answer was not seen on the wire"


@pytest.mark.promise
@pytest.mark.parametrize("route", ROUTES)
@pytest.mark.parametrize(
    ("fault", "kind"),
    [
        ("rate_limited", "rate_limited"),
        ("server_error", "server_error"),
        ("timeout_status", "timeout"),
        ("hang", "timeout"),
        ("cut", None),
        ("wrong_content_type", None),
    ],
)
def test_what_may_pass_is_worth_another_try(provider: Provider, route: str, fault: str, kind: str | None) -> None:
    provider.configure(faults={fault: 1.0}, retry_after_s=7)
    with pytest.raises(TransientError) as raised:
        ask(provider, route)
    assert kind in (None, raised.value.kind)
    assert raised.value.retry_after_s == (7.0 if fault == "rate_limited" else None)
    assert raised.value.billed == (fault in ("timeout_status", "hang", "cut", "wrong_content_type"))
    assert provider.stats()["requests"] == 1  # no layer below retries


@pytest.mark.promise
@pytest.mark.parametrize("route", ROUTES)
@pytest.mark.parametrize(("fault", "error"), [("bad_request", "http_400"), ("unauthorized", "http_401")])
def test_what_will_not_pass_is_final_and_told_once_without_the_key(
    provider: Provider, route: str, fault: str, error: str, capsys: pytest.CaptureFixture[str]
) -> None:
    provider.configure(faults={fault: 1.0})
    with progress.use_progress(progress.Progress()):
        outcome = ask(provider, route)
    assert (outcome.kind, outcome.error, outcome.text) == ("error", error, None)
    told = capsys.readouterr().err
    assert told.startswith("m: ") and f"({error}: " in told and SECRET not in told


@pytest.mark.promise
@pytest.mark.parametrize("route", ROUTES)
@pytest.mark.parametrize(
    ("fault", "kind"),
    [("empty", "empty"), ("thinking_exhausted", "empty"), ("length", "truncated"), ("content_filter", "refused")],
)
def test_an_answer_without_its_end_has_a_kind_of_its_own(provider: Provider, route: str, fault: str, kind: str) -> None:
    provider.configure(faults={fault: 1.0})
    outcome = ask(provider, route)
    assert outcome.kind == kind
    assert (outcome.text is not None) == (kind == "truncated")
    assert outcome.cost_usd is not None and outcome.cost_usd > 0  # it was paid for


@pytest.mark.promise
def test_a_refusal_in_words_is_no_answer(provider: Provider) -> None:
    provider.configure(faults={"refusal": 1.0})
    for route in ROUTES:
        outcome = ask(provider, route)
        assert (outcome.kind, outcome.text) == ("refused", None)
    provider.configure(faults={"content_filter_error": 1.0})
    assert ask(provider, "openai/m").kind == "refused"


def test_a_env_file_above_the_checkout_sets_no_proxy_and_no_key(tmp_path: Path) -> None:
    """litellm takes variables from such a file by itself, so that anybody who can write one could read the calls."""
    (tmp_path / ".env").write_text("HTTPS_PROXY=http://127.0.0.1:9\nOPENAI_API_KEY=sk-foreign\nTRAPS_PLANTED=yes\n")
    folder = tmp_path / "projects" / "mine"
    folder.mkdir(parents=True)
    (folder / ".env").write_text("ANTHROPIC_API_KEY=sk-foreign\n")
    script = """
import os
before = {**os.environ}
from traps_pipeline.models.wire.api import load_litellm
load_litellm()
print(sorted(name for name in os.environ.keys() - before.keys() if not name.startswith("LITELLM_")))
import dotenv
print(dotenv.find_dotenv(usecwd=True))  # the file is one that such a library finds
"""
    environment = {name: value for name, value in os.environ.items() if name != "LITELLM_MODE"}
    environment["PYTHONPATH"] = str(ROOT)
    command = [sys.executable, "-c", script]
    ran = subprocess.run(command, cwd=folder, env=environment, capture_output=True, check=True, text=True)
    set_here, found = ran.stdout.splitlines()
    assert found == str(folder / ".env")
    assert not {"HTTPS_PROXY", "OPENAI_API_KEY", "TRAPS_PLANTED", "ANTHROPIC_API_KEY"} & {*literal_eval(set_here)}
