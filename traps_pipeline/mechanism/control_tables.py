"""The tables of controls: what stands beside a probe, a direction or a steered answer, so that a claim can fail."""

from dataclasses import dataclass
from typing import Annotated

from traps_pipeline.mechanism.tables import AnswerRegime, Block, DirectionPrompt, Dose, DoseUnit, Prompt, Signs
from traps_pipeline.storage import columns as shared
from traps_pipeline.storage.tables import Table

Share = Annotated[float | None, "share, 0 to 1"]


@dataclass(frozen=True, kw_only=True)
class SteeringNullRow:
    """The effect of a void direction on its own dataset at the largest dose, ranked among the draws of one null."""

    model: shared.Model
    directions: DirectionPrompt
    regime: AnswerRegime
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
    n: Annotated[int, "decided answers steered along the void direction, one per scenario and dataset"]
    epoch: shared.AnswerEpochs


STEERING_NULLS = Table(
    "steering_nulls",
    SteeringNullRow,
    partition_by=(),
    key=("model", "directions", "regime", "target", "layer", "unit", "dose", "side", "null"),
)


@dataclass(frozen=True, kw_only=True)
class SteeringPecsRow:
    """PECS and its parts of a steered model: one path at one dose under one sign policy."""

    model: shared.Model
    directions: DirectionPrompt
    regime: AnswerRegime
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
    degenerate: Annotated[float, "share of answers that are cut off, repetitive or in another script"]
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
class ProbeBaselineRow:
    """A figure of the probing protocol on other features than states."""

    model: shared.Model
    prompt: Prompt
    features: Annotated[
        str, "question words, first frame, all frames, length, time stamps, output margin, or noise as wide as states"
    ]
    analysis: Annotated[str, "as in probes: transfer, held_out, answerable_void, answerable_control, time_swapped"]
    source: Annotated[str, "dataset that was fitted"]
    target: Annotated[str, "dataset that was scored"]
    value: Annotated[float | None, "AUROC; of noise the mean over draws"]
    low: Annotated[float | None, "as in probes"]
    high: Annotated[float | None, "as in probes"]
    spread: Annotated[float | None, "of noise: standard deviation over draws"]
    n_voids: Annotated[int, "void items of the target"]
    n_controls: Annotated[int, "control items of the target"]
    note: Annotated[str | None, "why there is no figure"]


PROBE_BASELINES = Table(
    "probe_baselines",
    ProbeBaselineRow,
    partition_by=("model", "prompt"),
    key=("features", "analysis", "source", "target"),
)
