"""Compute the partitions that a study's experiments want of its scenarios.

Partition keys, `traps run`, `traps status`, Dagster's buttons and its automation all use this module, so nothing asks a
model that no experiment of the study names.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from functools import cached_property
from itertools import product

from traps_pipeline.benchmark.corrections import categories_of, load_scenarios, load_two_events
from traps_pipeline.models.local.capture import OF_PAIRS
from traps_pipeline.models.registry.entries import get_model, load_models, local_models
from traps_pipeline.protocol.cells import Cell, Evaluation, Extraction, StatesCell, SteeringCell
from traps_pipeline.protocol.datasets import (
    ALL_CATEGORIES,
    ANSWERABLE,
    CATEGORIES,
    DATASETS,
    EXTRACTED,
    PROBED_ARMS,
    TWO_EVENTS,
    UNPAIRED,
    all_datasets_of,
)
from traps_pipeline.protocol.regimes import GUIDED, PROBE_PROMPT, RANDOM_WEIGHTS, REGIMES, VQA_PROMPTS
from traps_pipeline.storage.benchmark_tables import SCENE_SPECS
from traps_pipeline.storage.study import Asked, MechanismSettings
from traps_pipeline.storage.workspace import Workspace


class StudyPartitions:
    """The wanted partition keys of every asset of a study, in key order.

    workspace: None for everything in the registry. experiment: limit the keys to this experiment of the study.
    """

    def __init__(self, workspace: Workspace | None, experiment: str | None = None) -> None:
        self._workspace = workspace
        if workspace is None:
            all_asked = Asked(
                datasets=(*DATASETS, *UNPAIRED), models=tuple(load_models()), regimes=REGIMES, runs=(), mechanism=True
            )
            self._asked: Sequence[Asked] = [all_asked]
        else:
            self._asked = [e for name, e in workspace.study.experiments.items() if experiment in (None, name)]

    def of(self, experiment: str | None) -> StudyPartitions:
        """Return the wanted keys of one experiment of the study; None: of all."""
        is_all = experiment is None or self._workspace is None or [*self._workspace.study.experiments] == [experiment]
        return self if is_all else StudyPartitions(self._workspace, experiment)

    @cached_property
    def categories(self) -> list[str]:
        """The names of categories with scenarios, or with a table made before all these were discarded."""
        if self._workspace is None:
            return [*CATEGORIES]
        existing = {part["category"] for part in self._workspace.tables.partitions(SCENE_SPECS)}
        return [c for c in ALL_CATEGORIES if c in existing or c in self._present]

    @cached_property
    def _present(self) -> list[str]:
        if self._workspace is None:
            return [*CATEGORIES]
        study = self._workspace.study
        return categories_of({**load_scenarios(study), **load_two_events(study)})

    @cached_property
    def datasets(self) -> list[str]:
        """The names of the datasets that have scenarios and that experiments ask."""
        return self._datasets(self._asked)

    @cached_property
    def arms(self) -> list[str]:
        """The names of the arms and variations among `datasets`."""
        return [dataset for dataset in self.datasets if dataset in UNPAIRED]

    @cached_property
    def has_pairs(self) -> bool:
        """Whether any of `datasets` consists of pairs: arms alone have no leaderboard."""
        return bool({*self.datasets} & {*DATASETS})

    def _datasets(self, experiments: Iterable[Asked]) -> list[str]:
        possible_datasets = {dataset for category in self._present for dataset in all_datasets_of(category)}
        asked_datasets = {dataset for experiment in experiments for dataset in experiment.datasets}
        return [dataset for dataset in (*DATASETS, *UNPAIRED) if dataset in possible_datasets & asked_datasets]

    @cached_property
    def evaluations(self) -> list[Evaluation]:
        """Every requested model, regime and run, in the registry's order."""
        asked_evaluations = {e for experiment in self._asked for e in evaluations_of(experiment)}
        place = {model: number for number, model in enumerate(load_models())}
        return sorted(asked_evaluations, key=lambda e: (place[e.model], REGIMES.index(e.regime), e.run))

    @cached_property
    def cells(self) -> list[str]:
        """The keys of the requested cells: a dataset, and a model under a regime in a run."""
        asked_cells = {
            Cell(dataset, evaluation).key
            for experiment in self._asked
            for dataset in self._datasets([experiment])
            for evaluation in evaluations_of(experiment)
        }
        all_cells = (Cell(dataset, evaluation).key for dataset, evaluation in product(self.datasets, self.evaluations))
        return [key for key in all_cells if key in asked_cells]

    # --- inside local models ------------------------------------------------------------------------------------------

    @cached_property
    def _mechanism(self) -> tuple[list[str], MechanismSettings | None] | None:
        """Datasets (no arms) and settings of mechanistic analyses, or None without any."""
        if self._workspace is None:
            return [*DATASETS], None
        settings = self._workspace.study.mechanism
        experiments = [experiment for experiment in self._asked if experiment.mechanism]
        datasets = [dataset for dataset in self._datasets(experiments) if dataset in DATASETS]
        return (datasets, settings) if experiments and settings else None

    @cached_property
    def has_mechanism(self) -> bool:
        """Whether any mechanistic analysis is requested."""
        return self._mechanism is not None

    @cached_property
    def steers(self) -> bool:
        """Whether any experiment of the study steers models."""
        return self._mechanism is not None and (self._mechanism[1] is None or self._mechanism[1].steering is not None)

    @cached_property
    def patched_prompt(self) -> str | None:
        """The VQA prompt under which activations are patched; None without patching."""
        if self._mechanism is None:
            return None
        settings = self._mechanism[1]
        if settings is None:
            return PROBE_PROMPT
        return settings.patching.prompt if settings.patching else None

    @cached_property
    def has_sentences(self) -> bool:
        """Whether log-probabilities of abstentions are computed."""
        return self._mechanism is not None and (self._mechanism[1] is None or bool(self._mechanism[1].sentences))

    @cached_property
    def probed(self) -> list[str]:
        """The names of the datasets whose hidden states are extracted."""
        datasets = self._mechanism[0] if self._mechanism else []
        asked_datasets = self._datasets(experiment for experiment in self._asked if experiment.mechanism)
        existing = {*datasets, *(arm for arm in PROBED_ARMS if self._mechanism and arm in asked_datasets)}
        existing |= {ANSWERABLE} if "occlusion" in existing else set()
        settings = self._mechanism[1] if self._mechanism else None
        if datasets and not (settings and settings.pooling in OF_PAIRS):  # their layer is chosen on pairs
            existing |= {TWO_EVENTS} & {*asked_datasets}
        return [d for d in EXTRACTED if d in existing]

    @cached_property
    def extractions(self) -> list[Extraction]:
        """Local models under the VQA prompts for which states are extracted."""
        if self._mechanism is None:
            return []
        settings = self._mechanism[1]
        models = local_models() if settings is None else [*settings.models]
        prompts = settings.prompts if settings else VQA_PROMPTS
        return [
            Extraction(model, prompt)
            for model in models
            for prompt in (*prompts, *(RANDOM_WEIGHTS if get_model(model).has_random_weights else ()))
        ]

    @cached_property
    def states(self) -> list[str]:
        """The keys of hidden_states; datasets that are no pairs serve only probes."""
        cells = [StatesCell(d, e) for d, e in product(self.probed, self.extractions)]
        read = {d: (GUIDED if d == TWO_EVENTS else PROBE_PROMPT, *RANDOM_WEIGHTS) for d in self.probed}
        return [c.key for c in cells if c.dataset in DATASETS or c.extraction.prompt in read[c.dataset]]

    @cached_property
    def probed_prompts(self) -> tuple[str, ...]:
        """The names of VQA prompts whose states probes are fitted on, and of extractions of random weights."""
        settings = self._mechanism[1] if self._mechanism else None
        return (*(settings.probes.prompts if settings else (PROBE_PROMPT,)), *RANDOM_WEIGHTS)

    @cached_property
    def steered(self) -> list[str]:
        """The keys `model__directionregime__inferenceregime` of every steered evaluation."""
        if self._mechanism is None or not self.steers:
            return []
        settings = self._mechanism[1]
        if settings is None:
            runs = product(local_models(), VQA_PROMPTS, VQA_PROMPTS)
        else:
            assert settings.steering is not None, "`steers` says so"
            runs = product(settings.models, settings.steering.direction_regimes, settings.steering.inference_regimes)
        return ["__".join(run) for run in runs]

    @cached_property
    def steering(self) -> list[str]:
        """The keys of the steering cells."""
        datasets = self._mechanism[0] if self._mechanism else []
        return [SteeringCell.parse(f"{dataset}|{run}").key for dataset, run in product(datasets, self.steered)]


def evaluations_of(experiment: Asked) -> list[Evaluation]:
    """Return an experiment's models under its regimes in its runs (default: all that a model has)."""
    evaluations = []
    for model in experiment.models:
        available = range(1, get_model(model).runs + 1)
        runs = [run for run in available if not experiment.runs or run in experiment.runs]
        evaluations += [Evaluation(model, regime, run) for regime in experiment.regimes for run in runs]
    return evaluations
