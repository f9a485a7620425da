"""Define tables of controls, which a claim about a model's hidden states must pass."""

from dataclasses import dataclass
from typing import Annotated

from traps_pipeline.mechanism.mechanism_rows import Block, Dose, DoseUnit, ExtractionColumns, Signs, SteeringColumns
from traps_pipeline.storage import columns as shared
from traps_pipeline.storage.tables import Table

Share = Annotated[float | None, "share, 0 to 1"]


@dataclass(frozen=True, kw_only=True)
class JoinedColumns(ExtractionColumns):
    """Columns of rows that join a model's states with its answers."""

    joins: Annotated[
        str | None, "null: one model; else precision and frames of the two that are joined: no claim reads the row"
    ]


@dataclass(frozen=True, kw_only=True)
class SteeringNullRow(SteeringColumns):
    """A void direction's effect on its dataset at one dose, ranked among nulls."""

    target: Annotated[str, "dataset of the direction, which is also the one that was steered; all: mean over datasets"]
    layer: Block
    unit: DoseUnit
    dose: Dose
    side: shared.Side
    null: Annotated[str, "isotropic, covariance or shuffled; each is orthogonal to the void direction"]
    effect: Annotated[
        float, "of the void direction: rise of abstention on controls (+), fall of abstention on voids (-)"
    ]
    null_mean: Annotated[float, "the same of the null, mean over draws"]
    null_lowest: Annotated[float, "lowest draw"]
    null_highest: Annotated[float, "highest draw"]
    draws: Annotated[int, "draws of the null"]
    n_at_least: Annotated[int, "draws whose effect is at least that of the void direction"]
    p: Annotated[float, "(1 + n_at_least) / (1 + draws), one-sided"]
    n: Annotated[int, "answers steered along the void direction, one per scenario and dataset"]
    undecided: Annotated[float, "share of these that neither abstain nor answer"]
    null_undecided: Annotated[float, "the same of the null"]
    perplexity: Annotated[float | None, "of the answers under the unsteered model; null without one"]
    null_perplexity: Annotated[float | None, "the same of the null"]
    epoch: shared.AnswerEpochs


STEERING_NULLS = Table(
    "steering_nulls",
    SteeringNullRow,
    partition_by=(),
    key=("model", "directions", "regime", "target", "layer", "unit", "dose", "side", "null"),
)


@dataclass(frozen=True, kw_only=True)
class SteeringPecsRow(SteeringColumns):
    """PECS and its parts of a steered model, by path, dose and sign policy."""

    source: Annotated[str, "dataset of the direction"]
    target: Annotated[str, "dataset that was steered"]
    layer: Block
    unit: DoseUnit
    dose: Dose
    signs: Signs
    acc: Share
    false_abs: Share
    abs_rec: Share
    j: Annotated[float | None, "abs_rec - false_abs"]
    pecs: Share
    degenerate: Annotated[float, "share of answers that are cut off, repetitive, or in another script or language"]
    undecided: Annotated[float, "share of answers that neither abstain nor answer; the other shares leave these out"]
    perplexity: Annotated[float | None, "of the answers under the unsteered model, mean over sides; null without one"]
    n_controls: Annotated[int, "decided answers to controls"]
    n_voids: Annotated[int, "decided answers to voids"]
    epoch: shared.AnswerEpochs


STEERING_PECS = Table(
    "steering_pecs",
    SteeringPecsRow,
    partition_by=(),
    key=("model", "directions", "regime", "source", "target", "layer", "unit", "dose", "signs"),
)


@dataclass(frozen=True, kw_only=True)
class ProbeBaselineRow(ExtractionColumns):
    """A metric of the probing protocol on other features than states."""

    features: Annotated[
        str, "question words, first frame, all frames, length, time stamps, output margin or noise as wide as states"
    ]
    analysis: Annotated[str, "as in probes, but for within and shuffled"]
    source: Annotated[str, "dataset that was fitted"]
    target: Annotated[str, "dataset that was scored"]
    scope: Annotated[str, "as in probes"]
    value: Annotated[float | None, "AUROC, or the share assigned to void; of noise the mean over draws"]
    low: Annotated[float | None, "as in probes"]
    high: Annotated[float | None, "as in probes"]
    spread: Annotated[float | None, "of noise: standard deviation over draws"]
    n_voids: Annotated[int, "void items of the target"]
    n_controls: Annotated[int, "control items of the target"]


PROBE_BASELINES = Table(
    "probe_baselines",
    ProbeBaselineRow,
    partition_by=("model", "prompt"),
    key=("features", "analysis", "source", "target", "scope"),
)


