"""Define the tables of the mechanistic stages (docs/spec.md 7 and 8)."""

from dataclasses import dataclass
from typing import Annotated

from traps_pipeline.protocol.regimes import VQA_PROMPTS, one_of
from traps_pipeline.storage import columns as shared
from traps_pipeline.storage.tables import Table

Prompt = Annotated[str, f"prompt of extraction, {one_of(VQA_PROMPTS)}: a VQA one, or the benchmark's if so set"]
Layer = Annotated[int, "counted as in hidden_states"]
Pooling = Annotated[str, "last (token of the prompt), answer (its first token), or mean over all tokens or a part"]
Target = Annotated[str, "the target: one of four"]
DirectionPrompt = Annotated[str, "VQA prompt that the direction was extracted under"]
AnswerRegime = Annotated[str, "system prompt of the steered answer"]
SteeredSource = Annotated[str, "dataset of the direction; none where alpha is 0"]
SteeredKind = Annotated[str, "void, or a null: isotropic, covariance or shuffled; none where alpha is 0"]
Draw = Annotated[int, "number of a null's draw; 0 for void"]
DoseUnit = Annotated[str, "of the dose: alpha, or gap (the distance between the sides' means at the layer)"]
Dose = Annotated[float, "strength in that unit; 0 is the unsteered model"]
Signs = Annotated[str, "label: added on controls and subtracted on voids; plus or minus: the same on both sides"]
SteeredLayer = Annotated[int, "steered block, counted as in hidden_states; 0 where alpha is 0"]
Strength = Annotated[float, "length of what is added or subtracted"]
Kind = Annotated[str, "void, or a null: isotropic, covariance or shuffled"]
Block = Annotated[int, "steered block"]
Alpha = Annotated[float, "strength; 0 is the unsteered model"]
AlphaRelative = Annotated[float | None, "alpha over the mean length of the states at that layer"]
Percentile = Annotated[float | None, "95 % percentile interval"]


@dataclass(frozen=True, kw_only=True)
class ExtractionColumns:
    """Columns of rows that are computed from a model's states under one prompt."""

    model: shared.Model
    prompt: Prompt


@dataclass(frozen=True, kw_only=True)
class SteeringColumns:
    """Columns of metrics of steered answers."""

    model: shared.Model
    directions: DirectionPrompt
    regime: AnswerRegime


@dataclass(frozen=True, kw_only=True)
class SteeredCell:
    """Columns of one answer at one dose of one direction."""

    dataset: Target
    model: shared.Model
    directions: DirectionPrompt
    regime: AnswerRegime
    source: SteeredSource
    kind: SteeredKind
    draw: Draw
    layer: SteeredLayer
    unit: DoseUnit
    dose: Dose
    signs: Signs
    alpha: Strength


@dataclass(frozen=True, kw_only=True)
class ProbeItemRow:
    """A clip and question for which hidden states are extracted."""

    item_id: shared.ItemId
    pair_id: shared.PairId
    dataset: Annotated[
        str,
        "one of four; occlusion_answerable: the void clips of occlusion with a question that they answer; or an arm",
    ]
    scenario_id: shared.ScenarioId
    side: Annotated[str, "control (it can be answered) or void"]
    category: shared.Category
    sub_scenario: shared.SubScenario
    question: shared.Question
    clip: shared.ClipPath
    media_digest: shared.MediaDigest
    benchmark_version: shared.BenchmarkVersion


PROBE_ITEMS = Table("probe_items", ProbeItemRow, partition_by=("dataset",), key=("item_id",))


@dataclass(frozen=True, kw_only=True)
class HiddenStatesRow:
    """An item whose hidden states were extracted at every layer."""

    item_id: shared.ItemId
    dataset: Annotated[str, "as in probe_items"]
    model: shared.Model
    prompt: Prompt
    scenario_id: shared.ScenarioId
    side: shared.Side
    sub_scenario: shared.SubScenario
    states_key: Annotated[str, "digest of the states' inputs: prompt, clip, checkpoint, precision, pooling"]
    folder: Annotated[str, "folder of the shards, relative to the workspace"]
    checkpoint: Annotated[str, "hub id or folder"]
    checkpoint_digest: Annotated[str, "digest of the weights"]
    dtype: Annotated[str, "precision"]
    quantisation: Annotated[str, "none or nf4"]
    device: Annotated[str, "device that made the states, for a GPU with its name; a folder may mix several"]
    pooling: Pooling
    n_layers: Annotated[int, "number of blocks; there are states of layers 0 (embeddings) to this"]
    width: Annotated[int, "numbers per state"]
    benchmark_version: shared.BenchmarkVersion


HIDDEN_STATES = Table("hidden_states", HiddenStatesRow, partition_by=("dataset", "model", "prompt"), key=("item_id",))


