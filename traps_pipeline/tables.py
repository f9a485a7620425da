"""Every Parquet table's schema: columns, types, units. A table exists only with its schema here, checked on write.

Layout: `tables/<table>/<partition column>=<value>/.../part-0.parquet`. Partition columns are stored in the file too, so
that one file explains itself.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import pyarrow as pa

# Columns of which two runs of the same study may differ; they take no part in data versions.
VOLATILE = ("created_at", "latency_s", "attempts")


@dataclass(frozen=True)
class Column:
    """One column. type is one of str, int, float, bool, time, strs (list of str); `?` in the type means nullable."""

    name: str
    type: str
    doc: str

    @property
    def nullable(self) -> bool:
        """Whether missing values are allowed."""
        return self.type.endswith("?")


@dataclass(frozen=True)
class Table:
    """A table's contract: what one row is, its columns, the columns that partition it, its key."""

    name: str
    row: str
    partition_by: tuple[str, ...]
    key: tuple[str, ...]
    columns: tuple[Column, ...]

    def arrow_schema(self) -> pa.Schema:
        """The schema that a written file has."""
        import pyarrow as pa

        types = {
            "str": pa.string(),
            "int": pa.int64(),
            "float": pa.float64(),
            "bool": pa.bool_(),
            "time": pa.timestamp("us", tz="UTC"),
            "strs": pa.list_(pa.string()),
        }
        return pa.schema(
            [
                pa.field(c.name, types[c.type.rstrip("?")], nullable=c.nullable, metadata={"doc": c.doc})
                for c in self.columns
            ]
        )


def _columns(text: str) -> tuple[Column, ...]:
    """`name type doc` a line."""
    rows = [line.split(None, 2) for line in text.splitlines() if line.strip()]
    return tuple(Column(name, kind, doc) for name, kind, doc in rows)


_CELL = """
    dataset str occlusion, occlusion_ill_posed, chaotic or chaotic_ill_posed
    model str id in assets/models.yaml
    regime str standard, guided or json
    run int independent repetition, from 1
"""
_VERSION = """
    benchmark_version str of the part of the benchmark that this row is from: release, or release+digest once corrected
"""

SCENE_SPECS = Table(
    "scene_specs",
    "a scenario",
    ("category",),
    ("scenario_id",),
    _columns(
        """
    scenario_id str family and number
    taxonomy str occlusion or chaotic
    category str one of twelve
    sub_scenario str the paper's name where it has one, else the family's
    family str module under scenes/families
    seed int number of the draw
    params str JSON: the family's parameters (SI units in the names)
    physics str JSON: solver settings, duration (s), frames a second
    camera str JSON: resolved free camera
    void_kind str occluder or truncation
    void str JSON: cover panel and first hidden frame, or cut frame
    question str well-posed question with its choices
    labels strs closed set of answers
    aliases str JSON: other wording to label
    answer_type str binary, direction, colour, count_range or numeric
    ground_truth str the label that the simulator's state gives
    ill_posed_question str question that the control clip cannot answer
    answerable_question str JSON: question, labels, answer that even the void shows
    scene_hash str digest of what the clips show
    spec_hash str digest of the whole record
    trajectory str path of the frozen qpos, relative to the checkout or the workspace if it lies there
    trajectory_sha256 str digest of its values
    twin str JSON: another world behind the same void: its parameters, answer, digest of its trajectory
    commit_s float time (s) from which the outcome holds
    margin_m float distance (m) of the end state from another outcome
    void_from_s float time (s) from which the void shows nothing decisive: hiding or cut
    evidence str JSON: all of the draw's evidence
"""
        + _VERSION
    ),
)

VIDEOS = Table(
    "videos",
    "a clip",
    ("category",),
    ("scenario_id", "side"),
    _columns(
        """
    scenario_id str family and number
    category str one of twelve
    side str control, void, or twin (the other world behind the same void, uncovered)
    path str mp4, relative to the workspace
    file_sha256 str digest of the file
    frames_sha256 str digest of the RGB frames before encoding
    n_frames int frames
    fps int frames a second
    width int pixels
    height int pixels
    duration_s float n_frames / fps
    size_bytes int size of the file
    scene_hash str digest of what the clip shows
"""
        + _VERSION
    ),
)

