"""Estimate passes, tokens, GPU-hours and memory of local models for `traps plan`.

The estimate is arithmetic with constants that were measured on one card: a pass takes 2 operations per parameter and
token, and decoding steps are bound by each block's kernels or by reading the weights. docs/mechanism.md states both.
"""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

from traps_pipeline.models.local.vision_cache import MAX_BYTES
from traps_pipeline.models.registry.checkpoint import NF4_BYTES
from traps_pipeline.models.registry.entries import ModelEntry
from traps_pipeline.protocol.datasets import DATASETS, PROBED_ARMS, SIDES, sides_of, taxonomy_of
from traps_pipeline.protocol.regimes import RANDOM_WEIGHTS
from traps_pipeline.storage.media import MediaSpec
from traps_pipeline.storage.study import MechanismSettings

TEXT_TOKENS = 220  # system prompt, question and chat template
CLIP_S = 5.0
UTILISATION = 0.25  # share of a card's operations that passes over prompts reach
STEP_S = 0.9e-3  # per block and decoding step
ATTENTION_S = 14e-9  # beside it, per block, step, row and token of its prompt
NF4_TIMES = 1.5  # factor on time, since weights are unpacked at every use
BFLOAT16_BYTES = 2.0  # per parameter
ROWS = 64  # rows of a batch of answers
ROWS_BEHIND = 16  # texts behind one pass over a prompt, whose keys and values each of them repeats
PEAK_WIDTHS = 28  # numbers per token and unit of width at a block's peak
GRAPH = 22  # numbers per token, block and unit of width that a backward pass keeps
RANDOM = "states of random weights"  # in bfloat16, whatever the entry says
SOURCES = 4  # sources of patches: the other side, and three nulls


@dataclass(frozen=True)
class Card:
    """A GPU: its dense bfloat16 operations and bytes of memory per second, and GB of memory."""

    operations: float
    bandwidth: float
    gigabytes: float


CARDS = {
    "H100": Card(989e12, 3.35e12, 80),
    "A100": Card(312e12, 2.0e12, 80),
    "L40S": Card(362e12, 0.86e12, 48),
    "RTX4090": Card(165e12, 1.0e12, 24),
}


@dataclass(frozen=True)
class Work:
    """The work of a stage on a model: passes over prompts, and tokens per answer (0: none are generated)."""

    kind: str
    passes: float
    answer_tokens: int = 0


@dataclass(frozen=True)
class Cost:
    """The cost of work on a model; hours, gigabytes: None if its entry has no `size`.

    gigabytes: what one prompt needs, with the features of cached clips; batches of answers take what else is free.
    """

    model: str
    kind: str
    passes: int
    tokens_in: float
    tokens_out: float
    hours: float | None
    gigabytes: float | None


def too_large(costs: Sequence[Cost], card: Card, quantised: Collection[str]) -> list[str]:
    """Return a sentence on what to change for each work too large for a card. quantised: models in NF4."""
    sentences = list[str]()
    for cost in costs:
        if cost.gigabytes is None or cost.gigabytes <= card.gigabytes:
            continue
        changes = {
            "quantisation: nf4 under `mechanism` of its entry": cost.model not in quantised and cost.kind != RANDOM,
            "random_weights: false there": cost.kind == RANDOM,
            "patching: null": cost.kind == "patching",
            "fewer frames (`media`)": True,
        }
        advice = " or ".join(change for change, helps in changes.items() if helps)
        need = f"{cost.gigabytes:.1f} GB, but the card has {card.gigabytes:g}"
        sentences.append(f"{cost.model}, {cost.kind}: does not fit: {need}; set {advice}")
    return sentences


def mechanism_passes(
    settings: MechanismSettings, datasets: Sequence[str], scenarios: Mapping[str, int], random_weights: bool = True
) -> list[Work]:
    """Return the forward passes of states, sentences, random weights and patching.

    scenarios: their number by taxonomy. random_weights: as in the model's entry.
    """
    n_pair_items = sum(2 * scenarios.get(taxonomy_of(name), 0) for name in datasets if name in DATASETS)
    extra_prompts = scenarios.get("occlusion", 0) * ("occlusion" in datasets)  # voids with a question that they answer
    extra_prompts += sum(len(sides_of(arm)) * sum(scenarios.values()) for arm in datasets if arm in PROBED_ARMS)
    work = [Work("states", len(settings.prompts) * n_pair_items + extra_prompts)]
    if settings.sentences:  # under each regime; the sentences themselves are few tokens behind one pass
        work.append(Work("sentences", len(settings.prompts) * n_pair_items))
    if random_weights:
        work.append(Work(RANDOM, len(RANDOM_WEIGHTS) * (n_pair_items + extra_prompts)))
    if settings.patching is not None:
        pairs = sum(min(settings.patching.pairs, scenarios.get(name, 0)) for name in ("occlusion", "chaotic"))
        estimate = 2 + 3  # two recorded passes; one with gradients takes three times as long
        patches = 1 + SOURCES + SOURCES * (settings.patching.exact + 1) / 2  # a patched pass runs half of the blocks
        work.append(Work("patching", len(SIDES) * pairs * (estimate + patches)))
    return work


def cost_of(entry: ModelEntry, media: MediaSpec, work: Work, card: Card, *, quantised: bool) -> Cost:
    """Return the cost of work on a model to which clips are shown by `media`; quantised: to NF4."""
    frames = media.uniform or min(media.most, round((media.fps or 1) * CLIP_S))
    prompt = frames * entry.tokens_per_frame + TEXT_TOKENS
    tokens_in, tokens_out = work.passes * prompt, work.passes * work.answer_tokens
    passes = round(work.passes)
    if entry.size is None:
        return Cost(entry.id, work.kind, passes, tokens_in, tokens_out, None, None)
    parameters, layers, width = entry.size.parameters_b * 1e9, entry.size.layers, entry.size.width
    weights = parameters * (NF4_BYTES if quantised else BFLOAT16_BYTES)
    seconds = 2 * parameters * tokens_in / (UTILISATION * card.operations)
    step_s = max(layers * STEP_S, weights / card.bandwidth) + layers * ROWS * prompt * ATTENTION_S
    seconds += tokens_out / ROWS * step_s
    state = prompt * width * BFLOAT16_BYTES  # bytes of one layer
    extra = (4 * layers + 2 + GRAPH * layers) * state if work.kind == "patching" else PEAK_WIDTHS * state
    return Cost(
        entry.id, work.kind, passes, tokens_in, tokens_out,
        hours=seconds * (NF4_TIMES if quantised else 1.0) / 3600,
        gigabytes=(weights + MAX_BYTES + extra) / 1e9,
    )  # fmt: skip
