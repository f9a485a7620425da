"""Define the regimes: system prompts for models, their texts and answer formats."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True)
class Regime:
    """A system prompt, of files of `assets/prompts`, and its answer format.

    fields: fields of the JSON object that an answer must be; none: free text. states: the texts under which hidden
    states are read (docs/spec.md 7.1); none: no states are read under this regime. marker: marker of a model's point in
    the landscape. first_token: whether the log-probabilities of the answer's first token are stored and scored.
    """

    name: str
    texts: tuple[str, ...]
    fields: tuple[str, ...] = ()
    states: tuple[str, ...] = ()
    marker: Literal["hollow", "filled", "dot"] = "dot"
    first_token: bool = False


# To add a regime, add an entry here and its texts in `assets/prompts`; a name is of lower-case letters.
BY_NAME: Mapping[str, Regime] = {
    regime.name: regime
    for regime in (
        Regime("standard", ("standard",), states=("vqa_standard",), marker="hollow"),
        Regime("guided", ("standard", "guided_suffix"), states=("vqa_standard", "vqa_guided_suffix"), marker="filled"),
        Regime("json", ("standard", "json_suffix"), fields=("reason", "final_answer")),
        Regime("priced", ("standard", "priced_suffix")),
        Regime(
            "probabilities", ("standard", "probabilities_suffix"), fields=("reason", "probabilities", "final_answer")
        ),
        Regime("logprobs", ("vqa_standard", "logprobs_suffix"), first_token=True),
    )
}
# The fields of a JSON answer, by the regime or dataset that asks for it; any other answer is free text.
FIELDS: Mapping[str, tuple[str, ...]] = {
    **{name: regime.fields for name, regime in BY_NAME.items() if regime.fields},
    "schema_answer": ("final_answer",),
    "schema_reason": ("reason", "final_answer"),
    "schema_abstain": ("reason", "abstain", "final_answer"),
}
# What `priced_suffix.txt` states: a right answer earns 1 point, a wrong one costs these, an abstention earns nothing.
WRONG_COSTS = 3
ANSWER_FROM = WRONG_COSTS / (1 + WRONG_COSTS)  # the probability of being right from which an answer is worth its risk
REGIMES = tuple(BY_NAME)
PAPER_REGIMES = ("standard", "guided", "json")  # the paper's, and the default of an experiment
VQA_PROMPTS = tuple(name for name, regime in BY_NAME.items() if regime.states)
# The paper compares answers under these two: the plain prompt, and the one that permits an abstention.
STANDARD, GUIDED = PROMPTING = ("standard", "guided")
PROBE_PROMPT = STANDARD  # probes are of this VQA prompt, the other one serves directions (docs/spec.md 7.1)
# Extractions under PROBE_PROMPT of the same network with random weights, by seed: controls of claims about states.
RANDOM_WEIGHTS = {"random_0": 0, "random_1": 1}


def fields_of(regime: str, dataset: str = "") -> tuple[str, ...] | None:
    """Return a regime's JSON fields (a dataset may vary them); None for free text."""
    return FIELDS.get(dataset, FIELDS.get(regime))


def one_of(names: tuple[str, ...]) -> str:
    """Return the names as an English list, for a sentence about a column."""
    return f"{', '.join(names[:-1])} or {names[-1]}"