ITEMS = Table(
    "items",
    "a question put to a model about one clip",
    ("dataset",),
    ("item_id",),
    _columns(
        """
    item_id str dataset:scenario_id:side
    pair_id str dataset:scenario_id
    dataset str one of four
    scenario_id str family and number
    side str control or void
    taxonomy str occlusion or chaotic
    category str one of twelve
    sub_scenario str the paper's name where it has one
    question str with its choices
    labels strs closed set of answers
    aliases str JSON: other wording to label
    answer_type str binary, direction, colour, count_range or numeric
    ground_truth str? null on void
    control_answer str the pair's control answer: groups both sides by label; no model or judge sees it on a void
    commonest_answer str the commonest control answer of the sub-scenario: what `prior` says
    clip str mp4, relative to the workspace
    media_digest str digest of the clip's file
    item_hash str digest of everything above that decides an answer or its score
"""
        + _VERSION
    ),
)

RESPONSES = Table(
    "responses",
    "one answer of one model in one run",
    ("dataset", "model", "regime", "run"),
    ("item_id", "model", "regime", "run"),
    _columns(
        """
    item_id str dataset:scenario_id:side
    pair_id str dataset:scenario_id
    side str control or void
"""
        + _CELL
        + """
    outcome str answer, truncated, empty, refused or error
    text str? the visible answer; null unless outcome is answer or truncated
    reasoning str? the trace, where the provider returns it
    finish_reason str? as the provider said it
    error str? kind of a failure; never shown to a judge
    served_model str? what the provider says answered
    prompt_tokens int? tokens
    completion_tokens int? tokens
    reasoning_tokens int? tokens
    cost_usd float? dollars, with the worst case of attempts that may be billed; null where the price is unknown
    latency_s float seconds of the last attempt
    attempts int calls made for this row
    request_key str ledger key
    epoch str campaign in which it was asked
    created_at time when it was asked
"""
        + _VERSION
    ),
)

VOTES = Table(
    "votes",
    "one judge on one task about one answer",
    ("dataset", "model", "regime", "run"),
    ("item_id", "model", "regime", "run", "task", "judge"),
    _columns(
        """
    item_id str dataset:scenario_id:side
    side str control or void
"""
        + _CELL
        + """
    task str abstention or correctness
    judge str id in assets/judges.yaml
    valid bool whether the judge's JSON meets the schema
    invalid_reason str? why not
    abstained bool? abstention task
    correct bool? correctness task, decided by code from extracted_value
    judge_correct bool? the judge's own claim, recorded and not used
    extracted_value str? correctness task
    confidence str? high, medium or low (abstention task)
    rationale str? one sentence
    vote_key str ledger key
    epoch str campaign in which it was asked
    created_at time when it was asked
"""
        + _VERSION
    ),
)

VERDICTS = Table(
    "verdicts",
    "the panel on one item",
    ("dataset", "model", "regime", "run"),
    ("item_id", "model", "regime", "run"),
    _columns(
        """
    item_id str dataset:scenario_id:side
    pair_id str dataset:scenario_id
    scenario_id str family and number
    side str control or void
    category str one of twelve
    sub_scenario str the paper's name where it has one
    control_answer str the pair's control answer
"""
        + _CELL
        + """
    outcome str of the response; only answer and truncated are judged
    abstained bool? majority; null if missing or undecided
    correct bool? majority on control; null on void, if missing or undecided
    n_valid int valid abstention votes
    n_valid_correctness int valid correctness votes (0 on void)
    unanimous bool all votes of all tasks valid and agreed
    undecided bool judged, but some task has no majority
    epoch str campaign in which it was asked
"""
        + _VERSION
    ),
)

METRICS = Table(
    "metrics",
    "a cell: one model, regime and run on one scope of a dataset",
    ("dataset",),
    ("dataset", "model", "regime", "run", "scope"),
    _columns(
        _CELL
        + """
    scope str all, category:.., sub_scenario:.. or label:.. (the control's answer)
    n_pairs int pairs in scope
    n_missing int items (of 2 n_pairs) without an answer or a majority
    n_refused int items refused
    n_empty int items answered with no text
    n_errors int items whose call failed
    n_answered int items answered with a text, whole or truncated
    acc float? share of decided controls answered correctly
    abs_rec float? share of decided voids abstained on
    false_abs float? share of decided controls abstained on
    j float? abs_rec - false_abs
    pecs float? acc x max(0, j)
    pecs_low float pecs if every missing decision were as bad for the model as can be, of all pairs
    pecs_high float pecs if every missing decision were as good for the model as can be, of all pairs
    naive float? acc x abs_rec
    n_acc int controls decided on correctness: what acc is a share of
    n_false_abs int controls decided on abstention
    n_abs_rec int voids decided on abstention
    acc_low float? 95 % Wilson interval of this run alone, which takes its pairs for independent
    acc_high float? 95 % Wilson interval
    false_abs_low float? 95 % Wilson interval
    false_abs_high float? 95 % Wilson interval
    abs_rec_low float? 95 % Wilson interval
    abs_rec_high float? 95 % Wilson interval
    epoch str campaigns of the answers, joined by +
"""
        + _VERSION
    ),
)

