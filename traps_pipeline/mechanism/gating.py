"""Build GATE rows from stored states and verdicts."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import product
from typing import Any

import numpy as np
import pandas as pd

from traps_pipeline.base import progress
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.judging.judging_rows import VERDICTS
from traps_pipeline.mechanism.baselines import output_or_note, probed_items, raw_features
from traps_pipeline.mechanism.control_rows import STATES, GateRow
from traps_pipeline.mechanism.gate import (
    OTHER_DATASETS,
    SOURCES,
    THRESHOLDS,
    Decisions,
    GateItems,
    Outcomes,
    families,
    gate_answers,
    gate_auroc,
    sources_of_gate,
)
from traps_pipeline.mechanism.layer_choice import layer_choice, pair_curves
from traps_pipeline.mechanism.mechanism_rows import PROBES
from traps_pipeline.mechanism.nulls import nan_to_null
from traps_pipeline.mechanism.probes import side_swapped_labels
from traps_pipeline.mechanism.stored_states import StoredStates
from traps_pipeline.mechanism.transfer_paths import probed_taxonomy
from traps_pipeline.models.registry.entries import ModelEntry
from traps_pipeline.protocol.cells import Cell, Evaluation
from traps_pipeline.protocol.datasets import DATASETS
from traps_pipeline.protocol.regimes import PROMPTING
from traps_pipeline.scoring.bootstrap import RESAMPLED_METRICS, draw_scenarios, interval, metrics_of, run_sums
from traps_pipeline.scoring.metrics import COUNTS
from traps_pipeline.storage.workspace import Workspace

SHUFFLED = "shuffled labels"
ALL = "all"
_PECS = RESAMPLED_METRICS.index("pecs")


@dataclass(frozen=True)
class Gates:
    """Features that gates may read, and the datasets on which each gate is fitted.

    by_layer: by layer of the states (-1 for other features), then by dataset, (n, d). layers: the layer of each target;
    none for other features.
    """

    name: str
    by_layer: Mapping[int, Mapping[str, np.ndarray]]
    sources: Sequence[str]
    layers: Mapping[str, int] = field(default_factory=dict)


Gated = dict[tuple[str, str], tuple[Decisions, int]]  # source and target -> decisions, and layer of the states
DecisionsByTarget = Mapping[str, tuple[Decisions, int]]  # target -> decisions and layer


def gate_rows(workspace: Workspace, entry: ModelEntry, states: StoredStates) -> list[GateRow]:
    """Return GATE rows of an extraction, for each regime of run 1. Raises TrapsError without verdicts."""
    settings, rows = workspace.mechanism, list[GateRow]()
    outcomes = {
        regime: regime_outcomes
        for regime in PROMPTING
        if (regime_outcomes := outcomes_of(workspace, entry.id, regime, states)) is not None
    }
    if not outcomes:
        raise TrapsError(
            f"gate {states.extraction.key}: {entry.id} has no verdicts under {' or '.join(PROMPTING)} in run 1; the "
            "experiment must ask the model under one of these regimes"
        )
    layers = chosen_layers(workspace, states, dict.fromkeys(states.items["dataset"]))
    table, kinds = gate_table(states), [*_kinds(workspace, entry, states, layers)]
    for number, gates in enumerate(kinds, start=1):
        progress.current().tick("gate", f"features of {states.extraction.key}", number, len(kinds))
        gated = _decisions(workspace, table, gates)
        for regime, source in product(outcomes, gates.sources):
            decided = {target: decisions for (name, target), decisions in gated.items() if name == source}
            about, resamples = (gates.name, regime, source), settings.probes.resamples
            rows += _rows(states, about, decided, outcomes[regime], resamples, settings.seed)
    return rows


def gate_table(states: StoredStates) -> pd.DataFrame:
    """Return the items that the abstention gate reads as a frame, in the order of their hidden states."""
    items = states.items
    id_columns = pd.DataFrame(items[["dataset", "scenario_id", "item_id"]])
    table = id_columns.assign(family=families(items), prompt=items["states_key"])
    return table.astype(object).assign(void=items["side"] == "void")  # Arrow's strings are slow to select from


def chosen_layers(workspace: Workspace, states: StoredStates, targets: Iterable[str]) -> dict[str, int]:
    """Return the layer at which each target's gate reads hidden states, chosen without its labels."""
    rows = workspace.tables.read(PROBES, states.extraction.partition).to_dict("records")
    curves = pair_curves({str(name): value for name, value in row.items()} for row in rows)
    return {target: layer_choice(curves, target).layer for target in targets}


