"""What is wrong with a model or judge is named before anything is rendered or judged, and within half a minute."""

from __future__ import annotations

import datetime
from collections.abc import Callable
from typing import Any

import pytest

from tests.conftest import KEY
from tests.providers.server import Provider
from tests.providers.servers import closed_port
from traps_pipeline.base import progress
from traps_pipeline.checks.live_check import LiveResult, check_live, findings
from traps_pipeline.models import api, registry
from traps_pipeline.models.judges import JudgeEntry
from traps_pipeline.models.registry import PROTOCOL, Account, Entry, ModelEntry, Prices
from traps_pipeline.models.request import Outcome

pytestmark = pytest.mark.slow
NAME = "seer"
Check = Callable[..., LiveResult]


@pytest.fixture
def check(provider: Provider, monkeypatch: pytest.MonkeyPatch) -> Check:
    """Checks an entry at the provider, or at another address, live."""

    def checked(kind: type[Entry] = ModelEntry, address: str = "", key: str | None = KEY, **changes: Any) -> LiveResult:
        account = Account(key=key, base_url=address or f"{provider.url}/v1")
        for module in (api, registry):
            monkeypatch.setattr(module, "load_accounts", lambda: {"here": account})
        fields: dict[str, Any] = {"id": NAME, "backend": "api", "account": "here", "provider_id": f"openai/{NAME}"}
        fields |= {"prices": Prices(input=0, output=0, as_of=datetime.date(2026, 11, 1))}
        if kind is ModelEntry:
            fields |= {"params": {name: value for name, (_, value) in PROTOCOL.items()}}
            fields |= {"media": {"profile": "images", "fps": 5, "most": 25}}
        else:
            fields |= {"params": {"temperature": 0.8, "max_tokens": 512}}
        entry = kind.model_validate(fields | changes, context={"accounts": {"here": account}})
        (live,) = check_live([entry])
        return live

    return checked


@pytest.mark.parametrize("profile", ["images", "video"])
def test_a_model_that_answers_sees_and_keeps_to_the_schema_is_sound(check: Check, profile: str) -> None:
    live = check(media={"profile": profile, "fps": 5, "most": 25})
    assert (live.problems, live.notes) == ([], [])


def test_a_wrong_name_is_named_with_those_that_are_served(check: Check, provider: Provider) -> None:
    provider.configure(served=["other", "third"], fault_by_model={NAME: "not_found"})
    (problem,) = check().problems
    assert f"serves no '{NAME}'; it lists other, third" in problem
    provider.configure(fault_by_model={}, served_suffix="-of-another-name")
    assert check().problems == [problem]  # something answers, and does not say that it is the model
    provider.configure(served=None, fault_by_model={NAME: "not_found"})  # a server without a list of models
    assert f"knows no model '{NAME}'" in check().problems[0]


def test_a_name_that_a_list_lacks_is_a_note_where_it_answers(check: Check, provider: Provider) -> None:
    provider.configure(served=["an-example"])  # transformers serve lists what was downloaded, a mock lists examples
    live = check()
    assert live.problems == [] and "it lists an-example, and answers to that name" in live.notes[0]


@pytest.mark.parametrize(
    ("code", "cause"),
    [(429, "takes no call now; what it said stands above: wait, or raise"), (502, "ends in an error")],
)
def test_an_error_in_a_200_is_named_as_one(
    check: Check, provider: Provider, capsys: pytest.CaptureFixture[str], code: int, cause: str
) -> None:
    provider.configure(raw_by_model={NAME: {"content": f'{{"error": {{"message": "busy", "code": {code}}}}}'}})
    with progress.use_progress(progress.Progress()):
        assert all(cause in problem for problem in check().problems)
    assert "busy (an error object in an HTTP 200)" in capsys.readouterr().err


def test_a_call_too_many_is_a_note_where_others_are_answered(check: Check) -> None:
    entry, account, refused = check().entry, Account(key=KEY), Outcome("error", error="rate_limited")
    answer = Outcome("answer", text="The answer is: red, then blue.")
    live = findings(entry, account, {"clip": answer, "no clip": refused})
    assert (live.problems, live.notes) == ([], ["no clip: refused as one call too many; a run waits and asks again"])
    assert "takes no call now" in findings(entry, account, {"clip": refused, "no clip": refused}).problems[0]


