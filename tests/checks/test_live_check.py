"""What is wrong with a model or judge is named before anything is rendered or judged, and within half a minute."""

from __future__ import annotations

import datetime
import json
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import pytest

from tests.build.network import ITEMS, experiment
from tests.build.network import entry as network_entry
from tests.conftest import KEY, Checkout
from tests.providers.server import Provider
from tests.providers.servers import closed_port
from tests.terminals import run_in_terminal
from traps_pipeline.base import progress
from traps_pipeline.checks import live_check
from traps_pipeline.checks.live_check import LiveResult, check_live, findings
from traps_pipeline.checks.server_check import nobody_at
from traps_pipeline.models.registry import entries as registry
from traps_pipeline.models.registry.accounts import Account, Prices
from traps_pipeline.models.registry.entries import PROTOCOL_PARAMS, Entry, ModelEntry
from traps_pipeline.models.registry.judges import JudgeEntry
from traps_pipeline.models.request import Outcome
from traps_pipeline.models.wire import api
from traps_pipeline.models.wire.dialects import shape_of

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
            fields |= {"params": {name: value for name, (_, value) in PROTOCOL_PARAMS.items()}}
            fields |= {"media": {"profile": "images", "fps": 5, "most": 25}}
        else:
            fields |= {"params": {"temperature": 0.8, "max_tokens": 512}}
        entry = kind.model_validate(fields | changes, context={"accounts": {"here": account}})
        (live,) = check_live([entry])
        return live

    return checked


def calls_of(problems: Sequence[str]) -> list[str]:
    """The calls that problems begin with."""
    return [problem.partition(": ")[0] for problem in problems]


@pytest.mark.parametrize("profile", ["images", "video"])
def test_a_model_that_answers_sees_and_keeps_to_the_schema_is_sound(check: Check, profile: str) -> None:
    live = check(media={"profile": profile, "fps": 5, "most": 25})
    assert (live.problems, live.notes) == ([], [])


def test_a_wrong_name_is_named_with_those_that_are_served(check: Check, provider: Provider) -> None:
    provider.configure(served=["other", "third"], fault_by_model={NAME: "not_found"})
    (problem,) = check().problems
    assert f"'{NAME}'" in problem and "other, third" in problem
    provider.configure(fault_by_model={}, served_suffix="-of-another-name")
    assert check().problems == [problem]  # something answers, and does not say that it is the model
    provider.configure(served=None, fault_by_model={NAME: "not_found"})  # a server without a list of models
    (problem,) = check().problems
    assert f"'{NAME}'" in problem and "other, third" not in problem


def test_a_name_that_a_list_lacks_is_a_note_where_it_answers(check: Check, provider: Provider) -> None:
    provider.configure(served=["an-example"])  # transformers serve lists what was downloaded, a mock lists examples
    live = check()
    (note,) = live.notes
    assert live.problems == [] and f"'{NAME}'" in note and "an-example" in note


@pytest.mark.parametrize(
    ("code", "kind", "named"), [(429, "rate_limited", ["http"]), (502, "server_error", ["clip", "no clip"])]
)
def test_an_error_in_a_200_is_named_as_one(
    check: Check, provider: Provider, capsys: pytest.CaptureFixture[str], code: int, kind: str, named: list[str]
) -> None:
    provider.configure(raw_by_model={NAME: {"content": f'{{"error": {{"message": "busy", "code": {code}}}}}'}})
    with progress.use_progress(progress.Progress()):
        problems = check().problems
    assert [problem.partition(":")[0] for problem in problems] == named  # by its address, or by each of its calls
    assert all(f"{provider.url}/v1" in problem for problem in problems)
    told = capsys.readouterr().err
    assert f"({kind}: busy " in told and "HTTP 200" in told


def test_a_call_too_many_is_a_note_where_others_are_answered(check: Check) -> None:
    entry, account, refused = check().entry, Account(key=KEY), Outcome("error", error="rate_limited")
    answer = Outcome("answer", text="The answer is: red, then blue.")
    live = findings(entry, account, {"clip": answer, "no clip": refused})
    assert (live.problems, calls_of(live.notes)) == ([], ["no clip"])
    live = findings(entry, account, {"clip": refused, "no clip": refused})
    assert [entry.endpoint in problem for problem in live.problems] == [True] and not live.notes


