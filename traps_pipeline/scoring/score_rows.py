"""Define the tables of scores: metrics of cells, comparisons, the leaderboard."""

from dataclasses import dataclass
from typing import Annotated

from traps_pipeline.protocol.metric_words import COUNT_WORDS, METRIC_WORDS
from traps_pipeline.storage import columns as shared
from traps_pipeline.storage.tables import EachOf, ExtraColumns, Table, with_neighbours

# An entry is incomplete where fewer of its items than this have a text. With 1 % of the items missing, the worst and
# the best PECS are at most 0.04 apart (if all are controls: 2 % of Acc and 2 % of FalseAbs), half the 95 % interval of
# a middling model on 500 pairs (0.08); beyond that, which answers were lost may matter as much as which were sampled.
INCOMPLETE_BELOW = 0.99
BROKEN_ABOVE = 0.01  # a model that says nothing in more of its answers than this is marked

Mean = Annotated[float | None, "mean over runs"]
Deviation = Annotated[float | None, "population standard deviation over runs"]
Bootstrap = Annotated[
    float | None, "95 % interval, Bayesian bootstrap over scenarios with one unseen; null without a value"
]
# Marks of a metric, which declare the columns beside it.
STD, CI, WILSON = (
    ExtraColumns(("_std",), Deviation),
    ExtraColumns(("_ci_low", "_ci_high"), Bootstrap),
    ExtraColumns(("_low", "_high"), shared.Wilson),
)
# Marks of a field that stands for each metric of the leaderboard, or each of its counts.
EACH_METRIC = EachOf({metric.name: metric.meaning for metric in METRIC_WORDS.values()})
EACH_COUNT, EACH_COUNT_OF_DECISIONS = (
    EachOf({c.name: c.meaning for c in COUNT_WORDS.values() if c.is_of_decisions == of_decisions})
    for of_decisions in (False, True)
)
Refused = Annotated[str | None, "why the two may not be compared"]
DatasetOrOverall = Annotated[str, "one of four, or overall"]


@dataclass(frozen=True, kw_only=True)
@with_neighbours
class MetricsRow(shared.CellRow):
    """A cell: one model, regime and run on one scope of a dataset."""

    scope: Annotated[str, "all, category:.., sub_scenario:.. or label:../.. (the control's answer in a sub-scenario)"]
    n_pairs: Annotated[int, "pairs in scope"]
    n_missing: Annotated[int, "asked items without an answer or a majority"]
    counts: Annotated[int, "", EACH_COUNT]
    decisions: Annotated[int | None, "", EACH_COUNT_OF_DECISIONS]
    n_answered: Annotated[int, "items with an answer"]
    metrics: Annotated[float | None, "", EACH_METRIC]
    pecs_low: Annotated[float, "pecs of all pairs if every missing decision were the worst for the model"]
    pecs_high: Annotated[float, "pecs of all pairs if every missing decision were the best for the model"]
    naive: Annotated[float | None, "acc x abs_rec"]
    n_acc: Annotated[int, "controls decided on correctness: the denominator of acc"]
    n_false_abs: Annotated[int, "controls decided on abstention"]
    n_abs_rec: Annotated[int, "voids decided on abstention"]
    acc_low: Annotated[float | None, "95 % Wilson interval of this run alone, as if its pairs were independent"]
    acc_high: shared.Wilson
    false_abs_low: shared.Wilson
    false_abs_high: shared.Wilson
    abs_rec_low: shared.Wilson
    abs_rec_high: shared.Wilson
    panel: shared.Panels
    epoch: shared.AnswerEpochs
    benchmark_version: shared.BenchmarkVersion


METRICS = Table("metrics", MetricsRow, partition_by=("dataset",), key=("dataset", "model", "regime", "run", "scope"))