@dataclass(frozen=True, kw_only=True)
class ProbeRow(ExtractionColumns):
    """A metric of a probe of one dataset (source) on another (target) at one layer."""

    analysis: Annotated[
        str,
        "transfer, held_out, confabulated, confabulated_held_out, within, shuffled, answerable_void, "
        "answerable_control or centroid_..",
    ]
    source: Annotated[str, "dataset that the probe or the centroids were fitted on"]
    target: Annotated[str, "dataset that they were applied to"]
    layer: Annotated[int, "counted as in hidden_states; -1 where there is no metric"]
    scope: Annotated[str, "all, or sub_scenario:.. (centroids)"]
    value: Annotated[
        float | None, "AUROC; for shuffled its mean over shuffles; for centroid_* the share assigned to void"
    ]
    low: Annotated[
        float | None,
        "95 % percentile interval: target scenarios resampled, the probe held fixed; never nearer to 0 or 1 than so "
        "many scenarios allow",
    ]
    high: Percentile
    spread: Annotated[float | None, "standard deviation over label shuffles"]
    n_voids: Annotated[int, "void items of the target"]
    n_controls: Annotated[int, "control items of the target"]
    own_best: Annotated[bool, "whether this layer has the highest value of its own curve (uses target labels)"]
    all_sample_best: Annotated[bool, "whether this pair's transfer curve is highest at this layer (uses target labels)"]
    chosen: Annotated[bool, "whether the target is read at this layer, chosen on pairs of other datasets alone"]
    note: Annotated[str | None, "why there is no metric"]


PROBES = Table(
    "probes", ProbeRow, partition_by=("model", "prompt"), key=("analysis", "source", "target", "layer", "scope")
)


@dataclass(frozen=True, kw_only=True)
class DirectionRow(ExtractionColumns):
    """A direction: one dataset at one layer."""

    dataset: shared.Dataset
    kind: Kind
    draw: Draw
    layer: Layer
    n_pairs: Annotated[int, "pairs from which it was computed"]
    norm: Annotated[float, "the class gap: length of mean(void) - mean(control)"]
    cosine: Annotated[float, "with the void direction of the same layer; 0 for a null, up to rounding"]
    residual_norm: Annotated[
        float, "mean length of the pairs' control states: alpha in its units is alpha / residual_norm"
    ]
    width: Annotated[int, "numbers"]
    path: Annotated[str, "safetensors, relative to the workspace; a JSON file of the same name says what it holds"]
    direction_digest: Annotated[str, "digest of the float32 numbers"]
    pooling: Pooling


DIRECTIONS = Table(
    "directions", DirectionRow, partition_by=("model", "prompt"), key=("dataset", "kind", "draw", "layer")
)


@dataclass(frozen=True, kw_only=True)
class CosineRow:
    """The cosine of two void directions of one model at one layer."""

    model: shared.Model
    layer: Layer
    prompt: Prompt
    dataset: shared.Dataset
    other_prompt: Prompt
    other_dataset: shared.Dataset
    cosine: Annotated[float, "-1 to 1"]
    disattenuated: Annotated[
        float | None,
        "the same of products of different scenarios, so without their noise; null if nothing else is left",
    ]
    low: Annotated[float | None, "95 % interval of the disattenuated cosine, scenarios resampled"]
    high: Annotated[float | None, "95 % interval of the disattenuated cosine, scenarios resampled"]
    split_half: Annotated[float | None, "cosine between directions of random halves of the first one's pairs, mean"]


COSINES = Table(
    "cosines", CosineRow, partition_by=(), key=("model", "layer", "prompt", "dataset", "other_prompt", "other_dataset")
)


@dataclass(frozen=True, kw_only=True)
class SteeringRow(SteeredCell):
    """An answer of a steered model; at alpha 0 one row serves all directions."""

    alpha_relative: AlphaRelative
    item_id: shared.ItemId
    scenario_id: shared.ScenarioId
    side: shared.Side
    outcome: shared.Outcome
    text: Annotated[str | None, "the answer; null unless outcome is answer or truncated"]
    served_model: Annotated[str | None, "checkpoint, digest and precision that answered"]
    completion_tokens: shared.Tokens
    degenerate: Annotated[
        str | None, "why the text is no answer: truncated, empty, letters (none), repetition, script; null if it is one"
    ]
    direction_digest: Annotated[str | None, "digest of the direction's numbers"]
    request_key: Annotated[str, "ledger key; the two datasets of a taxonomy share the key of a control"]
    epoch: shared.Epoch
    created_at: shared.AskedAt
    benchmark_version: shared.BenchmarkVersion


STEERING = Table(
    "steering",
    SteeringRow,
    partition_by=("dataset", "model", "directions", "regime"),
    key=("source", "kind", "draw", "layer", "unit", "dose", "signs", "item_id"),
)


