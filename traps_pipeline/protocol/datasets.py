"""Name datasets, arms and variations, their sides, and their categories."""

from __future__ import annotations

OCCLUSION_CATEGORIES = (
    "ramps_rolling",
    "pendulums_levers",
    "trajectories_drops",
    "hidden",
    "collisions",
    "dominoes",
    "stacks",
    "other",
)
CHAOTIC_CATEGORIES = ("pachinko_waterfall", "plinko", "seesaw_sorter", "tumbling_dice")
CATEGORIES = OCCLUSION_CATEGORIES + CHAOTIC_CATEGORIES
# Domains beside the benchmark's: each has its own benchmark (`scene_specs/extensions/`), whose voids use an
# occluder, as those of occlusion do. No study of the main benchmark and no number of the paper includes one.
EXTENSION_CATEGORIES = ("soft_bodies",)
# Pairs of recorded video, in benchmarks of their own: voids that are covered or filmed apart, and voids that are cut.
RECORDED = "recorded"  # the family of all that nobody simulated
RECORDED_CATEGORIES = ("recorded_hidden", "recorded_cut")
ALL_CATEGORIES = CATEGORIES + EXTENSION_CATEGORIES + RECORDED_CATEGORIES

DATASETS = ("occlusion", "occlusion_ill_posed", "chaotic", "chaotic_ill_posed")
SHORT = {"occlusion": "oc", "occlusion_ill_posed": "oc_ip", "chaotic": "ch", "chaotic_ill_posed": "ch_ip"}
LONG = {short: dataset for dataset, short in SHORT.items()}
# Datasets beside the pairs, each of which removes one shortcut (docs/arms.md). No part of PECS; run on request.
TWIN = "twin_control"
INFERENCE_ARMS = ("late_occluder", "predictable_cut")  # the outcome is not shown, but can be inferred
ARMS = ("length_matched", TWIN, *INFERENCE_ARMS)
# Two events side by side, with each, both or neither of them hidden, and a question about either
# (protocol/two_events.py). No part of PECS or of the arms' metrics; run on request.
TWO_EVENTS = "two_events"
REPLACED = ("decoy", "removed", "crossed")  # arms of 0.3 that two events take the place of
# Controls cut where the likeliest answer has a stated probability (docs/arms.md, "Graded cuts"). In no metric
# of pairs or arms; run on request.
GRADED = "graded"
# Datasets that change one property of the pairs, step by step, to test the paper's untested assumptions
# (docs/hypotheses.md). No part of PECS or of the arms' metrics; run on request.
LABEL_DOSES = ("labels_two", "labels_three", "labels_six")
OCCLUDER_LOOKS = ("occluder_grey", "occluder_magenta", "occluder_large")  # still voids
OCCLUDER_DOSES = ("occluder_alpha_50",)  # the occluder lets the outcome through: no voids
SCHEMAS = ("schema_answer", "schema_reason", "schema_abstain")
FRAMINGS = ("frames_later", "frames_few", "frames_all")
VARIATIONS = (*LABEL_DOSES, *OCCLUDER_LOOKS, *OCCLUDER_DOSES, *SCHEMAS, *FRAMINGS)
UNPAIRED = (*ARMS, TWO_EVENTS, GRADED, *VARIATIONS)  # all that is no dataset of the pairs
_ONE_TAXONOMY = {
    **dict.fromkeys(("late_occluder", TWO_EVENTS, *OCCLUDER_LOOKS, *OCCLUDER_DOSES), "occlusion"),
    **dict.fromkeys(("length_matched", "predictable_cut", GRADED), "chaotic"),
}
ANSWERABLE = "occlusion_answerable"  # only in mechanistic stages: occlusion's voids, answerable
PROBED_ARMS = ("length_matched",)  # arms that probes are applied to where an experiment asks them
PROBED_DATASETS = (*DATASETS, ANSWERABLE, *PROBED_ARMS)
EXTRACTED = (*PROBED_DATASETS, TWO_EVENTS)  # all whose hidden states may be extracted
SIDES = ("control", "void")


def taxonomy_of(dataset: str) -> str:
    """Return the taxonomy of a dataset: `occlusion` or `chaotic`."""
    return dataset.removesuffix("_ill_posed")


def is_ill_posed(dataset: str) -> bool:
    """Return whether a void is the control's clip with an unanswerable question."""
    return dataset.endswith("_ill_posed")


def transfer_type(source: str, target: str) -> str:
    """Return what a transfer crosses (docs/spec.md 7.2): modality, domain, both, none."""
    domain = taxonomy_of(source) != taxonomy_of(target)
    modality = is_ill_posed(source) != is_ill_posed(target)
    return {(True, True): "Cross-both", (True, False): "Cross-domain", (False, True): "Cross-modality"}.get(
        (domain, modality), "Within"
    )


def taxonomy_of_category(category: str) -> str:
    """Return the taxonomy of a dataset: `occlusion` or `chaotic`."""
    return "chaotic" if category in (*CHAOTIC_CATEGORIES, "recorded_cut") else "occlusion"


def datasets_of_category(category: str) -> tuple[str, str]:
    """Return the two datasets (visual, ill-posed) of a category's scenarios."""
    taxonomy = taxonomy_of_category(category)
    return taxonomy, f"{taxonomy}_ill_posed"


def extra_datasets_of(taxonomy: str) -> tuple[str, ...]:
    """Return the arms and variations that scenarios of a taxonomy may have."""
    return tuple(name for name in UNPAIRED if _ONE_TAXONOMY.get(name, taxonomy) == taxonomy)


def arms_of_category(category: str) -> tuple[str, ...]:
    """Return the arms and variations of a category's scenarios; recorded ones, without physics, have two events."""
    extra = extra_datasets_of(taxonomy_of_category(category))
    return tuple(name for name in extra if name == TWO_EVENTS or category not in RECORDED_CATEGORIES)


def all_datasets_of(category: str) -> tuple[str, ...]:
    """Return all datasets, with arms and variations, of a category's scenarios."""
    return (*datasets_of_category(category), *arms_of_category(category))


def dataset_of(item_id: str) -> str:
    """Return the dataset of an item from its id: all before the first colon."""
    return item_id.partition(":")[0]


def sides_of(dataset: str) -> tuple[str, ...]:
    """Return the sides that a dataset, an arm or a variation asks of each scenario."""
    controls = {*ARMS, GRADED, *OCCLUDER_DOSES}
    return ("control",) if dataset in controls else ("void",) if dataset in OCCLUDER_LOOKS else SIDES
