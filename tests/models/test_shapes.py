"""Whatever a provider sends back, what is booked is at least what it bills, and every answer is typed and stored."""

from __future__ import annotations

import asyncio
import json
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.build.calls import ANSWER, BODY, CHOICE, MESSAGE, PARAMS, USAGE, allowed_by, body, entry_of, request
from tests.build.errors import raises
from tests.build.ledger import budget as budget_of
from tests.build.ledger import budget_in, local
from tests.conftest import KEY, SECRET
from tests.providers.server import Provider
from traps_pipeline.base import progress
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.models.asking.ask import Call, Work, run_work
from traps_pipeline.models.asking.participants import OVERRUN, Participants, ask_once
from traps_pipeline.models.money.budget import BudgetReached
from traps_pipeline.models.registry.accounts import Account
from traps_pipeline.models.registry.entries import Entry
from traps_pipeline.models.request import Outcome, Request
from traps_pipeline.models.wire.api import ApiBackend
from traps_pipeline.protocol.cells import Cell, Evaluation
from traps_pipeline.storage.study import Study

# litellm serializes what it was given again; what it says of odd values goes to nobody.
pytestmark = [
    pytest.mark.filterwarnings("ignore:Pydantic serializer warnings"),
    pytest.mark.usefixtures("client_library"),
]
USD_A_TOKEN = (1e-6, 1e-5)


def usage(**changes: Any) -> str:
    return body(usage=USAGE | changes)


def message(**changes: Any) -> str:
    return body(choices=[CHOICE | {"message": MESSAGE | changes}])