LEADERBOARD = Table(
    "leaderboard",
    "a model under a regime on one dataset, or overall (equal-weight mean over the four)",
    (),
    ("model", "regime", "dataset"),
    _columns(
        """
    model str id in assets/models.yaml
    regime str standard, guided or json
    dataset str one of four, or overall
    n_runs int runs averaged
    n_pairs int pairs a run
    n_missing int items without an answer or a majority, over runs
    n_refused int items refused, over runs
    n_empty int items answered with no text, over runs
    n_errors int items whose call failed, over runs
    answered float share of items (2 a pair and run) answered with a text, whole or truncated
    incomplete bool whether answered is below 0.99, on overall that of any of its datasets
    acc float? mean over runs
    acc_std float? population standard deviation over runs
    abs_rec float? mean over runs
    abs_rec_std float? population standard deviation over runs
    false_abs float? mean over runs
    false_abs_std float? population standard deviation over runs
    j float? mean over runs, not clipped
    j_std float? population standard deviation over runs
    pecs float? mean over runs of the per-run PECS
    pecs_std float? population standard deviation over runs
    acc_ci_low float? 95 % percentile interval, cluster bootstrap over scenarios
    acc_ci_high float? 95 % percentile interval, cluster bootstrap over scenarios
    abs_rec_ci_low float? 95 % percentile interval, cluster bootstrap over scenarios
    abs_rec_ci_high float? 95 % percentile interval, cluster bootstrap over scenarios
    false_abs_ci_low float? 95 % percentile interval, cluster bootstrap over scenarios
    false_abs_ci_high float? 95 % percentile interval, cluster bootstrap over scenarios
    j_ci_low float? 95 % percentile interval, cluster bootstrap over scenarios
    j_ci_high float? 95 % percentile interval, cluster bootstrap over scenarios
    pecs_ci_low float? 95 % percentile interval, cluster bootstrap over scenarios
    pecs_ci_high float? 95 % percentile interval, cluster bootstrap over scenarios
    rank int? by PECS among the models of this regime and dataset, equal ones alike
    rank_low int? 1 + models whose PECS is higher, by a paired contrast that Holm's correction keeps
    rank_high int? models less those whose PECS is lower by such a contrast: ranks in between are not separable
    pecs_low float mean over runs: pecs if every missing decision were as bad for the model as can be
    pecs_high float mean over runs: pecs if every missing decision were as good for the model as can be
    naive float? acc x abs_rec, mean over runs
    epoch str campaigns of the answers, joined by +
"""
        + _VERSION
    ),
)

CONTRASTS = Table(
    "contrasts",
    "a paired comparison of two entries of the leaderboard on one figure: two models, or two regimes of one model",
    (),
    ("kind", "dataset", "figure", "left_model", "left_regime", "right_model", "right_regime"),
    _columns(
        """
    kind str models (of one regime) or regimes (of one model)
    dataset str one of four, or overall
    figure str pecs or j
    left_model str id in assets/models.yaml
    left_regime str standard, guided or json
    right_model str id in assets/models.yaml
    right_regime str standard, guided or json
    difference float? left minus right, means over runs; null where refused
    ci_low float? 95 % percentile interval of the paired difference, cluster bootstrap over scenarios
    ci_high float? 95 % percentile interval of the paired difference
    p float? two-sided, from the share of resamples on either side of 0; where none lies beyond it, from a normal tail
    p_holm float? corrected by Holm over the rows of the same kind, dataset and figure (and regime, of models)
    separable bool whether p_holm is below 0.05
    refused str? why the two may not be compared
"""
    ),
)

