"""Reference strategies play by their rules on either side, and the same way every time."""

from __future__ import annotations

import asyncio
import json
from dataclasses import replace
from math import exp
from typing import Any

import pytest

from traps_pipeline.models.baselines.reference import (
    ABSTENTION,
    STRATEGIES,
    ReferenceBackend,
    believed_probabilities,
    uniform,
)
from traps_pipeline.models.registry.entries import get_model
from traps_pipeline.models.request import Request, TransientError
from traps_pipeline.protocol.regimes import FIELDS

LABELS = ["left", "right", "elsewhere"]
BAYES = ("bayes", "bayes-cautious", "bayes-rash")


def said(asked: Request) -> Any:
    """What the backend answers, read from its JSON."""
    return json.loads(str(asyncio.run(ReferenceBackend().ask(asked)).text))


def first_token(asked: Request) -> dict[str, float] | None:
    """The probabilities of its first token."""
    given = asyncio.run(ReferenceBackend().ask(asked)).first_token
    return None if given is None else {token: exp(logprob) for token, logprob in json.loads(given).items()}


def request(side: str, item: int = 0, regime: str = "standard", **params: Any) -> Request:
    secret: dict[str, Any] = {"side": side, "labels": LABELS, "commonest_answer": "elsewhere"}
    if side == "control":
        secret["ground_truth"] = "right"
    about = {"item_id": f"{side}-{item}", "model": "m", "regime": regime, "run": 1}
    return Request("m", "reference", params, "system", "question", about, secret=secret)


@pytest.mark.parametrize(
    ("strategy", "control", "void"),
    [
        ("oracle", {"right"}, {None}),
        ("always-abstain", {None}, {None}),
        ("never-abstain", {"left"}, {"left"}),
        ("perfect-answerer", {"right"}, set(LABELS)),
        ("inverse-oracle", {None}, set(LABELS)),
        ("prior", {"elsewhere"}, {"elsewhere"}),
    ],
)
def test_a_strategy_says_what_its_name_says(strategy: str, control: set[str | None], void: set[str | None]) -> None:
    for side, answers in (("control", control), ("void", void)):
        assert {STRATEGIES[strategy](request(side, n)) for n in range(50)} == answers


@pytest.mark.parametrize(("model", "rate"), [("random-50", 0.5), ("confidence-noise", 0.2)])
def test_an_abstention_rate_holds_on_both_sides_within_three_sigma(model: str, rate: float) -> None:
    n, params = 2000, get_model(model).params
    for side in ("control", "void"):
        count = sum(STRATEGIES["abstain-at-rate"](request(side, k, **params)) is None for k in range(n))
        assert abs(count - n * rate) <= 3 * (n * rate * (1 - rate)) ** 0.5  # 67 of 1,000; 54 of 400


def test_a_strategy_gives_the_first_token_of_its_answer_the_probability_that_it_believes() -> None:
    asked = request("control", regime="logprobs", **get_model("bayes").params)
    asked = replace(asked, secret={**asked.secret, "posterior": {"left": 0.8, "elsewhere": 0.2}})
    assert first_token(asked) == pytest.approx({"left": 0.8, "elsewhere": 0.2})
    assert first_token(request("control", regime="logprobs", strategy="always-abstain")) == {ABSTENTION: 1.0}
    assert first_token(request("control", strategy="oracle")) is None


def test_bayes_answers_what_is_probable_enough_and_states_what_it_believes() -> None:
    asked = request("control", regime="probabilities", **get_model("bayes").params)
    asked = replace(asked, secret={**asked.secret, "posterior": {"left": 0.8, "elsewhere": 0.2}})
    stated = {one["answer"]: one["probability"] for one in said(asked)["probabilities"]}
    assert stated == {"left": 0.8, "right": 0.0, "elsewhere": 0.2}
    answers = {name: STRATEGIES["bayes"](replace(asked, params=get_model(name).params)) for name in BAYES}
    assert answers == {"bayes": "left", "bayes-cautious": None, "bayes-rash": "left"}
    noisy = get_model("bayes-noisy").params
    shares = [
        believed_probabilities(replace(request("control", k), secret=asked.secret, params=noisy))["left"]
        for k in range(200)
    ]
    assert min(shares) < 0.5 < 0.75 < max(shares)


@pytest.mark.parametrize("model", ["bayes", "bayes-cautious"])
def test_without_futures_bayes_is_the_oracle(model: str) -> None:
    params = get_model(model).params
    assert STRATEGIES["bayes"](request("control", **params)) == "right"
    assert STRATEGIES["bayes"](request("void", **params)) is None


def test_what_looks_random_is_the_same_every_time_and_differs_between_seeds() -> None:
    def drawn(seed: int) -> list[str | None]:
        strategy = STRATEGIES["abstain-at-rate"]
        return [strategy(request("void", k, abstain_probability=0.5, seed=seed)) for k in range(100)]

    assert drawn(1) == drawn(1)
    assert drawn(1) != drawn(2)
    draws = [uniform(request("void", k), "x") for k in range(2000)]
    assert min(draws) >= 0 and max(draws) < 1
    assert abs(sum(draws) / 2000 - 0.5) < 3 * (1 / 12 / 2000) ** 0.5


def test_the_json_regime_is_answered_in_json_and_the_others_in_words() -> None:
    spoken = asyncio.run(ReferenceBackend().ask(request("control", strategy="oracle")))
    assert str(spoken.text).endswith("The answer is: right.")
    for side, answer in (("control", "right"), ("void", ABSTENTION)):
        assert said(request(side, regime="json", strategy="oracle"))["final_answer"] == answer


def test_the_flaky_provider_fails_in_the_shares_that_its_entry_says() -> None:
    backend, params = ReferenceBackend(), get_model("flaky").params
    seen: dict[str, int] = {}

    async def call(r: Request) -> str:
        for _ in range(3):
            try:
                return (await backend.ask(r)).kind
            except TransientError as error:
                kind = error.kind
        return kind

    for k in range(1000):
        kind = asyncio.run(call(request("control", k, **params)))
        seen[kind] = seen.get(kind, 0) + 1
    expected = {"empty": 0.1, "refused": 0.1, "timeout": 0.05, "answer": 0.75}  # 429s pass at the third try
    assert seen.keys() == expected.keys()
    for kind, share in expected.items():
        assert abs(seen[kind] - 1000 * share) <= 3 * (1000 * share * (1 - share)) ** 0.5


@pytest.mark.parametrize(
    ("dataset", "of_void"),
    [
        ("schema_answer", {"final_answer": ABSTENTION}),
        ("schema_abstain", {"abstain": True, "final_answer": ABSTENTION}),
        ("schema_reason", {"final_answer": ABSTENTION}),
    ],
)
def test_the_oracle_answers_with_the_object_that_a_dataset_asks_for(dataset: str, of_void: dict[str, Any]) -> None:
    asked = request("void", strategy="oracle")
    varied = replace(asked, about={**asked.about, "item_id": f"{dataset}:plinko-0001:void"})
    given = said(varied)
    assert {name: given[name] for name in of_void} == of_void and tuple(given) == FIELDS[dataset]
