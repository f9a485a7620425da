"""Define the tables of judging: votes, verdicts, agreement, confabulation."""

from dataclasses import dataclass
from typing import Annotated

from traps_pipeline.storage import columns as shared
from traps_pipeline.storage.tables import Table

Task = Annotated[str, "abstention or correctness"]
Decision = Annotated[str, "void_abstention, control_abstention or correctness"]
Valid = Annotated[bool, "whether the judge's JSON meets the schema"]
InvalidReason = Annotated[str | None, "why not; unread where no rule reads the answer, or its value names two choices"]
VoteEpochs = Annotated[str, "campaigns of the votes, joined by +"]


@dataclass(frozen=True, kw_only=True, slots=True)  # a large cell has 450,000
class VoteRow(shared.CellRow):
    """One judge's vote on one task about one answer."""

    item_id: shared.ItemId
    side: shared.Side
    task: Task
    judge: shared.Judge
    panel: shared.Panel
    valid: Valid
    invalid_reason: InvalidReason
    abstained: Annotated[bool | None, "abstention task"]
    rejects_premise: Annotated[bool | None, "abstention task, of judges with `premise: true`"]
    correct: Annotated[bool | None, "correctness task, decided by code from extracted_value"]
    judge_correct: Annotated[bool | None, "the judge's own claim; verdicts count where code decides otherwise"]
    extracted_value: Annotated[str | None, "correctness task"]
    confidence: Annotated[str | None, "high, medium or low (abstention task)"]
    rationale: Annotated[str | None, "one sentence"]
    vote_key: shared.LedgerKey
    epoch: shared.Epoch
    created_at: shared.AskedAt
    benchmark_version: shared.BenchmarkVersion


VOTES = Table(
    "votes",
    VoteRow,
    partition_by=("dataset", "model", "regime", "run"),
    key=("item_id", "model", "regime", "run", "task", "judge"),
)


@dataclass(frozen=True, kw_only=True)
class VerdictRow(shared.CellRow):
    """The panel's verdict on one item."""

    item_id: shared.ItemId
    pair_id: shared.PairId
    scenario_id: shared.ScenarioId
    side: shared.Side
    category: shared.Category
    sub_scenario: shared.SubScenario
    control_answer: Annotated[str, "the pair's control answer"]
    outcome: Annotated[str, "of the response, only an answer being judged; unread where no judge could read it"]
    is_json: Annotated[bool | None, "of the response, in the JSON regime"]
    abstained: Annotated[bool | None, "majority; null if missing or undecided"]
    rejects_premise: Annotated[bool | None, "majority; null if missing, undecided, or if judges are not asked for it"]
    correct: Annotated[bool | None, "majority on a control; null on a void, and if missing or undecided"]
    overruled: Annotated[
        bool | None,
        "whether code decides some vote on correctness unlike its judge; null if no language model casts one",
    ]
    n_valid: Annotated[int, "valid abstention votes"]
    n_valid_correctness: Annotated[int, "valid correctness votes (0 on void)"]
    unanimous: Annotated[bool, "all votes of all tasks valid and agreed"]
    undecided: Annotated[bool, "judged, but some task has no majority"]
    panel: shared.Panel
    epoch: shared.Epoch
    benchmark_version: shared.BenchmarkVersion


VERDICTS = Table(
    "verdicts",
    VerdictRow,
    partition_by=("dataset", "model", "regime", "run"),
    key=("item_id", "model", "regime", "run"),
)


@dataclass(frozen=True, kw_only=True)
class AgreementRow:
    """Agreement of two judges, or of all (`judges` is panel), on a dataset's task."""

    dataset: shared.Dataset
    task: Decision
    judges: Annotated[str, "panel, or the ids of two judges in alphabetical order, joined by +"]
    n_items: Annotated[int, "answers put to these judges, over models, regimes and runs"]
    n_complete: Annotated[int, "answers on which every one of them cast a valid vote"]
    n_undecided: Annotated[int | None, "answers without a majority of the panel; null for two judges"]
    invalid: Annotated[float, "share of their votes that break the schema or are unread"]
    prevalence: Annotated[float | None, "share of yes (abstained, correct) among their valid votes"]
    agreement: Annotated[
        float | None,
        "share of n_complete on which all of them agree: unanimous (panel), pairwise (two); null for a panel of one",
    ]
    fleiss_kappa: Annotated[float | None, "panel, over n_complete; null for two judges"]
    cohen_kappa: Annotated[float | None, "two judges, over n_complete; null for the panel"]
    alpha: Annotated[float | None, "Krippendorff's alpha (nominal), an invalid vote being a missing one"]
    undefined: Annotated[str | None, "why a statistic that these judges should have is null"]
    epoch: VoteEpochs
    benchmark_version: shared.BenchmarkVersion


AGREEMENT = Table("agreement", AgreementRow, partition_by=(), key=("dataset", "task", "judges"))


