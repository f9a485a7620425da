"""Every key scheme: categories, datasets, evaluations; how keys are formatted, parsed and checked.

Dagster allows two partition dimensions, sorts them by name, and forbids `|`, `,`, `[` and `]` inside a key.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Any

from traps_pipeline.base.names import check_name

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
# Domains beside the benchmark's: each has a benchmark of its own (`scene_specs/extensions/`), whose voids are made by a
# panel, as those of occlusion are. No study of the benchmark has one, nor has any number of the paper.
EXTENSION_CATEGORIES = ("soft_bodies",)
ALL_CATEGORIES = CATEGORIES + EXTENSION_CATEGORIES

DATASETS = ("occlusion", "occlusion_ill_posed", "chaotic", "chaotic_ill_posed")
SHORT = {"occlusion": "oc", "occlusion_ill_posed": "oc_ip", "chaotic": "ch", "chaotic_ill_posed": "ch_ip"}
LONG = {short: dataset for dataset, short in SHORT.items()}
# Datasets beside the pairs, each of which takes one shortcut away (docs/arms.md). No part of PECS; asked on request.
ANSWERABLE_ARMS = ("decoy", "removed", "late_panel", "length_matched", "predictable_cut", "twin_control")
VOID_ARMS = ("frame_out", "held_void")
PAIRED_ARMS = ("choices_swapped",)  # has controls and voids
ARMS = (*ANSWERABLE_ARMS, *VOID_ARMS, *PAIRED_ARMS)
# Datasets that change one thing of the pairs, step by step, for what the paper supposes and did not measure
# (docs/hypotheses.md). No part of PECS or of PECS-R; asked on request.
LABEL_DOSES = ("labels_two", "labels_three", "labels_six")
PANEL_LOOKS = ("panel_grey", "panel_magenta", "panel_large", "panel_alpha_95")  # still voids
PANEL_DOSES = ("panel_alpha_80", "panel_alpha_50")  # the panel lets the outcome through: no voids
SCHEMAS = ("schema_answer", "schema_reason", "schema_abstain")
FRAMINGS = ("frames_later", "frames_few", "frames_all")
VARIATIONS = (*LABEL_DOSES, *PANEL_LOOKS, *PANEL_DOSES, *SCHEMAS, *FRAMINGS)
BESIDE = (*ARMS, *VARIATIONS)  # all that is no dataset of the pairs
_ONE_TAXONOMY = {
    **dict.fromkeys(("decoy", "removed", "late_panel", "frame_out", *PANEL_LOOKS, *PANEL_DOSES), "occlusion"),
    **dict.fromkeys(("length_matched", "predictable_cut", "held_void"), "chaotic"),
}
REGIMES = ("standard", "guided", "json")
ANSWERABLE = "occlusion_answerable"  # of the mechanistic stages alone: occlusion's voids, with a question they answer
TIME_SWAPPED = "chaotic_time_swapped"  # of the mechanistic stages alone: each side's frames with the other's times
PROBED_ARMS = ("decoy", "length_matched")  # arms that probes are applied to where an experiment asks them
PROBED_DATASETS = (*DATASETS, ANSWERABLE, TIME_SWAPPED, *PROBED_ARMS)
VQA_PROMPTS = ("standard", "guided")
PROBE_PROMPT = "standard"  # probes are of this VQA prompt, the other one serves directions (docs/spec.md 7.1)
SIDES = ("control", "void")

_EVALUATION = re.compile(r"(?P<model>.+?)__(?P<regime>[a-z]+)__run(?P<run>[1-9][0-9]*)")


def taxonomy_of(dataset: str) -> str:
    """`occlusion` or `chaotic`."""
    return dataset.removesuffix("_ill_posed")


def is_ill_posed(dataset: str) -> bool:
    """Whether the void of a pair is the control's clip with an unanswerable question."""
    return dataset.endswith("_ill_posed")


def transfer_type(source: str, target: str) -> str:
    """What a path between datasets crosses (docs/spec.md 7.2): modality of the void, domain, both or neither."""
    domain = taxonomy_of(source) != taxonomy_of(target)
    modality = is_ill_posed(source) != is_ill_posed(target)
    return {(True, True): "Cross-both", (True, False): "Cross-domain", (False, True): "Cross-modality"}.get(
        (domain, modality), "Within"
    )


def taxonomy_of_category(category: str) -> str:
    """`occlusion` or `chaotic`."""
    return "chaotic" if category in CHAOTIC_CATEGORIES else "occlusion"


def datasets_of_category(category: str) -> tuple[str, str]:
    """The two datasets (visual, ill-posed) that a category's scenarios belong to."""
    taxonomy = taxonomy_of_category(category)
    return taxonomy, f"{taxonomy}_ill_posed"


def arms_of(taxonomy: str) -> tuple[str, ...]:
    """The arms that scenarios of a taxonomy may have."""
    return tuple(arm for arm in beside_of(taxonomy) if arm in ARMS)


def beside_of(taxonomy: str) -> tuple[str, ...]:
    """The arms and variations that scenarios of a taxonomy may have."""
    return tuple(name for name in BESIDE if _ONE_TAXONOMY.get(name, taxonomy) == taxonomy)


def all_datasets_of(category: str) -> tuple[str, ...]:
    """Everything that a category's scenarios are asked in."""
    return (*datasets_of_category(category), *beside_of(taxonomy_of_category(category)))


def dataset_of(item_id: str) -> str:
    """The dataset of an item, by its id `dataset:scenario:side`."""
    return item_id.partition(":")[0]