@dataclass(frozen=True, kw_only=True)
class ContrastRow:
    """A paired comparison of two models, or two regimes of one model, on one score."""

    kind: Annotated[str, "models (of one regime) or regimes (of one model)"]
    dataset: DatasetOrOverall
    metric: Annotated[str, "pecs or j"]
    left_model: shared.Model
    left_regime: shared.Regime
    right_model: shared.Model
    right_regime: shared.Regime
    n_scenarios: Annotated[int | None, "scenarios that both sides answered; null where refused"]
    difference: Annotated[float | None, "left minus right, means over runs; null where refused"]
    ci_low: Bootstrap
    ci_high: Bootstrap
    p: Annotated[
        float | None,
        "two-sided, from the share of resamples on either side of 0 (where none lies beyond it, from a normal tail); "
        "never below 2^(1 - n_scenarios)",
    ]
    p_holm: Annotated[
        float | None,
        "corrected by Holm over the rows of the same kind, dataset and metric (for models, also the same regime)",
    ]
    separable: Annotated[bool | None, "whether p_holm is below 0.05; null: too few scenarios for any answers to be"]
    refused: Refused


CONTRASTS = Table(
    "contrasts",
    ContrastRow,
    partition_by=(),
    key=("kind", "dataset", "metric", "left_model", "left_regime", "right_model", "right_regime"),
)


@dataclass(frozen=True, kw_only=True)
class RegimeTestRow:
    """A McNemar test of two regimes on one decision about the same items, in one run."""

    dataset: shared.Dataset
    model: shared.Model
    run: shared.Run
    decision: Annotated[str, "void_abstention, control_abstention or correctness"]
    left_regime: shared.Regime
    right_regime: shared.Regime
    n: Annotated[int, "items decided under both"]
    only_left: Annotated[int, "items with a yes (abstained, correct) under the left regime alone"]
    only_right: Annotated[int, "items with a yes under the right regime alone"]
    p: Annotated[float | None, "exact two-sided binomial test of only_left against only_right; null where refused"]
    p_holm: Annotated[float | None, "corrected by Holm over the rows of the same dataset, decision and regimes"]
    refused: Refused


REGIME_TESTS = Table(
    "regime_tests",
    RegimeTestRow,
    partition_by=(),
    key=("dataset", "model", "run", "decision", "left_regime", "right_regime"),
)


@dataclass(frozen=True, kw_only=True)
@with_neighbours
class LeaderboardRow(shared.EntryRow):
    """A model under a regime on one dataset, or overall (equal-weight mean of four)."""

    dataset: DatasetOrOverall
    n_runs: Annotated[int, "runs averaged"]
    n_pairs: Annotated[int, "pairs per run"]
    n_items: Annotated[int, "items per run: two a pair, but one of a held-out set"]
    n_missing: Annotated[int, "items without an answer or a majority, over runs"]
    counts: Annotated[int, "over runs", EACH_COUNT]
    decisions: Annotated[int | None, "over runs", EACH_COUNT_OF_DECISIONS]
    answered: Annotated[float, "share of asked items with an answer"]
    incomplete: Annotated[bool, "whether answered is below 0.99; for overall, in any of its datasets"]
    broken: Annotated[float, "share of items whose text is empty, truncated, unfinished, degenerate or unread"]
    is_broken: Annotated[bool, "whether broken is above 0.01; for overall, in any of its datasets"]
    metrics: Annotated[Mean, EACH_METRIC, STD, CI]
    rank: Annotated[
        int | None,
        "by PECS among models, or reference rows, of a regime, dataset and panel; ties share it; null if of two panels",
    ]
    rank_low: Annotated[
        int | None,
        "1 + the number of models whose PECS is higher by a paired contrast that is significant after correction",
    ]
    rank_high: Annotated[
        int | None,
        "number of models minus those whose PECS is lower by such a contrast; ranks in between are not separable",
    ]
    pecs_low: Annotated[float, "mean over runs: pecs if every missing decision were the worst for the model"]
    pecs_high: Annotated[float, "mean over runs: pecs if every missing decision were the best for the model"]
    naive: Annotated[float | None, "acc x abs_rec, mean over runs"]
    pecs_by_family: Annotated[float | None, "pecs of shares that are means over families, mean over runs"]


LEADERBOARD = Table("leaderboard", LeaderboardRow, partition_by=(), key=("model", "regime", "dataset"))


