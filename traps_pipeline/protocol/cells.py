"""Format, parse and check the keys of cells, evaluations and extractions.

Dagster allows two partition dimensions, sorts them by name, and forbids `|`, `,`, `[` and `]` inside a key.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Any

from traps_pipeline.base.names import check_name
from traps_pipeline.protocol.datasets import DATASETS, EXTRACTED, TWO_EVENTS, UNPAIRED
from traps_pipeline.protocol.regimes import GUIDED, PROBE_PROMPT, RANDOM_WEIGHTS, REGIMES, VQA_PROMPTS

_EVALUATION = re.compile(r"(?P<model>.+?)__(?P<regime>[a-z]+)__run(?P<run>[1-9][0-9]*)")


@dataclass(frozen=True, order=True)
class Evaluation:
    """One model under one regime in one run; a partition dimension of paid stages."""

    model: str
    regime: str
    run: int

    @property
    def key(self) -> str:
        """The partition key `model__regime__runN`."""
        return f"{self.model}__{self.regime}__run{self.run}"

    @staticmethod
    def parse(key: str) -> Evaluation:
        """Parse an evaluation's key. Raises ValueError that says what is wrong."""
        match = _EVALUATION.fullmatch(key)
        if match is None or match["regime"] not in REGIMES:
            raise ValueError(f"evaluation key {key!r} is not model__regime__runN with a regime of {REGIMES}")
        return Evaluation(check_name(match["model"]), match["regime"], int(match["run"]))


@dataclass(frozen=True, order=True)
class Cell:
    """One dataset under one evaluation: a partition of responses, votes and verdicts."""

    dataset: str
    evaluation: Evaluation

    @property
    def key(self) -> str:
        """The partition key, with dimensions sorted by name as Dagster writes it."""
        return f"{self.dataset}|{self.evaluation.key}"

    @property
    def partition(self) -> dict[str, Any]:
        """Values of the table's partition columns."""
        e = self.evaluation
        return {"dataset": self.dataset, "model": e.model, "regime": e.regime, "run": e.run}

    @property
    def share(self) -> float:
        """The share of the partition's items that it holds."""
        return 1.0

    @staticmethod
    def parse(key: str) -> Cell:
        """Parse a cell's key. Raises ValueError that says what is wrong."""
        dataset, _, evaluation = key.partition("|")
        if dataset not in (*DATASETS, *UNPAIRED):
            raise ValueError(f"cell key {key!r}: dataset {dataset!r} is not one of {(*DATASETS, *UNPAIRED)}")
        return Cell(dataset, Evaluation.parse(evaluation))


@dataclass(frozen=True, order=True)
class Extraction:
    """One local model under one VQA prompt: the partition of probes and directions.

    prompt: of VQA_PROMPTS; or a key of RANDOM_WEIGHTS, which names other weights under PROBE_PROMPT.
    """

    model: str
    prompt: str

    @property
    def text(self) -> str:
        """The VQA prompt that is read."""
        return PROBE_PROMPT if self.prompt in RANDOM_WEIGHTS else self.prompt

    @property
    def weights_seed(self) -> int | None:
        """The seed of random weights; None for the checkpoint's own."""
        return RANDOM_WEIGHTS.get(self.prompt)

    @property
    def key(self) -> str:
        """The partition key `model__prompt`."""
        return f"{self.model}__{self.prompt}"

    @property
    def partition(self) -> dict[str, Any]:
        """Values of the table's partition columns."""
        return {"model": self.model, "prompt": self.prompt}

    @staticmethod
    def parse(key: str) -> Extraction:
        """Parse an extraction's key. Raises ValueError that says what is wrong."""
        model, _, prompt = key.partition("__")
        if prompt not in (*VQA_PROMPTS, *RANDOM_WEIGHTS):
            raise ValueError(
                f"extraction key {key!r} is not model__prompt with a prompt of {(*VQA_PROMPTS, *RANDOM_WEIGHTS)}"
            )
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
        """Values of the table's partition columns."""
        return {"dataset": self.dataset, **self.extraction.partition}

    @property
    def text(self) -> str:
        """The VQA prompt that is read; two events are read under GUIDED, with random weights too."""
        is_random = self.extraction.weights_seed is not None
        return GUIDED if is_random and self.dataset == TWO_EVENTS else self.extraction.text

    @staticmethod
    def parse(key: str) -> StatesCell:
        """Parse a cell's key. Raises ValueError that says what is wrong."""
        dataset, _, extraction = key.partition("|")
        if dataset not in EXTRACTED:
            raise ValueError(f"states key {key!r}: dataset {dataset!r} is not one of {EXTRACTED}")
        return StatesCell(dataset, Extraction.parse(extraction))


class SteeredEvaluation(Evaluation):
    """A model that is steered while it answers under a regime.

    Its ledger holds all directions: an unsteered answer (alpha 0) is shared by all of them.
    """

    @property
    def key(self) -> str:
        """The name of the ledger's folder: `model__regime__steered`."""
        return f"{self.model}__{self.regime}__steered"


@dataclass(frozen=True, order=True)
class SteeringCell(Cell):
    """A partition of steering: dataset, model, directions' prompt, answers' regime."""

    directions: str

    @property
    def run(self) -> str:
        """The second key dimension: `model__directionregime__inferenceregime`."""
        return f"{self.evaluation.model}__{self.directions}__{self.evaluation.regime}"

    @property
    def key(self) -> str:
        """The partition key as Dagster writes it."""
        return f"{self.dataset}|{self.run}"

    @property
    def partition(self) -> dict[str, Any]:
        """Values of the table's partition columns."""
        e = self.evaluation
        return {"dataset": self.dataset, "model": e.model, "directions": self.directions, "regime": e.regime}

    @staticmethod
    def make(dataset: str, model: str, directions: str, regime: str) -> SteeringCell:
        """Make a steering cell from the directions' prompt and the answers' regime."""
        return SteeringCell(dataset, SteeredEvaluation(model, regime, 1), directions)

    @staticmethod
    def parse(key: str) -> SteeringCell:
        """Parse a cell's key. Raises ValueError that says what is wrong."""
        dataset, _, run = key.partition("|")
        parts = run.split("__")
        # The graph has a key for each dataset of its study, arms too; only those of pairs are ever wanted.
        if dataset not in (*DATASETS, *UNPAIRED) or len(parts) != 3 or not {parts[1], parts[2]} <= set(VQA_PROMPTS):
            raise ValueError(
                f"steering key {key!r} is not dataset|model__directions__regime with regimes of {VQA_PROMPTS}"
            )
        return SteeringCell.make(dataset, check_name(parts[0]), parts[1], parts[2])
