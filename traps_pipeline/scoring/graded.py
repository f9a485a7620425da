"""Score answers to graded cuts against the true distribution over answers.

See docs/scoring.md, "Graded cuts". A right answer earns 1 point, a wrong one costs WRONG_COSTS, an abstention earns
nothing. The expected points of an answer follow from the posterior of its cut, so no metric here depends on which of
the futures was filmed.
"""

import json
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import exp
from typing import Any, cast

import numpy as np
import pandas as pd

from traps_pipeline.models.reading.judged_answers import is_correct, read_object, to_label
from traps_pipeline.protocol.regimes import ANSWER_FROM, BY_NAME, WRONG_COSTS, fields_of
from traps_pipeline.scoring.bootstrap import RESAMPLES, SEED, Resampling, draw_scenarios, ends_of_shares, with_interval
from traps_pipeline.scoring.metrics import joined_epochs, joined_versions
from traps_pipeline.scoring.score_rows import GRADED_CUTS

SCOPES = (0.0, 0.45, 0.6, ANSWER_FROM, 0.9)  # lower ends of ranges of the commonest answer's probability
SUM_WITHIN = 0.05  # allowed deviation of a sum of probabilities from 1
WITH_INTERVAL = {"points": (-WRONG_COSTS, 1.0), "regret": (0.0, 1.0 + WRONG_COSTS), "brier": (0.0, 2.0)}  # their limits
PARTS = ("regret_label", "regret_rash", "regret_shy")
_ANSWER = ["item_id", "model", "regime", "run"]
_MEANS = ("top", *PARTS, "abstains_right", "abstains_wrong", "stated", "brier_ideal", "brier_even")
_MEANS += ("points_ideal", "points_best", "points_prior")
_METRICS = ["answers", "wrong", *WITH_INTERVAL, *_MEANS]
_ROUNDING = 1e-9


@dataclass(frozen=True)
class GradedItem:
    """An item whose clip is cut early, with the probability of each answer at the cut.

    posterior: the probability of each possible answer.

    commonest: the sub-scenario's commonest answer.
    """

    labels: Sequence[str]
    aliases: Mapping[str, str]
    answer_type: str
    commonest: str
    posterior: Mapping[str, float]

    def label_of(self, value: str | None) -> str | None:
        """Return the answer that a model's value names by the rules of correctness, or None."""
        of = self.answer_type, self.labels, self.aliases
        return next((label for label in self.labels if is_correct(value, label, *of)), None)

    def read_probabilities(self, text: str | None) -> dict[str, float] | None:
        """Return the probability that a text states for each answer.

        The text is a JSON object with `probabilities`; the rest to 1 is shared evenly among answers that it does not
        name. None if it states none, names an answer twice, or sums to something else than 1.
        """
        entries = (read_object(text or "") or {}).get("probabilities")
        probability_of = dict[str, float]()
        for entry in entries if isinstance(entries, list) else [None]:
            if not isinstance(entry, dict):
                return None
            label, number = to_label(str(entry.get("answer")), self.labels, self.aliases), entry.get("probability")
            if isinstance(number, bool) or not isinstance(number, int | float) or not 0 <= number <= 1:
                return None
            if label is None or label in probability_of:
                return None
            probability_of[label] = number
        unstated = [label for label in self.labels if label not in probability_of]
        remainder = 1 - sum(probability_of.values())
        if remainder < -SUM_WITHIN or (remainder > SUM_WITHIN and not unstated):
            return None
        probability_of |= dict.fromkeys(unstated, max(0.0, remainder) / max(1, len(unstated)))
        return {label: probability_of[label] / sum(probability_of.values()) for label in self.labels}

    def read_first_token(self, alternatives: object) -> dict[str, float] | None:
        """Return each answer's probability by first-token log-probabilities, if any.

        A token counts for the answer that it names, or for the only answer with a name that starts with it; the
        remaining probability is shared evenly.
        """
        if not isinstance(alternatives, str):
            return None
        names = {name.casefold(): label for name, label in self.aliases.items()}
        names |= {label.casefold(): label for label in self.labels}
        probability_of = dict.fromkeys(self.labels, 0.0)
        for token, logprob in json.loads(alternatives).items():
            start = token.strip().strip("\"'*`.,:").casefold()
            labels = {label for name, label in names.items() if start and name.startswith(start)}
            labels = {names[start]} if start in names else labels
            if len(labels) == 1:
                probability_of[labels.pop()] += exp(logprob)
        total = sum(probability_of.values())
        remaining_share = max(0.0, 1 - total) / len(probability_of)
        return {label: (p + remaining_share) / max(1.0, total) for label, p in probability_of.items()}