@dataclass(frozen=True, kw_only=True)
@with_neighbours
class TwoWayRow(shared.EntryRow):
    """A model under a regime on two events: is it the asked or the other event whose hiding makes it abstain?

    Metrics are means over runs. Beside them stands what must be inferred (the arms late_occluder and predictable_cut).
    """

    n_runs: Annotated[int, "runs averaged"]
    n_scenarios: Annotated[int, "scenarios of two events"]
    n_items: Annotated[int, "items per run"]
    n_missing: Annotated[int, "items without an answer or a majority, over runs"]
    conjunction: Annotated[float | None, "share of scenarios with all eight items right, of those with eight", CI]
    own_effect: Annotated[float | None, "rise of abstention from neither event hidden to the asked one alone", CI]
    other_effect: Annotated[float | None, "its rise from neither hidden to the other one alone", CI]
    specificity: Annotated[float | None, "own_effect - other_effect", CI]
    abstains_neither: Annotated[float | None, "share of questions abstained on, where neither event is hidden"]
    abstains_other: Annotated[float | None, "the same where the other event alone is hidden"]
    abstains_asked: Annotated[float | None, "the same where the asked event alone is hidden"]
    abstains_both: Annotated[float | None, "the same where both are hidden"]
    acc: Annotated[float | None, "share of the questions answered correctly that the clip answers"]
    inference_acc: Annotated[float | None, "share of the items of late_occluder and predictable_cut answered correctly"]
    inference_abstains: Annotated[float | None, "share of these items abstained on"]
    refused: Annotated[str | None, "why no metric joins the items; then all metrics are null"]


TWO_WAY = Table("two_way", TwoWayRow, partition_by=(), key=("model", "regime"))


@dataclass(frozen=True, kw_only=True)
@with_neighbours
class HypothesisRow(shared.EntryRow):
    """A model under a regime at one dose (docs/hypotheses.md), apart from PECS."""

    hypothesis: Annotated[str, "answer space, occluder, schema, frames or cut"]
    dose: Annotated[str, "what is changed, in words; the first dose of a hypothesis is the reference"]
    counts_as: Annotated[str, "control and void, control, void, or why it is neither"]
    n_runs: Annotated[int, "runs averaged"]
    n_scenarios: Annotated[int, "scenarios"]
    n_items: Annotated[int, "items per run"]
    n_missing: Annotated[int, "items without an answer or a majority, over runs"]
    acc: Annotated[float | None, "share of the controls' answers that are right", CI]
    false_abs: Annotated[float | None, "share of controls abstained on; of what is neither, the share abstained on", CI]
    abs_rec: Annotated[float | None, "share of voids abstained on", CI]
    j: Annotated[float | None, "abs_rec - false_abs", CI]
    compared: Annotated[str, "the metric that doses are compared by: j, or abstains, of all items of the dose"]
    value: Annotated[float | None, "that metric"]
    n_compared: Annotated[int | None, "scenarios that the dose and its reference both have; null where refused"]
    at_reference: Annotated[float | None, "that metric at the reference, on the scenarios that both have"]
    change: Annotated[float | None, "by how much the dose is above it; null where refused", CI]
    chance: Annotated[float | None, "Acc of a guess among the answers that the questions offer"]
    rule: Annotated[str | None, "of the rules with one cue that with the highest value here; null if none was run"]
    rule_value: Annotated[float | None, "its value"]
    rule_changing: Annotated[str | None, "of these rules that with the largest change, either way"]
    rule_change: Annotated[float | None, "its change"]
    refused: Annotated[str | None, "why the dose is not compared with its reference"]


HYPOTHESES = Table("hypotheses", HypothesisRow, partition_by=(), key=("model", "regime", "hypothesis", "dose"))