@dataclass(frozen=True, kw_only=True)
class SteeringFluencyRow:
    """How likely the unsteered model finds a steered answer to its own prompt."""

    dataset: Target
    model: shared.Model
    directions: DirectionPrompt
    regime: AnswerRegime
    item_id: shared.ItemId
    request_key: Annotated[str, "of the answer, as in steering"]
    nats: Annotated[float, "mean negative log-probability of the text's tokens"]
    tokens: Annotated[int, "tokens of the text"]


STEERING_FLUENCY = Table(
    "steering_fluency",
    SteeringFluencyRow,
    partition_by=("dataset", "model", "directions", "regime"),
    key=("item_id", "request_key"),
)


@dataclass(frozen=True, kw_only=True)
class SteeringVoteRow(SteeredCell):
    """One judge's vote on one steered answer."""

    item_id: shared.ItemId
    side: shared.Side
    task: Annotated[str, "abstention, and correctness on controls"]
    judge: shared.Judge
    valid: Annotated[bool, "whether the judge's JSON meets the schema"]
    invalid_reason: Annotated[str | None, "why not; unread where the rules know no form of the answer"]
    abstained: Annotated[bool | None, "null if invalid, and for correctness"]
    correct: Annotated[bool | None, "null if invalid, and for abstention"]
    confidence: Annotated[str | None, "high, medium or low"]
    rationale: Annotated[str | None, "one sentence"]
    vote_key: Annotated[str, "ledger key; the two datasets of a taxonomy share the key of a control"]
    epoch: shared.Epoch
    created_at: shared.AskedAt
    benchmark_version: shared.BenchmarkVersion


STEERING_VOTES = Table(
    "steering_votes",
    SteeringVoteRow,
    partition_by=("dataset", "model", "directions", "regime"),
    key=("source", "kind", "draw", "layer", "unit", "dose", "signs", "item_id", "task", "judge"),
)


@dataclass(frozen=True, kw_only=True)
class SteeringEffectRow:
    """Abstention on one side of a target at one strength of one direction."""

    model: shared.Model
    directions: DirectionPrompt
    regime: Annotated[str, "system prompt of the steered answers"]
    source: Annotated[str, "dataset of the direction"]
    target: Annotated[str, "dataset that was steered"]
    transfer_type: Annotated[str, "Cross-modality, Cross-domain, Cross-both or Within, from the definitions"]
    kind: Kind
    draw: Draw
    layer: Block
    unit: DoseUnit
    dose: Dose
    signs: Signs
    alpha: Alpha
    alpha_relative: AlphaRelative
    side: shared.Side
    n: Annotated[int, "decided answers, one per scenario"]
    n_missing: Annotated[int, "answers missing or undecided"]
    abstained: Annotated[int, "decided answers that abstain"]
    abstention: Annotated[float, "abstained / (n + n_missing): an undecided answer is no abstention"]
    undecided: Annotated[float, "n_missing / (n + n_missing)"]
    perplexity: Annotated[
        float | None, "of the answers under the unsteered model: e to the mean nats a token; null without a text"
    ]
    low: shared.Wilson
    high: shared.Wilson
    correct: Annotated[int, "answers to controls that are correct"]
    n_correct: Annotated[int, "answers to controls that were decided for correctness"]
    degenerate: Annotated[int, "answers cut off, repetitive, or in another script than the unsteered one"]
    epoch: shared.AnswerEpochs


STEERING_EFFECTS = Table(
    "steering_effects",
    SteeringEffectRow,
    partition_by=(),
    key=(
        *("model", "directions", "regime", "source", "target", "kind", "draw", "layer", "unit", "dose", "signs"),
        "side",
    ),
)


@dataclass(frozen=True, kw_only=True)
class SteeringShareRow:
    """Abstention on a side at a strength, over a path set, for one regime or all."""

    model: shared.Model
    path_set: Annotated[str, "transfer, within_domain, or all of both"]
    directions: Annotated[str, "VQA prompt that the directions were extracted under, or all"]
    regime: Annotated[str, "system prompt of the steered answers, or all"]
    kind: Kind
    layer: Block
    alpha: Alpha
    side: shared.Side
    n_paths: Annotated[int, "paths that were steered"]
    n: Annotated[int, "answers over paths and regimes; an answer counts once in each of its paths"]
    n_answers: Annotated[int, "distinct answers among them, by ledger key"]
    n_scenarios: Annotated[int, "distinct scenarios of these answers"]
    abstention: Annotated[float, "share of answers that abstain, mean over paths and regimes"]
    undecided: Annotated[float, "share of answers that neither abstain nor answer"]
    low: Annotated[float | None, "95 % interval, Bayesian bootstrap over scenarios with one unseen"]
    high: Annotated[float | None, "95 % interval, Bayesian bootstrap over scenarios with one unseen"]
    epoch: shared.AnswerEpochs


STEERING_SHARES = Table(
    "steering_shares",
    SteeringShareRow,
    partition_by=(),
    key=("model", "path_set", "directions", "regime", "kind", "layer", "alpha", "side"),
)