def graded(
    verdicts: pd.DataFrame,
    votes: pd.DataFrame,
    responses: pd.DataFrame,
    questions: Mapping[str, GradedItem],
    resamples: int = RESAMPLES,
    seed: int = SEED,
) -> pd.DataFrame:
    """Return GRADED_CUTS rows from verdicts, votes, responses and items by id."""
    labels, response_of = _labels(votes, questions), responses.set_index(_ANSWER)
    texts, first_tokens = response_of["text"].to_dict(), response_of["first_token"].to_dict()
    rows = []
    for verdict in verdicts.to_dict("records"):
        key, item = tuple(verdict[name] for name in _ANSWER), questions[verdict["item_id"]]
        if "probabilities" in (fields_of(verdict["regime"]) or ()):
            metrics = _probability_metrics(item, item.read_probabilities(texts.get(key)))
        elif BY_NAME[verdict["regime"]].first_token:
            metrics = _probability_metrics(item, item.read_first_token(first_tokens.get(key)))
        else:
            metrics = _verdict_metrics(item, verdict["abstained"], labels.get(key))
        rows.append({**verdict, "taxonomy": "chaotic", "top": max(item.posterior.values()), **metrics})
    if not rows:
        return pd.DataFrame(columns=pd.Index(GRADED_CUTS.names))
    items = pd.DataFrame(rows).reindex(columns=[*verdicts.columns, "taxonomy", *_METRICS])
    resampling, table = draw_scenarios(items, resamples, seed), []
    starts = np.searchsorted(SCOPES, items["top"] + _ROUNDING, side="right") - 1
    for (model, regime), group in cast(Any, items.groupby(["model", "regime"], sort=True)):
        scopes = [("all", group), *((_name(k), part) for k, part in group.groupby(starts[group.index]))]
        table += [
            {"model": model, "regime": regime, "scope": scope, **_row(part, f"{model}|{regime}|{scope}", resampling)}
            for scope, part in scopes
            if part["points"].notna().any()
        ]
    return pd.DataFrame(table, columns=pd.Index(GRADED_CUTS.names))


def _name(scope: int) -> str:
    return f"{SCOPES[scope]:g} to {[*SCOPES, 1.0][scope + 1]:g}"


def _labels(votes: pd.DataFrame, questions: Mapping[str, GradedItem]) -> dict[tuple[Any, ...], str]:
    """Return each response's answer by a majority of its judges, if there is one.

    It is "" for an answer that the item does not offer.
    """
    cast_votes = votes.loc[votes["task"].eq("correctness"), [*_ANSWER, "valid", "extracted_value"]]
    label_of = dict[tuple[Any, ...], str]()
    for key, ballots in cast(Any, cast_votes.groupby(_ANSWER)):
        labels = [
            questions[key[0]].label_of(value if isinstance(value, str) else None) or ""
            for value in ballots.loc[ballots["valid"].astype(bool), "extracted_value"]
        ]
        label, n = Counter(labels).most_common(1)[0] if labels else ("", 0)
        if n > len(ballots) / 2:
            label_of[key] = label
    return label_of


def _verdict_metrics(item: GradedItem, abstained: object, label: str | None) -> dict[str, float]:
    """Return the metrics of a panel's decision; empty if it is undecided."""
    if pd.isna(cast(Any, abstained)) or (not abstained and label is None):
        return {}
    return answer_points(item, None if abstained else label)


def _probability_metrics(item: GradedItem, stated: Mapping[str, float] | None) -> dict[str, float]:
    """Return the metrics of stated probabilities; empty if there are none.

    The policy that acts on them gives the most probable answer, if its probability is at least ANSWER_FROM.
    """
    if stated is None:
        return {}
    likeliest = max(stated, key=lambda label: stated[label])
    acts = answer_points(item, likeliest if stated[likeliest] >= ANSWER_FROM - _ROUNDING else None)
    return acts | {"brier": brier(item.posterior, stated), "stated": stated[_commonest(item.posterior)]}