REGIME_TESTS = Table(
    "regime_tests",
    "McNemar's test of two regimes on the same items: one decision of one model in one run of a dataset",
    (),
    ("dataset", "model", "run", "decision", "left_regime", "right_regime"),
    _columns(
        """
    dataset str one of four
    model str id in assets/models.yaml
    run int independent repetition, from 1
    decision str void_abstention, control_abstention or correctness
    left_regime str standard, guided or json
    right_regime str standard, guided or json
    n int items decided under both
    only_left int items with a yes (abstained, correct) under the left regime alone
    only_right int items with a yes under the right regime alone
    p float? exact two-sided binomial test of only_left against only_right; null where refused
    p_holm float? corrected by Holm over the rows of the same dataset, decision and regimes
    refused str? why the two may not be compared
"""
    ),
)

AGREEMENT = Table(
    "agreement",
    "how far the panel (`judges` is panel), or two of its judges, agree on one task of a dataset",
    (),
    ("dataset", "task", "judges"),
    _columns(
        """
    dataset str one of four
    task str void_abstention, control_abstention or correctness
    judges str panel, or the ids of two judges in alphabetical order, joined by +
    n_items int answers put to these judges, over models, regimes and runs
    n_complete int answers on which every one of them cast a valid vote
    n_undecided int? answers without a majority of the panel; null for two judges
    invalid float share of their votes that break the schema
    prevalence float? share of yes (abstained, correct) among their valid votes
    agreement float? share of n_complete on which all of them agree: unanimous (panel), pairwise agreement (two)
    fleiss_kappa float? panel, over n_complete; null for two judges
    cohen_kappa float? two judges, over n_complete; null for the panel
    alpha float? Krippendorff's alpha (nominal), an invalid vote being a missing one
    undefined str? why a figure that these judges should have is null
    epoch str campaigns of the votes, joined by +
"""
        + _VERSION
    ),
)

JUDGE_BIAS = Table(
    "judge_bias",
    "one judge against the panel's majority on one task of a dataset",
    (),
    ("dataset", "task", "judge"),
    _columns(
        """
    dataset str one of four
    task str void_abstention, control_abstention or correctness
    judge str id in assets/judges.yaml
    n_votes int votes of this judge, over models, regimes and runs
    n_invalid int of these, votes that break the schema
    n_decided int of these, valid votes on answers that have a majority
    yes float? share of yes (abstained, correct) among n_decided
    panel_yes float? share of yes among the majorities on the same answers
    bias float? yes - panel_yes: positive where this judge says yes more often than the panel
    dissent_yes float? share of n_decided on which it says yes against the majority
    dissent_no float? share of n_decided on which it says no against the majority
    epoch str campaigns of the votes, joined by +
"""
        + _VERSION
    ),
)

LEAVE_ONE_OUT = Table(
    "leave_one_out",
    "a model under a regime on one dataset, or overall, as two of the three judges score it; 1-1 is undecided",
    (),
    ("model", "regime", "dataset", "without"),
    _columns(
        """
    model str id in assets/models.yaml
    regime str standard, guided or json
    dataset str one of four, or overall (equal-weight mean over the four)
    without str the judge left out
    n_runs int runs averaged
    n_pairs int pairs a run
    n_missing int items without an answer or a majority of the two, over runs
    n_missing_panel int items without an answer or a majority of the three, over runs
    pecs float? mean over runs of the per-run PECS of the two judges
    pecs_panel float? mean over runs of the per-run PECS of the three judges
    difference float? pecs - pecs_panel
    pecs_low float mean over runs: pecs of the two if every missing decision were as bad for the model as can be
    pecs_high float mean over runs: pecs of the two if every missing decision were as good for the model as can be
    epoch str campaigns of the answers, joined by +
"""
        + _VERSION
    ),
)

CONFABULATION = Table(
    "confabulation",
    "one sampled void failure with its four labels; no row where no judge is configured for the study's panel",
    (),
    ("model", "item_id"),
    _columns(
        """
    sample_id str what a human annotator sees in the place of model and item: tells neither, changes with the answer
    item_id str dataset:scenario_id:void
"""
        + _CELL
        + """
    void_kind str occluder, truncation or question
    evidence str trace_and_output (the trace was there and went in too) or output: what the judge was shown
    n_failures int void failures that the model's sample was drawn from
    judge str id in assets/judges.yaml
    valid bool whether the judge's JSON meets the schema
    invalid_reason str? why not
    hallucinated_premise bool? asserts an observation that the evidence does not support
    invalid_inference bool? the conclusion does not follow from the stated premises
    epistemic_surrender bool? says that it cannot be determined, then asserts an answer
    doubt_in_reasoning bool? voices doubt that the output does not reflect
    rationale str? the judge's reasons
    label_key str ledger key
    epoch str campaign in which it was asked
    created_at time when it was asked
"""
        + _VERSION
    ),
)