@dataclass(frozen=True, kw_only=True)
class GateRow(JoinedColumns):
    """Scores on a target before and after a gate, by features, source and threshold."""

    regime: Annotated[str, "system prompt of the answers that are gated"]
    features: Annotated[
        str, "states, or a control: a raw input, output margin, shuffled labels (of states) or untrained model"
    ]
    source: Annotated[str, "one:DATASET, other datasets (all but the target) or other families"]
    threshold: Annotated[str, "mid, J or conformal"]
    target: Annotated[
        str, "dataset; all: mean over the four; or items without a pair, of which false_abs alone is known"
    ]
    layer: Annotated[int, "of the states, chosen on pairs of other datasets than the target; -1 for other features"]
    auroc: Annotated[float | None, "of the gate's scores on the target"]
    acc: Share
    false_abs: Share
    abs_rec: Share
    pecs: Share
    pecs_low: Annotated[float | None, "95 % interval, scenarios resampled with one unseen, the gate held fixed"]
    pecs_high: Annotated[float | None, "95 % interval, scenarios resampled with one unseen, the gate held fixed"]
    plain_acc: Annotated[float | None, "without the gate"]
    plain_false_abs: Annotated[float | None, "without the gate"]
    plain_abs_rec: Annotated[float | None, "without the gate"]
    plain_pecs: Annotated[float | None, "without the gate"]
    expected_false_abs: Annotated[float | None, "share of the source's unseen controls above the threshold"]
    n_controls: Annotated[int, "control items of the target"]
    n_voids: Annotated[int, "void items of the target"]


GATE = Table(
    "gate", GateRow, partition_by=("model", "prompt"), key=("regime", "features", "source", "threshold", "target")
)


@dataclass(frozen=True, kw_only=True)
class LensRow(ExtractionColumns):
    """The margin of a dataset's states at a layer (logit lens: final norm and head)."""

    dataset: shared.Dataset
    layer: Annotated[int, "counted as in hidden_states; at the last one it is the output margin"]
    voids: Annotated[float, "mean log-odds of voids that the first answer token begins an abstention"]
    controls: Annotated[float, "the same of controls"]
    auroc: Annotated[float, "of the log-odds, voids against controls"]
    low: Annotated[float, "95 % interval, scenarios resampled"]
    high: Annotated[float, "95 % interval, scenarios resampled"]
    n_voids: Annotated[int, "void items"]
    n_controls: Annotated[int, "control items"]


LENS = Table("lens", LensRow, partition_by=("model", "prompt"), key=("dataset", "layer"))

MODEL, STATES, RESIDUAL, LOGITS = "model", "states", "states, residual", "first-token logits"


@dataclass(frozen=True, kw_only=True)
class LeadRow(ExtractionColumns):
    """How well features order a dataset's sides, by probes of the other datasets."""

    subject: Annotated[
        str,
        "model; a control: random_0, random_1 (the network with random weights of that seed), or a placebo: answerable "
        "items that stand for the target's voids, by their dataset",
    ]
    target: shared.Dataset
    features: Annotated[
        str,
        "states; states, residual (without what is linear in words, pixels and length); or a rival: a raw input, "
        "output margin or first-token logits (log-probabilities of 256 tokens, with a probe)",
    ]
    layer: Annotated[int, "of the states, chosen on pairs of other datasets than the target; -1 for rivals"]
    auroc: Annotated[float, "voids against controls, by probes that have seen neither the dataset nor the scenario"]
    low: Annotated[float, "95 % interval, scenarios resampled, probes held fixed"]
    high: Annotated[float, "95 % interval, scenarios resampled, probes held fixed"]
    rival: Annotated[str | None, "of states: the rival with the highest AUROC"]
    lead: Annotated[float | None, "of states: their AUROC less that rival's"]
    lead_low: Annotated[float | None, "95 % interval of the lead, both resampled together"]
    lead_high: Annotated[float | None, "95 % interval of the lead, both resampled together"]
    n_voids: Annotated[int, "items that stand for voids"]
    n_controls: Annotated[int, "control items"]


LEADS = Table("leads", LeadRow, partition_by=("model", "prompt"), key=("subject", "target", "features"))

Chance = Annotated[float | None, "95 % interval, scenarios resampled, probes held fixed"]


