"""Compare what states tell of a dataset with what rivals (inputs, output) tell, by probes of other datasets.

A rival is anything else that the same probe can be fitted on: the question's words, pixels, the clip's length, or the
model's own output. Subjects beside the model are its controls: the same network with random weights, and placebos,
which are answerable items (`LOOK_ALIKES`) in the place of a dataset's voids. What also holds of them is no knowledge of
the model's, or none of what cannot be known.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd

from traps_pipeline.base import progress
from traps_pipeline.mechanism.baselines import MARGIN, RAW, Features, output_or_note, probed_items, raw_features
from traps_pipeline.mechanism.control_rows import MODEL, RESIDUAL, STATES, LeadRow
from traps_pipeline.mechanism.gate import OTHER_DATASETS, GateItems, sources_of_gate, unseen_scores
from traps_pipeline.mechanism.gating import chosen_layers, gate_items, gate_table
from traps_pipeline.mechanism.probes import auroc, auroc_draws, auroc_interval
from traps_pipeline.mechanism.stored_states import StoredStates
from traps_pipeline.mechanism.transfer_paths import LOOK_ALIKES
from traps_pipeline.models.registry.entries import ModelEntry
from traps_pipeline.protocol.cells import Extraction
from traps_pipeline.protocol.datasets import DATASETS
from traps_pipeline.scoring.bootstrap import scenario_weights
from traps_pipeline.storage.workspace import Workspace

NUISANCES = ("question words", "all frames", "length")
COMPONENTS = 32  # principal components of these that are regressed out of states


@dataclass(frozen=True, eq=False)
class Subject:
    """A model or one of its controls (placebos, random weights), with its states and other features.

    targets: the datasets that are scored. voids: by target, the dataset whose items stand for its voids.
    """

    name: str
    states: StoredStates
    output: Mapping[str, Features]
    targets: Sequence[str]
    voids: Mapping[str, str]


def lead_rows(workspace: Workspace, entry: ModelEntry, states: StoredStates) -> list[LeadRow]:
    """Return LEADS rows of a model: each subject and target, by states and by every rival."""
    assert entry.media is not None, "local entries have media"
    table, names = gate_table(states), [*dict.fromkeys(states.items["dataset"])]
    raw = raw_features({n: probed_items(workspace, states, n) for n in names}, entry.media, workspace.resolve)
    components = nuisance_components([stacked(table, raw[name]) for name in NUISANCES])
    rows: list[LeadRow] = []
    for subject in subjects(workspace, entry, states):
        layers = chosen_layers(workspace, subject.states, subject.targets)
        for target in subject.targets:
            progress.current().tick("leads", f"{subject.name} of {states.extraction.key}: {target}", 1, 1)
            vectors = stacked(table, {name: subject.states.read_as(states, name, layers[target]) for name in names})
            features = {STATES: vectors, RESIDUAL: residual(vectors, components)}
            features |= {name: stacked(table, raw[name]) for name in RAW}
            features |= {name: stacked(table, values) for name, values in subject.output.items()}
            rows += _target_rows(workspace, states.extraction, table, subject, target, layers[target], features)
    return rows


def subjects(workspace: Workspace, entry: ModelEntry, states: StoredStates) -> Iterator[Subject]:
    """Yield the model, its placebos, and the network with random weights where the study has its states."""
    names = [*dict.fromkeys(states.items["dataset"])]
    datasets = [name for name in DATASETS if name in names]
    targets = [name for name in datasets if sources_of_gate(OTHER_DATASETS, name, datasets)]
    output = output_or_note("leads", entry, states, states, names)
    yield Subject(MODEL, states, output, targets, {})
    for placebo, target in LOOK_ALIKES.items():
        if placebo in names and target in targets:
            yield Subject(placebo, states, output, [target], {target: placebo})
    for random in StoredStates.of_random(workspace, entry.id):
        yield Subject(
            random.extraction.prompt, random, output_or_note("leads", entry, random, states, names), targets, {}
        )


def stacked(table: pd.DataFrame, features: Features) -> np.ndarray:
    """Return features (n, d) in the order of the table's rows."""
    return gate_items(table, features, shuffled=False, seed=0).features


def nuisance_components(blocks: Sequence[np.ndarray]) -> np.ndarray:
    """Return the leading principal components (n, k) of blocks (n, d) of equal total variance."""
    centred = [block - block.mean(axis=0) for block in blocks]
    gram = np.sum([part @ part.T / max(float((part**2).sum()), 1e-12) for part in centred], axis=0)
    values, vectors = np.linalg.eigh(gram)
    return vectors[:, ::-1][:, : min(COMPONENTS, len(gram) // 4, int((values > 1e-9 * values[-1]).sum()))]


def residual(states: np.ndarray, components: np.ndarray) -> np.ndarray:
    """Return states (n, d) without what is linear in orthonormal components (n, k) and a constant."""
    centred = states - states.mean(axis=0)
    return centred - components @ (components.T @ centred)


def _target_rows(
    workspace: Workspace,
    extraction: Extraction,
    table: pd.DataFrame,
    subject: Subject,
    target: str,
    layer: int,
    features: Mapping[str, np.ndarray],
) -> Iterator[LeadRow]:
    settings = workspace.mechanism
    mask, table = placed(table, target, subject.voids.get(target))
    is_target = (table["dataset"] == target).to_numpy()
    void, scenario = table["void"].to_numpy(bool)[is_target], pd.factorize(table.loc[is_target, "scenario_id"])[0]
    weights = scenario_weights(scenario.max() + 1, settings.probes.resamples, settings.seed)
    scores = {
        name: values[mask][is_target, 0]
        if name == MARGIN
        else unseen_scores(GateItems(table, values[mask]), OTHER_DATASETS, target, settings.probes.folds, settings.seed)
        for name, values in features.items()
    }
    areas = {name: float(auroc(void, values)) for name, values in scores.items()}
    rival = max((name for name in areas if name not in (STATES, RESIDUAL)), key=lambda name: areas[name])
    draws = {name: auroc_draws(void, scores[name], scenario, weights) for name in (STATES, rival)}
    lead_low, lead_high = (float(end) for end in np.nanquantile(draws[STATES] - draws[rival], [0.025, 0.975]))
    for name, values in scores.items():
        low, high = auroc_interval(void, values, scenario, weights)
        is_states = name == STATES
        yield LeadRow(
            **extraction.partition,
            subject=subject.name,
            target=target,
            features=name,
            layer=layer if name in (STATES, RESIDUAL) else -1,
            auroc=areas[name],
            low=low,
            high=high,
            rival=rival if is_states else None,
            lead=areas[STATES] - areas[rival] if is_states else None,
            lead_low=lead_low if is_states else None,
            lead_high=lead_high if is_states else None,
            n_voids=int(void.sum()),
            n_controls=int((~void).sum()),
        )


def placed(table: pd.DataFrame, target: str, placebo: str | None) -> tuple[np.ndarray, pd.DataFrame]:
    """Return a mask of the items of pairs, and their table; a placebo's items replace a target's voids."""
    dataset, void = table["dataset"].to_numpy(str), table["void"].to_numpy(bool)
    mask = np.isin(dataset, DATASETS)
    if placebo is not None:
        mask = (mask & ~((dataset == target) & void)) | (dataset == placebo)
        void, dataset = void | (dataset == placebo), np.where(dataset == placebo, target, dataset)
    return mask, table.assign(dataset=dataset, void=void).loc[mask].reset_index(drop=True)