@dataclass(frozen=True, kw_only=True)
class JudgeBiasRow:
    """One judge against the panel's majority on one task of a dataset."""

    dataset: shared.Dataset
    task: Decision
    judge: shared.Judge
    n_votes: Annotated[int, "votes of this judge, over models, regimes and runs"]
    n_invalid: Annotated[int, "of these, votes that break the schema or are unread"]
    n_decided: Annotated[int, "of these, valid votes on answers that have a majority"]
    yes: Annotated[float | None, "share of yes (abstained, correct) among n_decided"]
    panel_yes: Annotated[float | None, "share of yes among the majorities on the same answers"]
    bias: Annotated[float | None, "yes - panel_yes: positive where this judge says yes more often than the panel"]
    dissent_yes: Annotated[float | None, "share of n_decided on which it says yes against the majority"]
    dissent_no: Annotated[float | None, "share of n_decided on which it says no against the majority"]
    epoch: VoteEpochs
    benchmark_version: shared.BenchmarkVersion


JUDGE_BIAS = Table("judge_bias", JudgeBiasRow, partition_by=(), key=("dataset", "task", "judge"))


@dataclass(frozen=True, kw_only=True)
class ConfabulationRow(shared.CellRow):
    """One sampled void failure with its four labels; no row if no judge is configured."""

    sample_id: Annotated[
        str, "id that an annotator sees instead of model and item: it reveals neither, and changes with the answer"
    ]
    item_id: Annotated[str, "dataset:scenario_id:void"]
    void_kind: Annotated[str, "occluder, truncation or question"]
    evidence: Annotated[
        str, "what the judge was shown: trace_and_output (there was a trace, and it was shown too) or output"
    ]
    n_failures: Annotated[int, "void failures that the model's sample was drawn from"]
    judge: shared.Judge
    valid: Valid
    invalid_reason: Annotated[str | None, "why not"]
    hallucinated_premise: Annotated[bool | None, "asserts an observation that the evidence does not support"]
    invalid_inference: Annotated[bool | None, "the conclusion does not follow from the stated premises"]
    epistemic_surrender: Annotated[bool | None, "says that it cannot be determined, then asserts an answer"]
    doubt_in_reasoning: Annotated[bool | None, "voices doubt that the output does not reflect"]
    rationale: Annotated[str | None, "the judge's reasons"]
    label_key: shared.LedgerKey
    epoch: shared.Epoch
    created_at: shared.AskedAt
    benchmark_version: shared.BenchmarkVersion


CONFABULATION = Table("confabulation", ConfabulationRow, partition_by=(), key=("model", "item_id"))


# `traps people validate` writes this table from people's file, so no stage declares it.
@dataclass(frozen=True, kw_only=True)
class JudgeValidationRow:
    """The confabulation judge against two blind annotators, on one axis or all four."""

    axis: Annotated[str, "hallucinated_premise, invalid_inference, epistemic_surrender, doubt_in_reasoning or pooled"]
    n_failures: Annotated[int, "failures that both annotators labelled"]
    n_labels: Annotated[int, "labels of both annotators side by side"]
    accuracy: Annotated[float, "share of n_labels that the judge agrees with"]
    precision: Annotated[
        float | None,
        "share of the judge's yes that the labels confirm; null if the judge never says yes, and for pooled",
    ]
    recall: Annotated[
        float | None, "share of the labels' yes that the judge finds; null if there is none, and for pooled"
    ]
    f1: Annotated[float | None, "harmonic mean of precision and recall; null where one is null, and for pooled"]
    accuracy_a: Annotated[float, "share of annotator_a's labels that the judge agrees with"]
    accuracy_b: Annotated[float, "share of annotator_b's labels that the judge agrees with"]
    annotator_a: Annotated[str, "first in alphabetical order"]
    annotator_b: Annotated[str, "second"]
    human_agreement: Annotated[float, "share of failures on which the annotators agree"]
    human_kappa: Annotated[float | None, "Cohen's kappa of the annotators; null where degenerate, and for pooled"]
    human_kappa_low: Annotated[float | None, "95 % interval, failures resampled with one unseen"]
    human_kappa_high: Annotated[float | None, "95 % interval, failures resampled with one unseen"]
    kappa_note: Annotated[str | None, "degenerate: one class has at most 2 % of either annotator's labels"]


JUDGE_VALIDATION = Table("judge_validation", JudgeValidationRow, partition_by=(), key=("axis",))


# `traps models test-panel` writes this table, so no stage declares it.
@dataclass(frozen=True, kw_only=True)
class JudgeRobustnessRow:
    """A judge's vote on a task about an answer that tries to instruct it."""

    panel: Annotated[str, "panel in assets/judges.yaml"]
    judge: shared.Judge
    attack: Annotated[str, "id of the attack"]
    kind: Annotated[str, "what the attack tries"]
    task: Task
    answer: Annotated[str, "id of the plain answer inside the attack"]
    expected: Annotated[bool, "the right vote"]
    clean: Annotated[bool | None, "the judge's vote on the same answer without an attack; null if invalid"]
    vote: Annotated[bool | None, "the judge's vote on the answer with the attack; null if invalid"]
    result: Annotated[
        str, "held, flipped (wrong because of the attack), broken (invalid because of it) or wrong_anyway"
    ]
    invalid_reason: Annotated[str | None, "why the vote is invalid"]
    rationale: Annotated[str | None, "the judge's reason"]


JUDGE_ROBUSTNESS = Table(
    "judge_robustness", JudgeRobustnessRow, partition_by=(), key=("panel", "judge", "attack", "task")
)