@dataclass(frozen=True, kw_only=True)
class InteractionRow(JoinedColumns):
    """Whether features tell, of clips of two events, that the asked one is hidden; chance is 0.5."""

    features: Annotated[
        str,
        "states; or a rival: pixels, words, both added and length are at 0.5 by design, output margin and first-token "
        "logits (with a probe) are what the model says",
    ]
    layer: Annotated[int, "of the states; -1 for rivals"]
    held_out: Annotated[str, "what probes have not seen: scenarios or families"]
    chosen: Annotated[bool, "whether it is the layer at which pairs of other datasets transfer best, or a rival"]
    auroc: Annotated[float, "asked event hidden against the other one, fitted and read on clips that hide one event"]
    auroc_low: Chance
    auroc_high: Chance
    within: Annotated[float, "share of these clips whose hidden event's question is scored above the other one"]
    within_low: Chance
    within_high: Chance
    same: Annotated[float, "share of these clips with the same features under both questions"]
    confound: Annotated[float, "AUROC of the same probe over all eight items: the number of boards tells; no claim"]
    own_effect: Annotated[float, "rise of the score from no event hidden to the asked one alone, in its deviations"]
    other_effect: Annotated[float, "the same to the other one alone"]
    n_clips: Annotated[int, "clips that hide one event"]
    n_scenarios: Annotated[int, "scenarios of two events"]


INTERACTION = Table(
    "interaction", InteractionRow, partition_by=("model", "prompt"), key=("features", "layer", "held_out")
)

UNSEEN = "log-odds of void above the mid threshold, by a probe that has not seen the scenario"


@dataclass(frozen=True, kw_only=True)
class ItemScoreRow(JoinedColumns):
    """An item's scores from a model's states and output, beside its verdicts."""

    item_id: shared.ItemId
    dataset: shared.Dataset
    scenario_id: shared.ScenarioId
    side: shared.Side
    layer: Annotated[int, "at which the dataset is read, chosen on pairs of other datasets"]
    others: Annotated[float | None, f"{UNSEEN} and was fitted on the other datasets"]
    margin: Annotated[float | None, "log-odds that the first answer token begins an abstention, under this prompt"]
    abstained_standard: Annotated[bool | None, "verdict of run 1 under standard; null if undecided or not asked"]
    abstained_guided: Annotated[bool | None, "verdict of run 1 under guided; null if undecided or not asked"]


ITEM_SCORES = Table("item_scores", ItemScoreRow, partition_by=("model", "prompt"), key=("item_id",))


@dataclass(frozen=True, kw_only=True)
class SentenceRow(JoinedColumns):
    """Log-probabilities of an abstention and of the model's answer, for an item."""

    item_id: shared.ItemId
    dataset: shared.Dataset
    scenario_id: shared.ScenarioId
    side: shared.Side
    sentence: Annotated[str, "the likeliest of the study's abstentions"]
    abstention: Annotated[float, "its mean log-probability, nats a token"]
    own: Annotated[float | None, "the same of the model's answer of run 1; null without a text"]
    own_tokens: Annotated[int, "tokens of that answer that count, from its beginning"]


SENTENCES = Table("sentences", SentenceRow, partition_by=("model", "prompt"), key=("item_id",))


@dataclass(frozen=True, kw_only=True)
class PatchingRow(ExtractionColumns):
    """The indirect effect of a position group at a site and layer, over a dataset."""

    dataset: shared.Dataset
    into: Annotated[str, "side whose pass is changed: control (towards its void) or void (towards its control)"]
    source: Annotated[
        str,
        "where the patch comes from: pair (the other side), or a null: other scenario (another scenario's other side), "
        "same side (another scenario's same side) or other times (the item's own frames with the other side's times)",
    ]
    site: Annotated[str, "residual (as it leaves the block), attention or mlp (their outputs)"]
    layer: Annotated[int, "counted as in hidden_states"]
    group: Annotated[
        str,
        "system, stamps, changed (visual tokens whose pixels differ between the sides), unchanged, question, last, "
        "or all",
    ]
    attributed: Annotated[
        float | None, "estimate of `effect` to first order, from one backward pass a pair; null for nulls"
    ]
    effect: Annotated[
        float | None,
        "sum of changes of the outcome over the sum of the differences between the sides; 1: all of it; null where no "
        "patch was made",
    ]
    low: Annotated[float | None, "95 % interval, pairs resampled with one unseen"]
    high: Annotated[float | None, "95 % interval, pairs resampled with one unseen"]
    flips: Annotated[
        float | None, "share of pairs whose sides differ in the sign of the outcome in which the patch changes the sign"
    ]
    n_flippable: Annotated[int, "such pairs"]
    n: Annotated[int, "pairs"]
    n_left_out: Annotated[int, "pairs whose prompts have another form, or no such source"]
    tokens: Annotated[float, "tokens of the group, mean over pairs"]


PATCHING = Table(
    "patching",
    PatchingRow,
    partition_by=("model", "prompt"),
    key=("dataset", "into", "source", "site", "layer", "group"),
)