def test_a_proxy_that_is_dead_is_named_and_no_server_is_said_to_be_down(
    check: Check, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HTTPS_PROXY", f"http://127.0.0.1:{closed_port()}")
    (problem,) = check(address="https://provider.invalid/v1").problems
    assert "https://provider.invalid/v1" in problem and "HTTPS_PROXY" in problem and "Connection refused" in problem
    assert "NO_PROXY" in problem and "NO_PROXY" not in nobody_at("https://127.0.0.1/v1")  # where a server is missing


def test_a_key_that_is_not_set_is_a_finding_and_no_end(check: Check) -> None:
    (problem,) = check(key="A_KEY_OF_NOBODY").problems
    assert "A_KEY_OF_NOBODY" in problem


def test_a_proxy_that_answers_400_to_a_wrong_key_is_asked_for_its_list(check: Check, provider: Provider) -> None:
    provider.configure(fault_by_model={NAME: "bad_request"}, served=[NAME], list_status=400)
    (problem,) = check().problems
    assert f"{provider.url}/v1" in problem and KEY in problem and "HTTP 400" in problem
    provider.configure(list_status=200)
    problems = check().problems
    assert calls_of(problems) == ["clip", "no clip"] and KEY not in str(problems)
    assert all("(http_400)" in problem and "`params: {NAME: null}`" in problem for problem in problems)


def test_a_wrong_key_is_named_by_its_variable(check: Check, provider: Provider) -> None:
    provider.configure(fault_by_model={NAME: "unauthorized"})
    (problem,) = check().problems
    assert KEY in problem and f"{provider.url}/v1" in problem
    (problem,) = check(key=None).problems
    assert KEY not in problem and "`key`" in problem


def test_a_model_that_refuses_a_schema_is_asked_without_one(check: Check, provider: Provider) -> None:
    provider.configure(unstructured=[NAME])
    (problem,) = check().problems
    assert "(http_400)" in problem and "`json_schema: false`" in problem
    assert check(json_schema=False, waivers={"json_schema": "the server refuses it"}).problems == []


def test_a_model_that_thinks_inline_is_named_and_sound_once_that_is_declared(check: Check, provider: Provider) -> None:
    said = '<think>red, then blue</think>{"reason": "seen", "final_answer": "red and blue"}'
    provider.configure(scripts={NAME: {"": said}})
    (problem,) = check().problems
    assert '`thinking: "<think>"`' in problem
    assert check(thinking="<think>").problems == []


@pytest.mark.parametrize(
    ("content", "kind", "shape"),
    [
        ("<html><body>Sign in</body></html>", "text/html", shape_of("<")),
        ('data: {"choices": []}\n\n', "text/event-stream", shape_of("data:")),
        ('{"message": {"content": "red and blue"}}', "application/json", "`choices`"),
    ],
    ids=["page", "stream", "object"],
)
def test_an_odd_shape_is_named(check: Check, provider: Provider, content: str, kind: str, shape: str) -> None:
    provider.configure(raw_by_model={NAME: {"content": content, "type": kind}})
    problems = check().problems
    assert calls_of(problems) == ["clip", "no clip"] and all(shape in problem for problem in problems)


def test_a_judge_that_thinks_inline_is_named_and_sound_once_that_is_declared(check: Check, provider: Provider) -> None:
    vote = '[THINK]{"abstained": false}[/THINK]{"abstained": %s, "confidence": "high", "reasoning": "r"}'
    right = '[THINK]hm[/THINK]{"correct": true, "extracted_value": "left", "reasoning": "r"}'
    script = {"Ground truth": right, "answer is: left": vote % "false", "": vote % "true"}
    provider.configure(scripts={NAME: script})
    (problem,) = check(JudgeEntry).problems
    assert '`thinking: "[THINK]"`' in problem
    assert check(JudgeEntry, thinking="[THINK]").problems == []


def test_an_unknown_price_is_said(check: Check) -> None:
    live = check(prices=None)
    (note,) = live.notes
    assert live.problems == [] and "--allow-unknown-prices" in note


def test_a_judge_votes_rightly_on_plain_answers_or_is_named(check: Check, provider: Provider) -> None:
    assert check(JudgeEntry).problems == []
    plain = "The answer is: left."  # of one of the answers, which a wrong vote is named with, and an invalid one is not
    provider.configure(scripts={NAME: {"": "I would say that it abstains."}})
    abstention, correctness = check(JudgeEntry).problems
    assert " abstention " in abstention and " correctness " in correctness and plain not in abstention + correctness
    yes = '{"abstained": true, "confidence": "high", "reasoning": "r"}'
    provider.configure(scripts={NAME: {"answer is: left": yes}})
    abstention, correctness = check(JudgeEntry).problems
    assert " abstention " in abstention and plain in abstention and " correctness " in correctness


def test_what_was_not_answered_in_time_is_not_checked_and_no_model_that_drops_its_pictures_is_sound(
    check: Check, provider: Provider, monkeypatch: pytest.MonkeyPatch
) -> None:
    provider.configure(blind=[NAME])
    (problem,) = check().problems
    assert " blue" in problem
    provider.configure(blind=[NAME], latency_s=1.5)
    monkeypatch.setattr(live_check, "TIMEOUT_S", 0.5)
    live, votes = check(), check(JudgeEntry)
    assert (
        live.unchecked
        and live.line.startswith(f"not checked {NAME}")
        and calls_of(live.notes)[:2] == ["clip", "no clip"]
    )
    assert votes.unchecked and "abstention" in votes.unchecked and "correctness" in votes.unchecked


def test_a_clip_alone_that_is_late_or_one_call_too_many_leaves_the_model_unchecked(check: Check) -> None:
    entry, account, seen = check().entry, Account(key=KEY), Outcome("answer", text="The answer is: red and blue.")
    unseen = Outcome("answer", text="The answer is: green.")
    for error in ("timeout", "rate_limited"):
        late = Outcome("error", error=error)
        assert findings(entry, account, {"clip": late, "no clip": seen}).unchecked
        assert findings(entry, account, {"clip": unseen, "no clip": late}).unchecked
        assert not findings(entry, account, {"clip": seen, "no clip": late}).unchecked
    assert findings(entry, account, {"clip": unseen, "no clip": unseen}).problems


def test_a_run_stops_at_a_model_that_is_not_checked_unless_it_is_told_to_go_on(
    unasked: Checkout, provider: Provider, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(live_check, "TIMEOUT_S", 1.0)
    provider.configure(latency_s=1.5)
    path = experiment(unasked, provider, [network_entry(NAME, "images")], regimes=["standard"], budget_usd=50.0)
    checked = unasked.traps("models", "check", path, "--live")
    assert checked.code == 1 and f"not checked {NAME}" in checked.out
    stopped = unasked.traps("run", path, "--until", "responses")
    assert (stopped.code, stopped.raised) == (1, "checks.live_check.require_sound")
    assert f"{NAME}: not checked" in stopped.err and "--unchecked" in stopped.err and not unasked.ledger_rows("answers")
    unasked.traps("run", path, "--until", "responses", "--unchecked").ok()
    assert len(unasked.ledger_rows("answers")) == ITEMS


def test_a_plan_has_the_minutes_of_the_calls_that_the_live_check_made(
    unasked: Checkout, provider: Provider, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    path = experiment(unasked, provider, [network_entry(NAME, "images")], regimes=["standard"], budget_usd=50.0)
    provider.configure(latency_s=3.0)
    unasked.traps("models", "check", path, "--live").ok()
    (row,) = json.loads(unasked.traps("plan", path, "--json").ok().out)["plan"]["forecasts"]
    # 48 calls, 24 at once, of 3 s and little more; one at a time, the two calls of the check came 1.5 s apart
    assert 2 * 3.0 <= row["minutes"] * 60 < 2 * 6.0
    assert ITEMS * 1.5 <= row["queued_minutes"] * 60 < ITEMS * 3.0


@pytest.mark.parametrize(("regimes", "asked"), [(["standard"], 0), (["standard", "json"], 1)])
def test_a_model_is_tried_with_a_schema_only_if_the_run_asks_for_one(
    unasked: Checkout, provider: Provider, regimes: list[str], asked: int
) -> None:
    provider.configure(unstructured=[NAME])
    path = experiment(unasked, provider, [network_entry(NAME, "images")], regimes=regimes, budget_usd=50.0)
    for command in (("models", "check", path, "--live"), ("run", path, "--until", "responses")):
        provider.reset()
        assert unasked.traps(*command).code == asked
        bodies = [request["body"] for request in provider.requests() if request["body"]]
        assert bodies and sum("response_format" in body for body in bodies) == asked


@pytest.mark.parametrize(
    ("regimes", "declared", "codes"),
    [
        (["standard"], "", [0, 0]),
        (["standard", "logprobs"], "", [1, 1]),
        (["standard", "logprobs"], ", logprobs: true, top_logprobs: 20", [0, 0]),
    ],
)
def test_a_model_without_log_probabilities_is_named_only_if_the_run_scores_them(
    unasked: Checkout, provider: Provider, regimes: list[str], declared: str, codes: list[int]
) -> None:
    model = network_entry(NAME, "images").replace("max_tokens: 8000", f"max_tokens: 8000{declared}")
    path = experiment(unasked, provider, [model], regimes=regimes, budget_usd=50.0)
    done = [
        unasked.traps(*command)
        for command in (["models", "check", path, "--live"], ["run", path, "--until", "responses"])
    ]
    assert [command.code for command in done] == codes, done
    assert all(("top_logprobs" in command.out + command.err) == bool(command.code) for command in done)


@pytest.mark.parametrize(("typed", "code"), [("n\n", 1), ("y\n", 0)])
def test_a_run_in_a_terminal_asks_before_it_goes_on_unchecked(
    unasked: Checkout, provider: Provider, typed: str, code: int
) -> None:
    provider.configure(latency_s=1.5)
    path = experiment(unasked, provider, [network_entry(NAME, "images")], regimes=["standard"], budget_usd=50.0)
    script = (
        "from traps_pipeline.checks import live_check; live_check.TIMEOUT_S = 1.0; from traps_pipeline.cli import main"
    )
    command = [
        sys.executable,
        "-c",
        f"import sys; {script}; sys.exit(main())",
        "run",
        str(path),
        "--until",
        "responses",
    ]
    ended, screen = run_in_terminal(command, 100, 40, unasked.root, unasked.environment, typed={"[y/N]": typed})
    assert (ended, "[y/N]" in screen.text) == (code, True), screen.text
    assert len(unasked.ledger_rows("answers")) == (0 if code else ITEMS)