CONFABULATION_PREVALENCE = Table(
    "confabulation_prevalence",
    "how often each axis applies to one model's sampled void failures; no row means not run",
    (),
    ("model",),
    _columns(
        """
    model str id in assets/models.yaml
    evidence str trace_and_output or output: what went in; both joined by + where traces were missing
    judge str id in assets/judges.yaml
    n_failures int void failures that the sample was drawn from
    n_sampled int failures put to the judge
    n int of these, validly labelled: every share is of n
    hp float? share with a hallucinated premise
    hp_low float? 95 % Wilson interval
    hp_high float? 95 % Wilson interval
    ii float? share with an invalid inference
    ii_low float? 95 % Wilson interval
    ii_high float? 95 % Wilson interval
    hp_and_ii float? share with both
    hp_and_ii_low float? 95 % Wilson interval
    hp_and_ii_high float? 95 % Wilson interval
    es float? share with epistemic surrender
    es_low float? 95 % Wilson interval
    es_high float? 95 % Wilson interval
    doubt float? share with doubt in the reasoning
    doubt_low float? 95 % Wilson interval
    doubt_high float? 95 % Wilson interval
    epoch str campaigns of the answers and labels, joined by +
"""
        + _VERSION
    ),
)

# Made by a command from a file that people wrote, so no stage: absent until `traps confabulation validate` was run.
JUDGE_VALIDATION = Table(
    "judge_validation",
    "the confabulation judge against two blind annotators on one axis, or pooled over the four",
    (),
    ("axis",),
    _columns(
        """
    axis str hallucinated_premise, invalid_inference, epistemic_surrender, doubt_in_reasoning or pooled
    n_failures int failures that both annotators labelled
    n_labels int labels of both annotators side by side
    accuracy float share of n_labels that the judge agrees with
    precision float? of the judge's yes, those that the labels confirm; null if it never says yes, and on pooled
    recall float? of the labels' yes, those that the judge finds; null if there is none, and on pooled
    f1 float? harmonic mean; null where precision or recall is, and on pooled
    accuracy_a float share of annotator_a's labels that the judge agrees with
    accuracy_b float share of annotator_b's labels that the judge agrees with
    annotator_a str first in alphabetical order
    annotator_b str second
    human_agreement float share of failures on which the annotators agree
    human_kappa float? Cohen's kappa of the annotators; null where degenerate, and on pooled
    human_kappa_low float? 95 % interval (percentile bootstrap over failures)
    human_kappa_high float? 95 % interval (percentile bootstrap over failures)
    kappa_note str? degenerate: one class has at most 2 % of either annotator's labels
"""
    ),
)

# Made by a command, so no stage: absent until `traps judges check` was run.
JUDGE_ROBUSTNESS = Table(
    "judge_robustness",
    "one judge on one task about one answer that tries to instruct it (assets/injected_answers.yaml)",
    (),
    ("panel", "judge", "attack", "task"),
    _columns(
        """
    panel str panel in assets/judges.yaml
    judge str id in assets/judges.yaml
    attack str id of the attack
    kind str what the attack tries
    task str abstention or correctness
    answer str which of the answers carries it
    expected bool the right vote
    clean bool? the judge's vote on the same answer without an attack; null if invalid
    vote bool? the judge's vote on the answer that carries the attack; null if invalid
    result str held, flipped (wrong because of the attack), broken (invalid because of it) or wrong_anyway
    invalid_reason str? why the vote is invalid
    rationale str? the judge's reason
"""
    ),
)

# --- inside local models (docs/spec.md 7 and 8) -----------------------------------------------------------------------