def _kinds(workspace: Workspace, entry: ModelEntry, states: StoredStates, layers: Mapping[str, int]) -> Iterator[Gates]:
    """Yield states by every source, and control features by sources of many datasets."""
    names = [*dict.fromkeys(states.items["dataset"])]
    states_by_layer = {layer: read_states(states, names, layer) for layer in sorted({*layers.values()})}
    yield Gates(STATES, states_by_layer, SOURCES, layers)
    controls = (OTHER_DATASETS,)
    assert entry.media is not None, "local entries have media"
    items = {name: probed_items(workspace, states, name) for name in names}
    for name, features in raw_features(items, entry.media, workspace.resolve).items():
        yield Gates(name, {-1: features}, controls)
    for name, features in output_or_note("gate", entry, states, states, names).items():
        yield Gates(name, {-1: features}, controls)
    yield Gates(SHUFFLED, states_by_layer, controls, layers)
    for random in StoredStates.of_random(workspace, entry.id):
        own_layers = chosen_layers(workspace, random, names)
        by_layer = {n: {d: random.read_as(states, d, n) for d in names} for n in sorted({*own_layers.values()})}
        yield Gates(random.extraction.prompt, by_layer, controls, own_layers)


def read_states(states: StoredStates, names: Sequence[str], layer: int) -> dict[str, np.ndarray]:
    """Return the states of some datasets at a layer, (n, d) each."""
    return {name: states.read(name, layer) for name in names}


def _decisions(workspace: Workspace, table: pd.DataFrame, gates: Gates) -> Gated:
    """Return decisions and states' layer (-1 for other features), by source, target."""
    settings, seed = workspace.mechanism, workspace.mechanism.seed
    settings_of_gate = {"folds": settings.probes.folds, "seed": seed, "false_abs": settings.gate.false_abs}
    decisions: Gated = {}
    items_of = {
        layer: gate_items(table, features, gates.name == SHUFFLED, seed) for layer, features in gates.by_layer.items()
    }
    datasets = [name for name in DATASETS if name in set(table["dataset"])]
    for source, target in product(gates.sources, dict.fromkeys(table["dataset"])):
        if not sources_of_gate(source, str(target), datasets):
            continue  # a study without all datasets has fewer gates
        layer = gates.layers.get(str(target), -1)
        decision = gate_answers(items_of[layer], source, str(target), **settings_of_gate)
        if np.isfinite(decision.score).any():
            decisions[source, str(target)] = decision, layer
    return decisions


def gate_items(table: pd.DataFrame, features: Mapping[str, np.ndarray], shuffled: bool, seed: int) -> GateItems:
    """Return the items of a table with features; if shuffled, scenarios swap sides at random."""
    values = np.empty((len(table), next(iter(features.values())).shape[1]))
    for name, rows in features.items():
        values[(table["dataset"] == name).to_numpy()] = rows
    if shuffled:
        void = side_swapped_labels(table["void"].to_numpy(), pd.factorize(table["scenario_id"])[0], 1, seed)[:, 0]
        table = table.assign(void=void)
    return GateItems(table, values)


def outcomes_of(workspace: Workspace, model: str, regime: str, states: StoredStates) -> dict[str, Outcomes] | None:
    """Return a model's outcomes by dataset in the order of its states; None without any verdict.

    The verdicts are those of the four datasets that have states. Items without verdicts (those that no model is asked)
    are undecided.
    """
    outcomes: dict[str, Outcomes] = {}
    judged = False
    for dataset in dict.fromkeys(states.items["dataset"]):
        items = states.dataset(dataset)
        cell = Cell(dataset, Evaluation(model, regime, 1))
        rows = pd.DataFrame(columns=["item_id", "correct", "abstained"])
        if workspace.tables.state(VERDICTS, cell.partition) is not None:
            rows = workspace.tables.read(VERDICTS, cell.partition)
            judged |= dataset in DATASETS
        rows = rows.set_index("item_id").reindex(items["item_id"])
        correct, abstained = (
            rows[name].astype("Float64").to_numpy(float, na_value=np.nan) for name in ("correct", "abstained")
        )
        outcomes[dataset] = Outcomes((items["side"] == "void").to_numpy(), correct, abstained)
    return outcomes if judged else None