def answer_points(item: GradedItem, label: str | None) -> dict[str, float]:
    """Return an answer's expected points, and its losses (regret) by reason.

    The regret is the loss against an ideal observer. label: None for an abstention.
    """
    posterior, even = item.posterior, dict.fromkeys(item.labels, 1 / len(item.labels))
    best, probability = max(posterior.values()), 0.0 if label is None else posterior.get(label, 0.0)
    ideal, answers = max(0.0, expected_points(best)), label is not None
    points = expected_points(probability) if answers else 0.0
    return {
        "answers": float(answers),
        "wrong": 1 - probability if answers else np.nan,
        "points": points,
        "regret": ideal - points,
        "regret_label": expected_points(best) - expected_points(probability) if answers else 0.0,
        "regret_rash": ideal - expected_points(best) if answers else 0.0,
        "regret_shy": 0.0 if answers else ideal,
        "abstains_right": np.nan if expected_points(best) > 0 else float(not answers),
        "abstains_wrong": float(not answers) if expected_points(best) > 0 else np.nan,
        "brier_ideal": brier(posterior, posterior),
        "brier_even": brier(posterior, even),
        "points_ideal": ideal,
        "points_best": expected_points(best),
        "points_prior": expected_points(posterior.get(item.commonest, 0.0)),
    }


def expected_points(probability: float) -> float:
    """Return the expected points of an answer that is right with this probability."""
    return probability - WRONG_COSTS * (1 - probability)


def brier(posterior: Mapping[str, float], stated: Mapping[str, float]) -> float:
    """Return the expected Brier score of stated probabilities, from 0 to 2.

    For each answer, weighted by its true probability, sum the squared distances of the stated probabilities from 1 for
    that answer and from 0 for all others.
    """
    distance = sum((stated.get(label, 0.0) - posterior.get(label, 0.0)) ** 2 for label in {*stated, *posterior})
    return distance + 1 - sum(p**2 for p in posterior.values())


def _commonest(posterior: Mapping[str, float]) -> str:
    return max(posterior, key=lambda label: posterior[label])


def _row(items: pd.DataFrame, named: str, resampling: Resampling) -> dict[str, Any]:
    """Return scores of a model's and regime's items, each scenario counting once."""
    with_decision = items.loc[items["points"].notna()]
    scenario_means = with_decision.groupby("scenario_id")[_METRICS].mean()
    row: dict[str, Any] = {
        "n_runs": with_decision["run"].nunique(),
        "n_items": len(scenario_means),
        "n_missing": len(items) - len(with_decision),
        "coverage": scenario_means["answers"].mean(),
        "risk": with_decision["wrong"].mean(),
        **scenario_means[[*_MEANS]].mean(),
        "panel": joined_epochs(items["panel"]),
        "epoch": joined_epochs(items["epoch"]),
        "benchmark_version": joined_versions(items["benchmark_version"]),
    }
    for name, (low, high) in WITH_INTERVAL.items():
        scaled = (scenario_means[name].dropna() - low) / (high - low)
        ends = ends_of_shares(pd.DataFrame({"yes": scaled, "of": 1.0}), resampling, f"{named}|{name}")[:, 0]
        row |= with_interval(name, low + (high - low) * ends, (low, high))
    return row


def wrong_rows(table: pd.DataFrame) -> int:
    """Return the number of GRADED_CUTS rows that break their definition; null is not wrong.

    A row is wrong if a metric lies outside its limits or its interval, or if a regret is not the sum of its parts or
    not the distance to the ideal.
    """
    is_wrong = (table["regret"] - table[[*PARTS]].sum(axis=1)).abs().to_numpy(float) > _ROUNDING
    is_wrong |= (table["points"] + table["regret"] - table["points_ideal"]).abs().to_numpy(float) > _ROUNDING
    for name, (minimum, maximum) in WITH_INTERVAL.items():
        low, value, high = (table[f"{name}{end}"].to_numpy(float) for end in ("_ci_low", "", "_ci_high"))
        is_wrong |= (low > value + _ROUNDING) | (value > high + _ROUNDING) | (low < minimum) | (high > maximum)
    return int(is_wrong.sum())