# Not one of these is an answer whose usage can be believed.
ODD = {
    "negative-completion": usage(completion_tokens=-1),
    "null-prompt": usage(prompt_tokens=None),
    "fraction": usage(completion_tokens=2.5),
    "text-count": usage(completion_tokens="21"),
    "true-count": usage(completion_tokens=True),
    "huge-completion": usage(completion_tokens=2**63, total_tokens=2**63 + 20),
    "infinity": usage(completion_tokens=float("inf")),
    "zero-completion": usage(completion_tokens=0, total_tokens=20),
    "less-than-the-text": usage(completion_tokens=2, total_tokens=22),
    "sum-below-parts": usage(total_tokens=5),
    "absent-completion": body(usage={"prompt_tokens": 20}),
    "no-usage": json.dumps({name: value for name, value in BODY.items() if name != "usage"}),
    "null-usage": body(usage=None),
    "list-usage": body(usage=[20, 21]),
    "no-choices": body(choices=[]),
    "null-choices": body(choices=None),
    "choices-object": body(choices={"0": CHOICE}),
    "choice-null": body(choices=[None]),
    "choice-without-message": body(choices=[{"index": 0, "finish_reason": "stop"}]),
    "message-null": body(choices=[CHOICE | {"message": None}]),
    "content-number": message(content=5),
    "content-list": message(content=["left"]),
    "body-empty": "",
    "cut": body()[:90],
    "two-bodies": body() + body(),
    "page": "<!doctype html><h1>It works</h1>",
    "no-utf8": "\udcff\udcfe" + body(),
    "deep": "[" * 100_000,
    "many-digits": usage(completion_tokens=21).replace("21", "9" * 5000),
    "given-up-in-200": json.dumps({"error": {"message": "upstream took too long", "code": 504}}),
    "error-in-choice": body(choices=[CHOICE | {"error": {"message": "upstream failed", "code": 502}}]),
    "cost-by-name": body(usage={"cost_usd": -1000}),
}
STATUSES = {f"status-{status}": status for status in (500, 502, 504, 520, 522, 524, 599, 408, 204)}
UNBILLED = {f"status-{status}": status for status in (400, 401, 403, 404, 409, 422, 429, 503)}
REDIRECTS = {f"status-{status}": status for status in (301, 302, 304, 307)}
EXPLAINED = {f"explained-{status}": status for status in (500, 502, 520)}  # with an error object of the provider's
USED_UP = {"message": "You exceeded your current quota", "type": "insufficient_quota", "code": "insufficient_quota"}
MINIMAX = {"choices": None, "usage": {"total_tokens": 0}}
ANSWERS = {  # by status and body, what a provider's own way to fail becomes, and how often it is asked
    "minimax limit": (
        200,
        MINIMAX | {"base_resp": {"status_code": 1002, "status_msg": "rate limit"}},
        "rate_limited",
        2,
    ),
    "minimax credit": (200, MINIMAX | {"base_resp": {"status_code": 1008, "status_msg": "balance"}}, "http_402", 1),
    "minimax filter": (200, MINIMAX | {"base_resp": {"status_code": 1026, "status_msg": "x"}}, "content_policy", 1),
    "openai quota": (429, {"error": USED_UP}, "http_402", 1),
    "moonshot quota": (429, {"error": {"type": "exceeded_current_quota_error", "message": "x"}}, "http_402", 1),
    "zhipu arrears": (429, {"error": {"code": "1113", "message": "x"}}, "http_402", 1),
    "dashscope quota a minute": (
        429,
        {"error": USED_UP | {"message": "You exceeded your current quota: https://help/error-code#token-limit"}},
        "rate_limited",
        2,
    ),
    "dashscope arrears": (400, {"code": "Arrearage", "message": "x", "request_id": "r"}, "http_402", 1),
    "dashscope filter": (400, {"error": {"code": "data_inspection_failed", "message": "x"}}, "content_policy", 1),
    "deepseek filter": (
        400,
        {"error": {"code": "invalid_request_error", "message": "Content Exists Risk"}},
        "content_policy",
        1,
    ),
    "deepseek filter, older": (400, {"detail": "Content Exists Risk"}, "content_policy", 1),
    "zhipu filter": (400, {"error": {"code": "1301", "message": "x"}}, "content_policy", 1),
    "mistral": (200, {"object": "error", "message": "slow", "type": "rate_limit_error"}, "rate_limited", 2),
    "baidu": (200, {"error_code": 429, "error_msg": "slow"}, "rate_limited", 2),
    "cloudflare": (200, {"success": False, "errors": [{"code": 429, "message": "slow"}]}, "rate_limited", 2),
    "stream of one error": (200, [{"error": {"code": 429, "message": "slow"}}], "rate_limited", 2),
}
NO_ERRORS: list[dict[str, Any]] = [
    {"error": {"code": 0, "message": ""}},
    {"error": {"code": "0", "message": "success"}},
    {"error": {}},
    {"error": {"code": None, "message": None}},
    {"base_resp": {"status_code": 0, "status_msg": ""}},
    {"code": 0, "message": "Success"},
    {"errors": []},
]
REFUSED_IN_200 = {  # by what a provider says in a 200, and what it amounts to
    "number": ({"code": 429, "message": "slow down"}, "rate_limited"),
    "word": ({"code": "rate_limit_exceeded", "message": "slow down"}, "rate_limited"),
    "anthropic": ({"type": "overloaded_error", "message": "Overloaded"}, "server_error"),
    "gemini": ({"code": 403, "status": "PERMISSION_DENIED", "message": "no permission"}, "http_403"),
    "upstream": ({"code": 502, "message": "Provider returned error"}, "server_error"),
    "unnamed": ({"message": "something went wrong"}, "server_error"),
    "final": ({"code": "404", "message": "no such model"}, "http_404"),
}
FAILED = json.dumps({"error": {"message": "The server had an error", "type": "server_error"}})
FLAT_IN_200 = {"code": 429, "message": "slow down", "request_id": "r"}  # an error object that is the whole body


@pytest.fixture
def odd(shared_provider: Provider, monkeypatch: pytest.MonkeyPatch) -> Provider:
    """The server with every odd shape, each the only answer of a model of its own; it keeps its own bill."""
    monkeypatch.setenv(KEY, SECRET)
    raw: dict[str, Any] = {name: {"content": content} for name, content in ODD.items()}
    raw["in-200-flat"] = {"content": json.dumps(FLAT_IN_200), "billed": False}
    raw |= {name: {"content": body(), "status": status} for name, status in (STATUSES | UNBILLED).items()}
    raw |= {name: {"content": body(), "status": status, "billed": False} for name, status in REDIRECTS.items()}
    explained = {"content": FAILED, "billed": False}
    raw |= {name: explained | {"status": status} for name, status in EXPLAINED.items()}
    for name, (error, _) in REFUSED_IN_200.items():
        raw[f"in-200-{name}"] = {"content": json.dumps({"error": error}), "billed": False}
    return shared_provider.afresh(raw_by_model=raw, usd_a_token=USD_A_TOKEN)


def asking(provider: Provider, entry: Entry) -> ApiBackend:
    return ApiBackend(entry, Account(key=KEY, base_url=f"{provider.url}/v1"))


def participants(provider: Provider, entry: Entry, cap_usd: float) -> Participants:
    return Participants({"m": entry}, lambda _: asking(provider, entry), Study(budget_usd=cap_usd), {"a": Account()})