def _rows(
    states: StoredStates,
    about: tuple[str, str, str],
    decided: DecisionsByTarget,
    outcomes: Mapping[str, Outcomes],
    resamples: int,
    seed: int,
) -> list[GateRow]:
    """Return a gate's rows on every target, and over the four datasets. about: features, regime and source."""
    rows: list[GateRow] = []
    names = states.items["scenario_id"].to_numpy(str)
    for threshold in THRESHOLDS:
        dataset_metrics: list[dict[str, float]] = []
        draws: list[np.ndarray] = []
        for target, (decisions, layer) in decided.items():
            outcome = outcomes[target]
            gate = decisions.score > decisions.threshold[threshold]
            gated_outcomes = outcome.gated(gate)
            values = gated_outcomes.metrics()
            if target not in DATASETS:  # what the gate alone would do to items that must be answered
                values = dict.fromkeys(values, np.nan)
                values["false_abs"] = float(gate[~outcome.void].mean()) if (~outcome.void).any() else np.nan
            values |= {f"plain_{name}": value for name, value in outcome.metrics().items()}
            values |= {"expected_false_abs": float(decisions.expected[threshold].mean())}
            about_pecs = interval(np.full((2, 1), np.nan), np.nan, (0.0, 1.0))
            if target in DATASETS:
                sums = _resample(gated_outcomes, target, names[decisions.place], resamples, seed)
                about_pecs = interval(metrics_of(sums)[:, _PECS, 1:], values["pecs"], (0.0, 1.0))
                dataset_metrics.append(values)
                draws.append(metrics_of(sums, in_mean=True)[:, _PECS, 1:])
            area = gate_auroc(decisions, outcome.void)
            sides = int((~outcome.void).sum()), int(outcome.void.sum())
            rows.append(_row(states, (*about, threshold, target), layer, area, values, about_pecs, sides))
        if len(dataset_metrics) == len(DATASETS):
            means = {name: float(np.mean([scores[name] for scores in dataset_metrics])) for name in dataset_metrics[0]}
            sides = [
                sum(getattr(r, name) for r in rows[-len(decided) :] if r.target in DATASETS)
                for name in ("n_controls", "n_voids")
            ]
            layers = {layer for target, (_, layer) in decided.items() if target in DATASETS}
            layer = layers.pop() if len(layers) == 1 else -1
            about_pecs = interval(np.mean(draws, axis=0), means["pecs"], (0.0, 1.0))
            rows.append(_row(states, (*about, threshold, ALL), layer, np.nan, means, about_pecs, (sides[0], sides[1])))
    return rows


def _resample(outcomes: Outcomes, target: str, scenarios: np.ndarray, resamples: int, seed: int) -> np.ndarray:
    """Return resampled sums, (9, 1 + resamples), with one scenario unseen; datasets of a taxonomy share resamples."""
    scenario_columns = {"dataset": target, "run": 1, "scenario_id": scenarios, "taxonomy": probed_taxonomy(target)}
    items = pd.DataFrame(outcomes.counts(), columns=pd.Index(COUNTS)).assign(**scenario_columns)
    return run_sums(items, draw_scenarios(items, resamples, seed), "gate")[target, 1]


def _row(
    states: StoredStates,
    about: tuple[str, str, str, str, str],
    layer: int,
    area: float,
    values: Mapping[str, float],
    about_pecs: np.ndarray,
    sides: tuple[int, int],
) -> GateRow:
    low, high = about_pecs
    metrics = {**values, "auroc": area, "pecs_low": float(low), "pecs_high": float(high)}
    row_keys: dict[str, Any] = dict(zip(("features", "regime", "source", "threshold", "target"), about, strict=True))
    return GateRow(
        **states.joined, **row_keys, **nan_to_null(metrics), layer=layer, n_controls=sides[0], n_voids=sides[1]
    )