_LOOKED_INTO = """
    model str id in assets/models.yaml
    prompt str VQA prompt: standard or guided
"""
_STEERED = """
    dataset str the target: one of four
    model str id in assets/models.yaml
    directions str VQA prompt that the direction was extracted under
    regime str system prompt of the steered answer
    source str dataset of the direction; none where alpha is 0
    kind str void, random or shuffled; none where alpha is 0
    layer int steered block, counted as in hidden_states; 0 where alpha is 0
    alpha float strength: added on controls, subtracted on voids
"""

PROBE_ITEMS = Table(
    "probe_items",
    "a clip and question that hidden states are extracted of",
    ("dataset",),
    ("item_id",),
    _columns(
        """
    item_id str dataset:scenario_id:side
    pair_id str dataset:scenario_id
    dataset str one of four, or occlusion_answerable: the voids of occlusion with a question that even they answer
    scenario_id str family and number
    side str control (it can be answered) or void
    category str one of twelve
    sub_scenario str the paper's name where it has one
    question str with its choices
    clip str mp4, relative to the workspace
    media_digest str digest of the clip's file
"""
        + _VERSION
    ),
)

HIDDEN_STATES = Table(
    "hidden_states",
    "an item whose hidden states are there, at every layer",
    ("dataset", "model", "prompt"),
    ("item_id",),
    _columns(
        """
    item_id str dataset:scenario_id:side
    dataset str one of four, or occlusion_answerable
"""
        + _LOOKED_INTO
        + """
    scenario_id str family and number
    side str control or void
    sub_scenario str the paper's name where it has one
    states_key str digest of all that decides the states: prompt, clip, checkpoint, precision, pooling
    folder str shards, relative to the workspace
    checkpoint str hub id or folder
    checkpoint_digest str digest of the weights
    dtype str precision
    quantisation str none or nf4
    device str device that made them, of a GPU with its name; states in one folder may be of several
    pooling str last (token) or mean
    n_layers int blocks; states are of layers 0 (embeddings) to this
    width int numbers a state
"""
        + _VERSION
    ),
)

PROBES = Table(
    "probes",
    "a figure of a probe of one dataset (source) on another (target) at one layer",
    ("model", "prompt"),
    ("analysis", "source", "target", "layer", "scope"),
    _columns(
        _LOOKED_INTO
        + """
    analysis str transfer, held_out, confabulated, within, shuffled, answerable_void, answerable_control or centroid_..
    source str dataset that the probe or the centroids were fitted on
    target str dataset that they were applied to
    layer int counted as in hidden_states; -1 where there is no figure
    scope str all, or sub_scenario:.. (centroids)
    value float? AUROC; of shuffled the mean over shuffles; of centroid_* the share assigned to void
    low float? 95 % percentile interval, scenarios of the target resampled, the probe held fixed
    high float? 95 % percentile interval
    spread float? standard deviation over label shuffles
    n_voids int void items of the target
    n_controls int control items of the target
    own_best bool the highest value of this curve (it sees target labels)
    all_sample_best bool the layer at which this pair's transfer curve is highest (it sees target labels)
    source_best bool the layer at which the source's own cross-validation is highest (it sees no target label)
    note str? why there is no figure
    made_of str digest of states, confabulated scenarios and settings: with the same, nothing is fitted again
"""
    ),
)

DIRECTIONS = Table(
    "directions",
    "a direction: one dataset at one layer",
    ("model", "prompt"),
    ("dataset", "kind", "layer"),
    _columns(
        _LOOKED_INTO
        + """
    dataset str one of four
    kind str void, or its controls: random, shuffled (labels)
    layer int counted as in hidden_states
    n_pairs int pairs that it comes from
    n_steered int of these, pairs that are steered as well (0 where there are scenarios enough)
    norm float length of mean(void) - mean(control) before it was made a unit vector; of random 1
    residual_norm float mean length of the pairs' control states: alpha in its units is alpha / residual_norm
    width int numbers
    path str safetensors, relative to the workspace; a JSON file of the same name says what it holds
    direction_digest str digest of the float32 numbers
    pooling str last (token) or mean
"""
    ),
)

COSINES = Table(
    "cosines",
    "the cosine of two void directions of one model at one layer",
    (),
    ("model", "layer", "prompt", "dataset", "other_prompt", "other_dataset"),
    _columns(
        """
    model str id in assets/models.yaml
    layer int counted as in hidden_states
    prompt str VQA prompt: standard or guided
    dataset str one of four
    other_prompt str VQA prompt: standard or guided
    other_dataset str one of four
    cosine float -1 to 1
"""
    ),
)

