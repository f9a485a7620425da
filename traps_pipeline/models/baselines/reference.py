"""Answer by keyless strategies that take a paid model's path (docs/spec.md 5.3).

Only they see a request's `secret` (side, ground truth, labels). Their random choices are digests of the request, so a
crash and a second run give the same answers.
"""

import json
from collections import Counter
from collections.abc import Callable, Mapping
from math import exp, log
from statistics import NormalDist
from typing import Any

from traps_pipeline.base.digests import digest
from traps_pipeline.models.reading.first_token import stored_alternatives
from traps_pipeline.models.request import Outcome, Request, TransientError
from traps_pipeline.protocol.datasets import dataset_of
from traps_pipeline.protocol.regimes import fields_of

ABSTENTION = "I don't know"
_DOUBT = 0.01  # added to each probability by `bayes` with noise, so that it can be wrong if one is 1
_TINY = 1e-12
Strategy = Callable[[Request], str | None]  # returns a label, or None for an abstention


def uniform(request: Request, purpose: str) -> float:
    """Return a number in [0, 1) from the request's key and the purpose alone."""
    return int(digest([request.key, purpose])[:13], 16) / 16**13


def _truth(request: Request) -> str:
    """Return the right answer on a control; on a void, which has none, a guess."""
    secret = request.secret
    if secret["side"] == "control":
        return secret["ground_truth"]
    labels = secret["labels"]
    return labels[int(uniform(request, "guess") * len(labels))]


def _abstain_randomly(parameter: str) -> Strategy:
    """Return a strategy that abstains with a fixed probability on each side."""

    def strategy(request: Request) -> str | None:
        return None if uniform(request, "abstain") < request.params[parameter] else _truth(request)

    return strategy


def believed_probabilities(request: Request) -> dict[str, float]:
    """Return the probability that `bayes` assigns to each answer.

    It follows the futures of a graded cut, otherwise the oracle's knowledge (nothing about a void). noise: standard
    deviation of the error of log-probabilities.
    """
    secret, noise = request.secret, request.params["noise"]
    truth, even_probabilities = {secret.get("ground_truth"): 1.0}, dict.fromkeys(secret["labels"], 1.0)
    probabilities = secret.get("posterior") or (truth if secret["side"] == "control" else even_probabilities)
    weights = dict[str, float]()
    for label in secret["labels"]:
        error = NormalDist().inv_cdf(uniform(request, f"noise {label}") or _TINY) if noise else 0.0
        weights[label] = (probabilities.get(label, 0.0) + (_DOUBT if noise else 0.0)) * exp(noise * error)
    return {label: weight / sum(weights.values()) for label, weight in weights.items()}


def _bayes(request: Request) -> str | None:
    """Return the most probable answer, if its probability reaches `answers_from`."""
    probability_of = believed_probabilities(request)
    best = max(probability_of, key=lambda label: probability_of[label])
    return best if probability_of[best] >= request.params["answers_from"] else None


STRATEGIES: Mapping[str, Strategy] = {
    "oracle": lambda r: r.secret["ground_truth"] if r.secret["side"] == "control" else None,
    "always-abstain": lambda r: None,
    "never-abstain": lambda r: r.secret["labels"][0],
    "perfect-answerer": _truth,
    "inverse-oracle": lambda r: None if r.secret["side"] == "control" else _truth(r),
    "abstain-at-rate": _abstain_randomly("abstain_probability"),
    "prior": lambda r: r.secret["commonest_answer"],
    "bayes": _bayes,
}


def phrase(answer: str | None, request: Request) -> str:
    """Return the text of an answer in the form that the request's regime asks for (plain or JSON)."""
    if answer is None:
        reason, final = "The clip does not show what decides the outcome.", ABSTENTION
    else:
        reason, final = "I followed the motion to the end of the clip.", answer
    if fields := fields_of(str(request.about["regime"]), dataset_of(str(request.about["item_id"]))):
        answer_object = {"reason": reason, "abstain": answer is None, "final_answer": final}
        return json.dumps({name: (answer_object | _stated_probabilities(answer, request))[name] for name in fields})
    return f"{reason} {ABSTENTION}." if answer is None else f"{reason} The answer is: {final}."


def _stated_probabilities(answer: str | None, request: Request) -> dict[str, Any]:
    """Return the probabilities of `bayes`; for others all for the answer, and none for an abstention."""
    probability_of = _belief(answer, request)
    return {"probabilities": [{"answer": label, "probability": round(p, 4)} for label, p in probability_of.items()]}


def _belief(answer: str | None, request: Request) -> dict[str, float]:
    if request.params.get("strategy") == "bayes":
        return believed_probabilities(request)
    return {answer: 1.0} if answer else {}


class ReferenceBackend:
    """A backend that plays one strategy; with `faults` it fails like a bad provider."""

    def __init__(self) -> None:
        self._attempts: Counter[str] = Counter()

    async def ask(self, request: Request) -> Outcome:
        """Return the outcome of one attempt to answer a request."""
        import asyncio

        await asyncio.sleep(0)
        misfortune = self._misfortune(request)
        if misfortune is not None:
            return misfortune
        answer = STRATEGIES[request.params["strategy"]](request)
        logprob_of = {label: log(p) for label, p in _belief(answer, request).items() if p} or {ABSTENTION: 0.0}
        return Outcome(
            "answer",
            phrase(answer, request),
            finish_reason="stop",
            served_model=request.participant,
            cost_usd=0.0,
            first_token=stored_alternatives(logprob_of, request.about.get("regime")),
        )

    def _misfortune(self, request: Request) -> Outcome | None:
        """Return a simulated failure by the `faults` shares, or None for an answer."""
        faults: Mapping[str, Any] = request.params.get("faults", {})
        if not faults:
            return None
        draw = uniform(request, "fault")
        if draw < (edge := faults["empty"]):
            return Outcome("empty", finish_reason="stop", served_model=request.participant, cost_usd=0.0)
        if draw < (edge := edge + faults["refused"]):
            return Outcome("refused", finish_reason="content_filter", served_model=request.participant, cost_usd=0.0)
        if draw < (edge := edge + faults["failing"]):
            raise TransientError("timeout")
        self._attempts[request.key] += 1
        if draw < edge + faults["transient"] and self._attempts[request.key] <= 2:
            raise TransientError("rate_limited", retry_after_s=0.001)
        return None