@dataclass(frozen=True, kw_only=True)
@with_neighbours
class GradedRow(shared.EntryRow):
    """A model under a regime on graded cuts, all of them or one range.

    See docs/scoring.md, "Graded cuts".

    All metrics are expectations under the posterior, the distribution over answers that the futures of a cut have.
    """

    scope: Annotated[str, "all, or the range of the commonest answer's probability, such as 0.6 to 0.75"]
    n_runs: Annotated[int, "runs averaged"]
    n_items: Annotated[int, "items with a decision in some run: what all metrics are of"]
    n_missing: Annotated[int, "items without a decision, over runs: no answer, no majority, no readable probabilities"]
    top: Annotated[float | None, "mean probability of the commonest answer"]
    coverage: Annotated[float | None, "share answered; of stated probabilities, where the largest is worth its risk"]
    risk: Annotated[float | None, "expected share of wrong answers among those"]
    points: Annotated[float | None, "expected a question: 1 for right, -3 for wrong, 0 for abstaining", CI]
    regret: Annotated[float | None, "what an ideal observer earns more, the sum of the next three", CI]
    regret_label: Annotated[float | None, "because another answer was given than the commonest"]
    regret_rash: Annotated[float | None, "because an answer was given where abstaining earns more"]
    regret_shy: Annotated[float | None, "because of abstaining where an answer earns more"]
    abstains_right: Annotated[float | None, "share abstained on where abstaining earns more"]
    abstains_wrong: Annotated[float | None, "share abstained on where an answer earns more"]
    stated: Annotated[
        float | None, "mean probability given to the commonest answer; null where the regime asks for none"
    ]
    brier: Annotated[float | None, "expected Brier score of these probabilities, from 0 to 2", CI]
    brier_ideal: Annotated[float, "that of the posterior itself"]
    brier_even: Annotated[float, "that of equal probabilities"]
    points_ideal: Annotated[float, "what an ideal observer earns"]
    points_best: Annotated[float, "what the commonest answer earns if it is always given"]
    points_prior: Annotated[float, "what the sub-scenario's commonest answer earns if it is always given"]


GRADED_CUTS = Table("graded", GradedRow, partition_by=(), key=("model", "regime", "scope"))


@dataclass(frozen=True, kw_only=True)
class LeaveOneOutRow:
    """A model under a regime on a dataset or overall, scored without one judge."""

    model: shared.Model
    regime: shared.Regime
    dataset: Annotated[str, "one of four, or overall (equal-weight mean over the four)"]
    without: Annotated[str, "the judge left out"]
    n_runs: Annotated[int, "runs averaged"]
    n_pairs: Annotated[int, "pairs per run"]
    n_missing: Annotated[int, "items without an answer or a majority of the two, over runs"]
    n_missing_panel: Annotated[int, "items without an answer or a majority of the three, over runs"]
    pecs: Annotated[float | None, "mean over runs of the per-run PECS of the two judges"]
    pecs_panel: Annotated[float | None, "mean over runs of the per-run PECS of the three judges"]
    difference: Annotated[float | None, "pecs - pecs_panel"]
    pecs_low: Annotated[float, "mean over runs: pecs of the two if every missing decision were the worst for the model"]
    pecs_high: Annotated[float, "mean over runs: pecs of the two if every missing decision were the best for the model"]
    epoch: shared.AnswerEpochs
    benchmark_version: shared.BenchmarkVersion


LEAVE_ONE_OUT = Table("leave_one_out", LeaveOneOutRow, partition_by=(), key=("model", "regime", "dataset", "without"))


@dataclass(frozen=True, kw_only=True)
@with_neighbours
class PrevalenceRow:
    """How often each axis applies to a model's void failures (no row: not run)."""

    model: shared.Model
    evidence: Annotated[str, "what the judge saw: trace_and_output or output; both joined by + if traces were missing"]
    judge: shared.Judge
    n_failures: Annotated[int, "void failures that the sample was drawn from"]
    n_sampled: Annotated[int, "failures put to the judge"]
    n: Annotated[int, "of these, validly labelled: every share is of n"]
    hp: Annotated[float | None, "share with a hallucinated premise", WILSON]
    ii: Annotated[float | None, "share with an invalid inference", WILSON]
    hp_and_ii: Annotated[float | None, "share with both", WILSON]
    es: Annotated[float | None, "share with epistemic surrender", WILSON]
    doubt: Annotated[float | None, "share with doubt in the reasoning", WILSON]
    epoch: Annotated[str, "campaigns of the answers and labels, joined by +"]
    benchmark_version: shared.BenchmarkVersion


CONFABULATION_PREVALENCE = Table("confabulation_prevalence", PrevalenceRow, partition_by=(), key=("model",))