def test_a_proxy_that_is_dead_is_named_and_no_server_is_said_to_be_down(
    check: Check, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HTTPS_PROXY", f"http://127.0.0.1:{closed_port()}")
    (problem,) = check(address="https://provider.invalid/v1").problems
    assert "of HTTPS_PROXY: Connection refused" in problem
    assert "look at this machine's network and proxy variables" in problem


def test_a_key_that_is_not_set_is_a_finding_and_no_end(check: Check) -> None:
    assert "A_KEY_OF_NOBODY is not set" in check(key="A_KEY_OF_NOBODY").problems[0]


def test_a_proxy_that_answers_400_to_a_wrong_key_is_asked_for_its_list(check: Check, provider: Provider) -> None:
    provider.configure(fault_by_model={NAME: "bad_request"}, served=[NAME], list_status=400)
    (problem,) = check().problems
    assert "refuses even its list of models" in problem and f"the one in {KEY} right?" in problem
    provider.configure(list_status=200)
    assert "it refuses what the entry declares (http_400)" in check().problems[0]


def test_a_wrong_key_is_named_by_its_variable(check: Check, provider: Provider) -> None:
    provider.configure(fault_by_model={NAME: "unauthorized"})
    (problem,) = check().problems
    assert problem.startswith(f"the key in {KEY} is not accepted")
    (problem,) = check(key=None).problems
    assert "a key is wanted" in problem and "`key`" in problem


def test_a_model_that_refuses_a_schema_is_asked_without_one(check: Check, provider: Provider) -> None:
    provider.configure(unstructured=[NAME])
    (problem,) = check().problems
    assert problem.startswith("it refuses structured output") and "json_schema: false" in problem
    assert check(json_schema=False, waivers={"json_schema": "the server refuses it"}).problems == []


def test_a_model_that_thinks_inline_is_named_and_sound_once_that_is_declared(check: Check, provider: Provider) -> None:
    said = '<think>red, then blue</think>{"reason": "seen", "final_answer": "red and blue"}'
    provider.configure(scripts={NAME: {"": said}})
    (problem,) = check().problems
    assert 'say `thinking: "<think>"` in its entry' in problem
    assert check(thinking="<think>").problems == []


@pytest.mark.parametrize(
    ("content", "kind", "shape"),
    [
        ("<html><body>Sign in</body></html>", "text/html", "a page of HTML"),
        ('data: {"choices": []}\n\n', "text/event-stream", "a stream of events"),
        ('{"message": {"content": "red and blue"}}', "application/json", "no list `choices`"),
    ],
)
def test_an_odd_shape_is_named(check: Check, provider: Provider, content: str, kind: str, shape: str) -> None:
    provider.configure(raw_by_model={NAME: {"content": content, "type": kind}})
    assert all(shape in problem for problem in check().problems)


def test_a_judge_that_thinks_inline_is_named_and_sound_once_that_is_declared(check: Check, provider: Provider) -> None:
    vote = '[THINK]{"abstained": false}[/THINK]{"abstained": %s, "confidence": "high", "reasoning": "r"}'
    right = '[THINK]hm[/THINK]{"correct": true, "extracted_value": "left", "reasoning": "r"}'
    script = {"Ground truth": right, "answer is: left": vote % "false", "": vote % "true"}
    provider.configure(scripts={NAME: script})
    (problem,) = check(JudgeEntry).problems
    assert 'say `thinking: "[THINK]"` in its entry' in problem
    assert check(JudgeEntry, thinking="[THINK]").problems == []


def test_an_unknown_price_is_said(check: Check) -> None:
    live = check(prices=None)
    assert live.problems == [] and "price is unknown" in live.notes[0]


def test_a_judge_votes_rightly_on_plain_answers_or_is_named(check: Check, provider: Provider) -> None:
    assert check(JudgeEntry).problems == []
    provider.configure(scripts={NAME: {"": "I would say that it abstains."}})
    assert any("its vote on abstention does not meet the schema" in problem for problem in check(JudgeEntry).problems)
    yes = '{"abstained": true, "confidence": "high", "reasoning": "r"}'
    provider.configure(scripts={NAME: {"answer is: left": yes}})
    assert any("its vote on abstention of the plain answer" in problem for problem in check(JudgeEntry).problems)