def booked_for(provider: Provider, model: str) -> tuple[Outcome | None, float]:
    """What came of one call, and what the budget says that it cost."""

    async def one() -> tuple[Outcome | None, float]:
        budget = budget_of(10.0)
        participant = participants(provider, entry_of(model), 10.0)["m"]
        attempted = await ask_once(participant, request(), allowed_by(budget))
        return attempted and attempted[0], budget.spent_usd

    return asyncio.run(one())


@pytest.mark.parametrize("shape", [*ODD, *STATUSES])
def test_what_a_provider_bills_for_an_odd_answer_is_booked(odd: Provider, shape: str) -> None:
    outcome, booked_usd = booked_for(odd, shape)
    stats = odd.stats()
    assert outcome and booked_usd >= stats["billed_usd"] > 0.0
    assert stats["requests"] <= 2  # tried again once at most
    assert outcome.cost_usd == pytest.approx(booked_usd)  # the ledger's row holds all of it
    assert outcome.text in (None, ANSWER)


@pytest.mark.parametrize("shape", [*UNBILLED, *REDIRECTS, *EXPLAINED])
def test_a_call_that_a_provider_did_not_take_or_reports_as_failed_costs_nothing(odd: Provider, shape: str) -> None:
    outcome, booked_usd = booked_for(odd, shape)
    assert outcome and booked_usd == odd.stats()["billed_usd"] == 0.0


@pytest.mark.parametrize("name", REFUSED_IN_200)
def test_an_error_object_in_a_200_follows_the_code_that_it_carries(odd: Provider, name: str) -> None:
    outcome, booked_usd = booked_for(odd, f"in-200-{name}")
    assert outcome and (outcome.kind, outcome.error) == ("error", REFUSED_IN_200[name][1])
    assert booked_usd == odd.stats()["billed_usd"] == 0.0
    assert odd.stats()["requests"] == (1 if outcome.error.startswith("http_") else 2)  # what may pass is tried again


def test_an_error_object_that_is_the_whole_body_is_no_answer_out_of_order(odd: Provider) -> None:
    outcome, booked_usd = booked_for(odd, "in-200-flat")
    assert outcome and (outcome.kind, outcome.error) == ("error", "rate_limited")
    assert booked_usd == odd.stats()["billed_usd"] == 0.0
    beside = {"good": {"content": body(code=0, message="success")}}  # some gateways write a code beside an answer
    odd.configure(raw_by_model=beside)
    outcome, _ = booked_for(odd, "good")
    assert outcome and outcome.text == ANSWER


@pytest.mark.parametrize("name", ANSWERS)
def test_an_error_is_found_wherever_its_provider_puts_it_and_costs_nothing(odd: Provider, name: str) -> None:
    status, content, error, requests = ANSWERS[name]
    odd.configure(raw_by_model={"m": {"content": json.dumps(content), "status": status, "billed": False}})
    outcome, booked_usd = booked_for(odd, "m")
    assert outcome and outcome.error == error and booked_usd == 0.0
    assert outcome.kind == ("refused" if error == "content_policy" else "error")
    assert odd.stats()["requests"] == requests


@pytest.mark.parametrize("beside", NO_ERRORS, ids=str)
def test_an_error_object_that_reports_none_beside_an_answer_is_no_failure(
    odd: Provider, beside: dict[str, Any]
) -> None:
    odd.configure(raw_by_model={"m": {"content": body(**beside)}})
    outcome, booked_usd = booked_for(odd, "m")
    assert outcome and outcome.text == ANSWER and booked_usd == pytest.approx(20e-6 + 21e-5)


@pytest.mark.parametrize(
    "choice",
    [
        {"finish_reason": "content_filter", "message": {"content": None}},
        {"finish_reason": "stop", "message": {"content": None, "refusal": "No, I cannot help with that."}},
        {"finish_reason": "stop", "message": {"content": ""}},
    ],
)
def test_a_refusal_before_any_token_costs_its_prompt(odd: Provider, choice: dict[str, Any]) -> None:
    counts = {"prompt_tokens": 900, "completion_tokens": 0, "total_tokens": 900}
    for said in (counts, {name: value for name, value in counts.items() if name != "completion_tokens"}):
        odd.configure(raw_by_model={"m": {"content": body(choices=[CHOICE | choice], usage=said)}})
        assert booked_for(odd, "m")[1] == pytest.approx(900e-6)