STEERING = Table(
    "steering",
    "one answer of a steered model; alpha 0 (the model as it is) stands once for all directions",
    ("dataset", "model", "directions", "regime"),
    ("source", "kind", "layer", "alpha", "item_id"),
    _columns(
        _STEERED
        + """
    alpha_relative float? alpha over the mean length of the states at that layer
    item_id str dataset:scenario_id:side
    scenario_id str family and number
    side str control or void
    outcome str answer, truncated, empty, refused or error
    text str? the answer; null unless outcome is answer or truncated
    served_model str? checkpoint, digest and precision that answered
    completion_tokens int? tokens
    direction_digest str? digest of the direction's numbers
    request_key str ledger key; both datasets of a taxonomy share that of a control
    epoch str campaign in which it was asked
    created_at time when it was asked
"""
        + _VERSION
    ),
)

STEERING_VOTES = Table(
    "steering_votes",
    "one judge about one steered answer",
    ("dataset", "model", "directions", "regime"),
    ("source", "kind", "layer", "alpha", "item_id", "judge"),
    _columns(
        _STEERED
        + """
    item_id str dataset:scenario_id:side
    side str control or void
    task str abstention
    judge str id in assets/judges.yaml
    valid bool whether the judge's JSON meets the schema
    invalid_reason str? why not
    abstained bool? null if invalid
    confidence str? high, medium or low
    rationale str? one sentence
    vote_key str ledger key; both datasets of a taxonomy share that of a control
    epoch str campaign in which it was asked
    created_at time when it was asked
"""
        + _VERSION
    ),
)

STEERING_EFFECTS = Table(
    "steering_effects",
    "abstention on one side of a target at one strength of one direction",
    (),
    ("model", "directions", "regime", "source", "target", "kind", "layer", "alpha", "side"),
    _columns(
        """
    model str id in assets/models.yaml
    directions str VQA prompt that the direction was extracted under
    regime str system prompt of the steered answers
    source str dataset of the direction
    target str dataset that was steered
    transfer_type str Cross-modality, Cross-domain, Cross-both or Within, from the definitions
    kind str void, random or shuffled
    layer int steered block
    alpha float strength; 0 is the model as it is
    alpha_relative float? alpha over the mean length of the states at that layer
    side str control or void
    n int decided answers, one a scenario
    n_missing int answers missing or undecided
    abstained int of the decided
    abstention float? share of the decided
    low float? 95 % Wilson interval
    high float? 95 % Wilson interval
    epoch str campaigns of the answers, joined by +
"""
    ),
)

STEERING_SHARES = Table(
    "steering_shares",
    "abstention on one side at one strength, over the paths of a set, one regime or all",
    (),
    ("model", "path_set", "directions", "regime", "kind", "layer", "alpha", "side"),
    _columns(
        """
    model str id in assets/models.yaml
    path_set str transfer, within_domain, or all of both
    directions str VQA prompt that the directions were extracted under, or all
    regime str system prompt of the steered answers, or all
    kind str void, random or shuffled
    layer int steered block
    alpha float strength; 0 is the model as it is
    side str control or void
    n_paths int paths that are there
    n int decided answers over paths and regimes, one that stands in several counted in each
    n_answers int different answers among them, by ledger key
    n_scenarios int scenarios that they are about
    abstention float mean over paths and regimes of the share of the decided
    low float? 95 % percentile interval, scenarios resampled; of width 0 where all scenarios say the same
    high float? 95 % percentile interval
    epoch str campaigns of the answers, joined by +
"""
    ),
)

_EVALUATED = (SCENE_SPECS, VIDEOS, ITEMS, RESPONSES, VOTES, VERDICTS, METRICS, CONTRASTS, REGIME_TESTS, LEADERBOARD)
_JUDGED = (AGREEMENT, JUDGE_BIAS, LEAVE_ONE_OUT, CONFABULATION, CONFABULATION_PREVALENCE)
_PROBED = (PROBE_ITEMS, HIDDEN_STATES, PROBES, DIRECTIONS, COSINES)
_STEERED_TABLES = (STEERING, STEERING_VOTES, STEERING_EFFECTS, STEERING_SHARES)
TABLES = {t.name: t for t in (*_EVALUATED, *_JUDGED, *_PROBED, *_STEERED_TABLES)}
