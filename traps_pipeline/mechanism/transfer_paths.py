"""List ordered pairs of datasets with transfer types (docs/spec.md 7.2 and 8.3)."""

from itertools import permutations, product
from typing import Literal

from traps_pipeline.protocol.datasets import ANSWERABLE, DATASETS, LONG, SHORT, taxonomy_of

Path = tuple[str, str]  # source and target dataset
PathSet = Literal["transfer", "within_domain"]

FAMILIES = ("occlusion", "chaotic")  # a direction's family is its source's taxonomy


def _paths(text: str) -> tuple[Path, ...]:
    pairs = (path.split("->") for path in text.split())
    return tuple((LONG[source], LONG[target]) for source, target in pairs)


# The paper's Qwen rows are of the first set, its Gemma and LLaVA rows of the second; two paths are in both.
TRANSFER = _paths("oc->ch ch->oc oc->ch_ip oc_ip->ch ch->oc_ip ch_ip->oc oc_ip->oc ch_ip->ch")
WITHIN_DOMAIN = tuple(
    (source, target) for source, target in product(DATASETS, DATASETS) if taxonomy_of(source) == taxonomy_of(target)
)
PATH_SETS: dict[PathSet, tuple[Path, ...]] = {"transfer": TRANSFER, "within_domain": WITHIN_DOMAIN}
STEERING_PATHS = tuple(dict.fromkeys(TRANSFER + WITHIN_DOMAIN))  # 14
TRANSFER_PAIRS = tuple(permutations(DATASETS, 2))  # the twelve ordered pairs of the probes

# Analyses of probes that have a value at every layer (`probing`); they are part of the version of probes.
CURVES = (
    *("transfer", "held_out", "confabulated", "confabulated_held_out", "within", "shuffled"),
    *("answerable_void", "answerable_control"),
)

# Items that can be answered although they look like voids, and the dataset whose voids they look like.
LOOK_ALIKES = {ANSWERABLE: "occlusion", "length_matched": "chaotic"}
TRANSFER_TYPES = ("Cross-modality", "Cross-domain", "Cross-both", "Within")


def probed_taxonomy(dataset: str) -> str:
    """Return the taxonomy of a probed dataset's scenarios."""
    return "chaotic" if LOOK_ALIKES.get(dataset, dataset).startswith("chaotic") else "occlusion"


def path_name(source: str, target: str) -> str:
    """Return the name of a steering path as tables show it: `oc→ch_ip`."""
    return f"{SHORT.get(source, source)}→{SHORT.get(target, target)}"


def sources_of(target: str) -> tuple[str, ...]:
    """Return the names of the datasets whose directions steer a target."""
    return tuple(source for source, path_target in STEERING_PATHS if path_target == target)