def test_an_answer_is_paid_as_its_usage_says(odd: Provider) -> None:
    odd.configure(raw_by_model={"good": {"content": body()}, "thinks": {"content": usage(total_tokens=1041)}})
    outcome, booked_usd = booked_for(odd, "good")
    assert outcome and (outcome.text, outcome.prompt_tokens, outcome.completion_tokens) == (ANSWER, 20, 21)
    assert booked_usd == pytest.approx(20e-6 + 21e-5)
    assert booked_for(odd, "thinks")[1] == pytest.approx(20e-6 + 1021e-5)  # what the sum alone tells was thought


def test_a_limit_that_a_provider_ignores_is_believed_up_to_a_bound(odd: Provider) -> None:
    over = {"content": usage(completion_tokens=20_000, total_tokens=20_020)}
    absurd = {"content": usage(completion_tokens=10**9, total_tokens=10**9 + 20)}
    odd.configure(raw_by_model={"over": over, "absurd": absurd})
    assert booked_for(odd, "over")[1] == pytest.approx(20e-6 + 0.2)
    assert booked_for(odd, "absurd")[1] < OVERRUN * 0.081


@pytest.mark.parametrize(
    ("said", "completion"),
    [
        (usage(completion_tokens=80_000, total_tokens=0), 80_000),
        (usage(prompt_tokens=None, completion_tokens=80_000), 80_000),
        (body(usage={"total_tokens": 80_020, "prompt_tokens": 20}), 80_000),
    ],
)
def test_a_usage_that_contradicts_itself_is_booked_at_its_largest_and_said(
    odd: Provider, said: str, completion: int, capsys: pytest.CaptureFixture[str]
) -> None:
    odd.configure(raw_by_model={"m": {"content": said}})
    with progress.use_progress(progress.Progress()):
        outcome, booked_usd = booked_for(odd, "m")
    assert booked_usd >= completion * 1e-5 and outcome and outcome.text == ANSWER
    told = capsys.readouterr().err
    assert "(usage: " in told and str(completion) in told


def test_half_an_answer_is_asked_again_and_costs_what_its_usage_says(odd: Provider) -> None:
    odd.configure(raw_by_model={"m": {"content": body(choices=[CHOICE | {"finish_reason": "abort"}])}})
    outcome, booked_usd = booked_for(odd, "m")
    assert outcome and (outcome.kind, outcome.error, outcome.text) == ("error", "ended_abort", None)
    assert odd.stats()["requests"] == 2
    assert booked_usd == outcome.cost_usd == pytest.approx(2 * (20e-6 + 21e-5))


def test_an_unknown_finish_reason_is_kept_with_its_text_and_is_no_answer(odd: Provider) -> None:
    odd.configure(raw_by_model={"m": {"content": body(choices=[CHOICE | {"finish_reason": "of_the_weather"}])}})
    outcome, _ = booked_for(odd, "m")
    assert outcome and (outcome.kind, outcome.finish_reason) == ("unfinished", "of_the_weather")
    assert (outcome.text, outcome.cost_usd) == (ANSWER, pytest.approx(20e-6 + 21e-5))


def test_what_is_odd_beside_the_usage_is_typed_and_stored(odd: Provider, tmp_path: Path) -> None:
    said = {
        "m-number": body(model=5),
        "m-surrogate": body(model="gpt \ud83d"),
        "text-surrogate": message(content="left \ud83d"),
        "finish-number": body(choices=[CHOICE | {"finish_reason": 7}]),
        "reasoning-list": message(reasoning_content=["left"]),
        "long-name": body(model="m" * 100_000),
    }
    odd.configure(raw_by_model={name: {"content": content} for name, content in said.items()})
    for name in said:
        outcome, _ = booked_for(odd, name)
        assert outcome is not None
        assert outcome.served_model is None or len(outcome.served_model) <= 200
        json.dumps(vars(outcome)).encode()
        for value in (outcome.text, outcome.served_model, outcome.finish_reason, outcome.reasoning):
            assert value is None or value.encode()
    outcome, _ = booked_for(odd, "text-surrogate")
    assert outcome and (outcome.text, outcome.served_model, outcome.cost_usd) == ("left ?", "m", pytest.approx(0.00023))


def work(provider: Provider, entry: Entry, cap_usd: float, items: int, folder: Path) -> Iterator[Any]:
    ledger = local(folder)
    calls = [Call(request(item)) for item in range(items)]
    asked = participants(provider, entry, cap_usd)
    with budget_in(ledger, cap_usd) as budget:
        done = Work("responses", ledger, asked, budget, "1", lambda _: calls, lambda settled: settled)
        yield from run_work(done, [Cell("occlusion", Evaluation("m", "standard", 1))])