def sides_of(dataset: str) -> tuple[str, ...]:
    """The sides that a dataset, an arm or a variation asks of each scenario."""
    controls, voids = (*ANSWERABLE_ARMS, *PANEL_DOSES), (*VOID_ARMS, *PANEL_LOOKS)
    return {**dict.fromkeys(controls, ("control",)), **dict.fromkeys(voids, ("void",))}.get(dataset, SIDES)


@dataclass(frozen=True, order=True)
class Evaluation:
    """One model under one regime in one run: the second partition dimension of the paid stages."""

    model: str
    regime: str
    run: int

    @property
    def key(self) -> str:
        """`model__regime__runN`."""
        return f"{self.model}__{self.regime}__run{self.run}"

    @staticmethod
    def parse(key: str) -> Evaluation:
        """Inverse of `key`. Raises ValueError naming what is wrong."""
        found = _EVALUATION.fullmatch(key)
        if found is None or found["regime"] not in REGIMES:
            raise ValueError(f"evaluation key {key!r} is not model__regime__runN with a regime of {REGIMES}")
        return Evaluation(check_name(found["model"]), found["regime"], int(found["run"]))


@dataclass(frozen=True, order=True)
class Cell:
    """One dataset under one evaluation: a partition of responses, votes and verdicts."""

    dataset: str
    evaluation: Evaluation

    @property
    def key(self) -> str:
        """The partition key as Dagster writes it: dimensions sorted by name (`dataset` before `evaluation`)."""
        return f"{self.dataset}|{self.evaluation.key}"

    @property
    def partition(self) -> dict[str, Any]:
        """Values of the tables' partition columns."""
        e = self.evaluation
        return {"dataset": self.dataset, "model": e.model, "regime": e.regime, "run": e.run}

    @staticmethod
    def parse(key: str) -> Cell:
        """Inverse of `key`. Raises ValueError."""
        dataset, _, evaluation = key.partition("|")
        if dataset not in (*DATASETS, *BESIDE):
            raise ValueError(f"cell key {key!r}: dataset {dataset!r} is not one of {(*DATASETS, *BESIDE)}")
        return Cell(dataset, Evaluation.parse(evaluation))


# --- inside local models ----------------------------------------------------------------------------------------------


@dataclass(frozen=True, order=True)
class Extraction:
    """One local model under one VQA prompt: the partition of probes and directions."""

    model: str
    prompt: str

    @property
    def key(self) -> str:
        """`model__prompt`."""
        return f"{self.model}__{self.prompt}"

    @property
    def partition(self) -> dict[str, Any]:
        """Values of the tables' partition columns."""
        return {"model": self.model, "prompt": self.prompt}

    @staticmethod
    def parse(key: str) -> Extraction:
        """Inverse of `key`. Raises ValueError naming what is wrong."""
        model, _, prompt = key.partition("__")
        if prompt not in VQA_PROMPTS:
            raise ValueError(f"extraction key {key!r} is not model__prompt with a prompt of {VQA_PROMPTS}")
        return Extraction(check_name(model), prompt)


@dataclass(frozen=True, order=True)
class StatesCell:
    """One dataset under one extraction: a partition of hidden_states."""

    dataset: str
    extraction: Extraction

    @property
    def key(self) -> str:
        """The partition key as Dagster writes it."""
        return f"{self.dataset}|{self.extraction.key}"

    @property
    def partition(self) -> dict[str, Any]:
        """Values of the tables' partition columns."""
        return {"dataset": self.dataset, **self.extraction.partition}

    @staticmethod
    def parse(key: str) -> StatesCell:
        """Inverse of `key`. Raises ValueError."""
        dataset, _, extraction = key.partition("|")
        if dataset not in PROBED_DATASETS:
            raise ValueError(f"states key {key!r}: dataset {dataset!r} is not one of {PROBED_DATASETS}")
        return StatesCell(dataset, Extraction.parse(extraction))


class SteeredEvaluation(Evaluation):
    """A model that is steered while it answers under a regime. Its ledger holds all directions: what is not steered
    (alpha 0) is one answer for all of them."""

    @property
    def key(self) -> str:
        """`model__regime__steered`: the ledger's folder."""
        return f"{self.model}__{self.regime}__steered"


@dataclass(frozen=True, order=True)
class SteeringCell(Cell):
    """One target dataset under directions of one VQA prompt and answers under one regime: a partition of steering."""

    directions: str

    @property
    def run(self) -> str:
        """`model__directionregime__inferenceregime`."""
        return f"{self.evaluation.model}__{self.directions}__{self.evaluation.regime}"

    @property
    def key(self) -> str:
        """The partition key as Dagster writes it."""
        return f"{self.dataset}|{self.run}"

    @property
    def partition(self) -> dict[str, Any]:
        """Values of the tables' partition columns."""
        e = self.evaluation
        return {"dataset": self.dataset, "model": e.model, "directions": self.directions, "regime": e.regime}

    @staticmethod
    def make(dataset: str, model: str, directions: str, regime: str) -> SteeringCell:
        """The cell of these."""
        return SteeringCell(dataset, SteeredEvaluation(model, regime, 1), directions)

    @staticmethod
    def parse(key: str) -> SteeringCell:
        """Inverse of `key`. Raises ValueError."""
        dataset, _, run = key.partition("|")
        parts = run.split("__")
        # A graph has a key of each dataset of its study, arms too; only those of the pairs are ever wanted.
        if dataset not in (*DATASETS, *BESIDE) or len(parts) != 3 or not {parts[1], parts[2]} <= set(VQA_PROMPTS):
            raise ValueError(
                f"steering key {key!r} is not dataset|model__directions__regime with regimes of {VQA_PROMPTS}"
            )
        return SteeringCell.make(dataset, check_name(parts[0]), parts[1], parts[2])