def test_three_answers_out_of_order_in_a_row_stop_a_model_and_are_kept_aside(odd: Provider, tmp_path: Path) -> None:
    odd.configure(raw_by_model={"m": {"content": f"\x1b[2J<h1>{SECRET}</h1>" + "x" * 9000}})
    with raises(TrapsError, "models.asking.ask._raise_together", "3 "):
        list(work(odd, entry_of("m", concurrency=1), 100.0, 20, tmp_path))
    assert odd.stats()["requests"] == 4  # the third in a row is not worth a second try, nor is any later one
    raws = [beside["raw"] for _, beside in local(tmp_path).rows("m__standard__run1")]
    assert raws == ["\x1b[2J<h1>***</h1>" + "x" * (4000 - 16)] * 3
    assert SECRET not in "".join(path.read_bytes().decode("latin-1") for path in tmp_path.rglob("*") if path.is_file())


def test_a_redirect_costs_nothing_and_stops_the_model_after_the_first(odd: Provider, tmp_path: Path) -> None:
    headers = {"Location": "https://elsewhere.invalid/v1"}
    odd.configure(raw_by_model={"m": {"content": "", "status": 308, "headers": headers, "billed": False}})
    with raises(TrapsError, "models.asking.ask._raise_together", "http_308", "`base_url`"):
        list(work(odd, entry_of("m", concurrency=1), 1.0, 20, tmp_path))
    assert odd.stats()["requests"] == 1
    assert [row["cost_usd"] for row, _ in local(tmp_path).rows("m__standard__run1")] in ([0.0], [None])


def test_whole_answers_that_nobody_can_read_cost_no_more_than_the_calls_in_flight(
    odd: Provider, tmp_path: Path
) -> None:
    odd.configure(raw_by_model={"m": {"content": "no JSON"}})
    with raises(TrapsError, "models.asking.ask._raise_together"):
        list(work(odd, entry_of("m", concurrency=24), 100.0, 200, tmp_path))
    assert odd.stats()["requests"] <= 24 + 2


def test_the_cap_holds_against_fuzzed_answers(odd: Provider) -> None:
    odd.configure(raw_by_model={}, fuzzed=True)
    connections, calls = 200, 1000 if os.environ.get("TRAPS_MANY_CALLS") else 450
    entry = entry_of("m", concurrency=connections)
    entry = entry.model_copy(update={"params": PARAMS | {"max_tokens": 500}})
    participant = participants(odd, entry, 100.0)["m"]
    cap_usd, budget = 1.0, budget_of(1.0)

    async def worker(queue: list[int]) -> None:
        while queue:
            sent = Request("m", "openai/m", entry.params, "You watch.", f"Which, {queue.pop()}?", {})
            await ask_once(participant, sent, allowed_by(budget))

    async def run() -> bool:
        queue = list(range(calls))
        done = await asyncio.gather(*(worker(queue) for _ in range(connections)), return_exceptions=True)
        assert all(each is None or isinstance(each, BudgetReached) for each in done)
        return not queue

    asked_all = asyncio.run(run())
    billed = odd.stats()["billed_usd"]
    assert 0.0 < billed <= budget.spent_usd <= cap_usd
    assert asked_all or budget.spent_usd > 0.9 * cap_usd


def test_keys_do_not_follow_a_redirect_to_another_host(odd: Provider) -> None:
    with Provider.start() as foreign:
        for status in (301, 302, 307, 308):
            headers = {"Location": f"{foreign.url}/v1/chat/completions"}
            odd.configure(raw_by_model={"m": {"content": "", "status": status, "headers": headers}})
            outcome, booked_usd = booked_for(odd, "m")
            assert outcome and (outcome.kind, outcome.error) == ("error", f"http_{status}") and booked_usd == 0
        assert foreign.stats()["requests"] == 0


def test_words_of_a_provider_cannot_steer_a_terminal(odd: Provider, capsys: pytest.CaptureFixture[str]) -> None:
    error = json.dumps({"error": {"message": "\x1b[2J\x1b]52;c;ZWNobw==\x07 \u202enever", "type": "x", "code": "y"}})
    odd.configure(raw_by_model={"m": {"content": error, "status": 404}})
    with progress.use_progress(progress.Progress()):
        assert booked_for(odd, "m")[0] == Outcome("error", error="http_404", cost_usd=0.0)
    told = capsys.readouterr().err
    assert "(http_404: " in told and told.count("\n") == 1
    assert all(char.isprintable() for char in told[:-1])
