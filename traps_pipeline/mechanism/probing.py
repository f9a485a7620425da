"""Probe every pair of datasets at every layer: rows of `probes` (docs/spec.md 7).

Layers are read one at a time: at the 8B size one layer of all items takes 46 MB, all of them 1.7 GB.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from itertools import product
from typing import Any, TypeVar

import numpy as np
import pandas as pd

from traps_pipeline.base.cores import cores
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.mechanism.layer_choice import layer_choice, pair_curves
from traps_pipeline.mechanism.probes import (
    Fit,
    Split,
    auroc,
    auroc_interval,
    fit_probe,
    nearest_centroid,
    scenario_folds,
    side_swapped_labels,
    transfer_scores,
    within_split,
)
from traps_pipeline.mechanism.transfer_paths import (
    CURVES,
    LOOK_ALIKES,
    TRANSFER_PAIRS,
    Path,
    path_name,
    probed_taxonomy,
)
from traps_pipeline.protocol.datasets import DATASETS, PROBED_DATASETS, taxonomy_of
from traps_pipeline.scoring.bootstrap import scenario_weights
from traps_pipeline.storage.study import ProbeSettings

MAX_WORKERS = 4
Result = TypeVar("Result")
Row = dict[str, Any]
ReadLayer = Callable[[str, int], np.ndarray]  # dataset, layer -> states (n, d) in the order of the dataset's items


class NothingConfabulated(TrapsError):
    """Raised for a dataset without any void item that the model answered."""


@dataclass(frozen=True)
class Confabulated:
    """The scenarios whose void the model answered, by dataset, or why there are none."""

    scenarios: Mapping[str, frozenset[str]]
    problems: Mapping[str, str] = field(default_factory=dict)


def confabulated_scenarios(verdicts: pd.DataFrame, dataset: str, model: str) -> frozenset[str]:
    """Return the ids of the scenarios whose void the model is judged to have answered.

    verdicts: those of the dataset under Standard in run 1. Raises NothingConfabulated if there is no such scenario.
    """
    void = verdicts.loc[(verdicts["side"] == "void") & verdicts["abstained"].notna()]
    scenarios = frozenset(void.loc[~void["abstained"].astype(bool), "scenario_id"])
    if not scenarios:
        raise NothingConfabulated(
            f"{model} confabulated on none of the {len(void)} judged void items of {dataset} under standard: there is "
            "no Cf->Cf probe of this dataset; take more scenarios, or read the all-sample curves"
        )
    return scenarios


@dataclass
class ProbeRun:
    """The probes of one model under one VQA prompt, which return rows of PROBES.

    items: the id table, with the columns dataset, scenario_id, side and sub_scenario.
    """

    items: pd.DataFrame
    read: ReadLayer
    n_layers: int
    centroid_layer: int
    settings: ProbeSettings
    seed: int
    confabulated: Confabulated = field(default_factory=lambda: Confabulated({}))
    fit: Fit = fit_probe

    def __post_init__(self) -> None:
        if not 0 <= self.centroid_layer < self.n_layers:
            raise TrapsError(
                f"mechanism.models: centroid layer {self.centroid_layer} is out of range; there are states of layers "
                f"0 to {self.n_layers - 1}"
            )
        self._datasets = [name for name in PROBED_DATASETS if name in set(self.items["dataset"])]
        self._own = [name for name in DATASETS if name in self._datasets]
        if not self._own:
            raise TrapsError("no hidden states of any dataset; materialize hidden_states first")
        self._pairs = [pair for pair in TRANSFER_PAIRS if set(pair) <= set(self._own)]
        self._of = {name: self.items.loc[self.items["dataset"] == name] for name in self._datasets}
        taxonomies = {taxonomy: self._scenarios(taxonomy) for taxonomy in ("occlusion", "chaotic")}
        self._index = {name: taxonomies[probed_taxonomy(name)] for name in self._datasets}
        self._weights = {
            taxonomy: scenario_weights(len(index), self.settings.resamples, [self.seed, k])
            for k, (taxonomy, index) in enumerate(taxonomies.items())
        }
        self._labels = {name: (dataset_items["side"] == "void").to_numpy() for name, dataset_items in self._of.items()}
        self._places = {
            name: self._index[name].get_indexer(pd.Index(dataset_items["scenario_id"]))
            for name, dataset_items in self._of.items()
        }
        self._restricted = {
            name: np.isin(self._of[name]["scenario_id"].to_numpy(str), sorted(self.confabulated.scenarios[name]))
            for name in self._own
            if name in self.confabulated.scenarios
        }

    def _scenarios(self, taxonomy: str) -> pd.Index:
        ids = self.items.loc[self.items["dataset"].map(probed_taxonomy) == taxonomy, "scenario_id"]
        return pd.Index(sorted(ids.unique()))

    def _split(self, name: str, layer: int) -> Split:
        states = np.asarray(self.read(name, layer), float)
        if len(states) != len(self._of[name]) or states.ndim != 2 or not np.isfinite(states).all():
            raise TrapsError(
                f"hidden states of {name}, layer {layer}: {states.shape} for {len(self._of[name])} items, or not all "
                "finite; materialize hidden_states for this dataset again"
            )
        return Split(states, self._labels[name], self._places[name])

    # --- the parts of the protocol ---

    def rows(
        self, progress: Callable[[int, int], None] = lambda layers_done, total: None, *, comparable: bool = False
    ) -> list[Row]:
        """Return every row of PROBES without the columns that partition it.

        comparable: without those within a dataset and those of centroids.
        """
        rows: list[Row] = []
        of_layer = self.comparable_rows if comparable else self.layer_rows
        for layers_done, layer_rows in enumerate(each_layer(of_layer, self.n_layers), start=1):
            rows += layer_rows
            progress(layers_done, self.n_layers)
        return mark_layers(rows + self._problems())

    def layer_rows(self, layer: int) -> list[Row]:
        """Return every row of one layer; its states are in memory only during this call."""
        splits = {name: self._split(name, layer) for name in self._datasets}
        rows = self.comparable_rows(layer, splits) + self.within(layer, splits)
        return rows + (self.centroids(layer, splits) if layer == self.centroid_layer else [])

    def comparable_rows(self, layer: int, splits: Mapping[str, Split] | None = None) -> list[Row]:
        """Return one layer's rows that baselines share, from transfer to look-alikes."""
        splits = splits or {name: self._split(name, layer) for name in self._datasets}
        unseen_scores = {source: self._unseen_scores(source, splits) for source in self._own}
        rows = self.transfer(layer, splits) + self.held_out(layer, splits, unseen_scores)
        rows += self.confabulated_transfer(layer, splits) + self.confabulated_held_out(layer, splits)
        return rows + self.answerable(layer, splits, unseen_scores)

    def transfer(self, layer: int, splits: Mapping[str, Split]) -> list[Row]:
        """Return rows of the twelve ordered pairs of datasets, on all samples.

        The two datasets of a taxonomy share their control items, so that half of the rows of a cross-modality target
        were used in the fit (see `held_out`).
        """
        scores = transfer_scores(splits, self._pairs, self.fit)
        return [self._score_row("transfer", path, layer, splits[path[1]], values) for path, values in scores.items()]

    def confabulated_transfer(self, layer: int, splits: Mapping[str, Split]) -> list[Row]:
        """Return rows of transfer on the pairs whose void the model answered (Cf->Cf)."""
        confabulated_splits = self._confabulated_splits(splits)
        pairs = [pair for pair in self._pairs if set(pair) <= set(confabulated_splits)]
        scores = transfer_scores(confabulated_splits, pairs, self.fit)
        return [
            self._score_row("confabulated", path, layer, confabulated_splits[path[1]], v) for path, v in scores.items()
        ]

    def confabulated_held_out(self, layer: int, splits: Mapping[str, Split]) -> list[Row]:
        """Return rows of Cf->Cf within a taxonomy by held-out probes, null with few scenarios."""
        confabulated_splits, rows = self._confabulated_splits(splits), []
        for source, target in self._pairs:
            if not {source, target} <= set(confabulated_splits) or taxonomy_of(source) != taxonomy_of(target):
                continue
            split_pair = {name: confabulated_splits[name] for name in (source, target)}
            note = self._shortage_note(source, split_pair)
            scores = None if note else self._unseen_scores(source, split_pair)[target]
            if scores is None:
                rows.append(_row("confabulated_held_out", (source, target), layer, None, split_pair[target], note=note))
            else:
                rows.append(
                    self._score_row("confabulated_held_out", (source, target), layer, split_pair[target], scores)
                )
        return rows

    def _confabulated_splits(self, splits: Mapping[str, Split]) -> dict[str, Split]:
        return {name: splits[name].rows(mask) for name, mask in self._restricted.items()}

    def _shortage_note(self, source: str, splits: Mapping[str, Split]) -> str:
        """Return why a source's probes cannot hold out a fold of scenarios, if so."""
        n, folds = len(np.unique(splits[source].scenario)), self.settings.folds
        scenarios = np.unique(np.concatenate([split.scenario for split in splits.values()]))
        if len(scenarios) >= folds and len(np.unique(self._folds(splits)[source])) > 1:
            return ""
        return f"{path_name(*splits)}, held out: {n} confabulated voids are too few for {folds} folds of scenarios"

    def _folds(self, splits: Mapping[str, Split]) -> dict[str, np.ndarray]:
        """Return the fold of each item, by dataset; a scenario's fold is the same in all."""
        scenarios = np.unique(np.concatenate([split.scenario for split in splits.values()]))
        fold_of = dict(zip(scenarios, scenario_folds(scenarios, self.settings.folds, self.seed), strict=True))
        return {name: np.array([fold_of[s] for s in split.scenario]) for name, split in splits.items()}

    def within(self, layer: int, splits: Mapping[str, Split]) -> list[Row]:
        """Return rows of cross-validation within each dataset, with true and side-swapped labels."""
        rows = []
        for name in self._own:
            split = splits[name]
            folds = scenario_folds(split.scenario, self.settings.folds, self.seed)
            shuffled_labels = side_swapped_labels(split.void, split.scenario, self.settings.shuffles, self.seed)
            areas = within_split(split, np.column_stack([split.void, shuffled_labels]), folds)
            shuffled_areas = areas[1:]
            rows.append(_row("within", (name, name), layer, areas[0], split))
            rows.append(
                _row("shuffled", (name, name), layer, shuffled_areas.mean(), split, spread=shuffled_areas.std())
            )
        return rows

    def held_out(
        self, layer: int, splits: Mapping[str, Split], unseen: Mapping[str, Mapping[str, np.ndarray]]
    ) -> list[Row]:
        """Return rows of the dataset pairs within a taxonomy, by probes that hold out the scenario."""
        pairs = [(s, t) for s in self._own for t in self._own if taxonomy_of(s) == taxonomy_of(t)]
        return [self._score_row("held_out", (s, t), layer, splits[t], unseen[s][t]) for s, t in pairs]

    def answerable(
        self, layer: int, splits: Mapping[str, Split], unseen: Mapping[str, Mapping[str, np.ndarray]]
    ) -> list[Row]:
        """Return rows of answerable clips that resemble voids, scored by each dataset's probes.

        These are void clips with an answerable question, and whole clips as short as a void. answerable_void: AUROC of
        void items against these; 0.5 for a probe that detects what both have (an occluder, the length), 1 for a probe
        that detects that the answer cannot be known. answerable_control: AUROC of these against the controls; the
        reverse. Probes of the same taxonomy are fitted without the scored scenario.
        """
        rows = []
        for source, (extra, extra_kind) in product(self._own, LOOK_ALIKES.items()):
            if not {extra, extra_kind} <= set(splits):
                continue
            for analysis, positive, negative in (
                ("answerable_void", (extra_kind, True), (extra, None)),
                ("answerable_control", (extra, None), (extra_kind, False)),
            ):
                sides = [self._side(splits, unseen[source], *side) for side in (positive, negative)]
                labels = np.repeat([True, False], [len(values) for values, _ in sides])
                values = np.concatenate([values for values, _ in sides])
                scenario = np.concatenate([places for _, places in sides])
                split = Split(values[:, None], labels, scenario)
                rows.append(self._score_row(analysis, (source, extra), layer, split, values))
        return rows

    @staticmethod
    def _side(
        splits: Mapping[str, Split], scores: Mapping[str, np.ndarray], name: str, void: bool | None
    ) -> tuple[np.ndarray, np.ndarray]:
        mask = np.full(len(splits[name].void), True) if void is None else splits[name].void == void
        return scores[name][mask], splits[name].scenario[mask]

    def _unseen_scores(self, source: str, splits: Mapping[str, Split]) -> dict[str, np.ndarray]:
        """Return scores of every dataset's items by probes fitted without their scenarios.

        There is one probe for items of another taxonomy, and one per fold for those of the source's own.
        """
        split, same_taxonomy = splits[source], [name for name in splits if self._index[name] is self._index[source]]
        other_datasets = [name for name in splits if name not in same_taxonomy]
        scores = {name: np.empty(len(splits[name].void)) for name in same_taxonomy}
        if other_datasets:
            probe = self.fit(split.states, split.void)
            scores |= {name: probe.scores(splits[name].states) for name in other_datasets}
        folds = self._folds({name: splits[name] for name in same_taxonomy})
        for fold in range(self.settings.folds):
            train = split.rows(folds[source] != fold)
            probe = self.fit(train.states, train.void)
            for name in same_taxonomy:
                scores[name][folds[name] == fold] = probe.scores(splits[name].states[folds[name] == fold])
        return scores

    def centroids(self, layer: int, splits: Mapping[str, Split] | None = None) -> list[Row]:
        """Return rows of the shares of items that the source's nearest centroid assigns to void.

        The centroids of a taxonomy's two datasets come from the same controls, so these shares are too low for
        controls.
        """
        splits, rows = splits or {name: self._split(name, layer) for name in self._own}, []
        for source, target in self._pairs:
            is_assigned_void, split = nearest_centroid(splits[source], splits[target].states), splits[target]
            groups = self._of[target]["sub_scenario"].to_numpy(str)
            scopes = {"all": np.full(len(groups), True)}
            scopes |= {f"sub_scenario:{name}": groups == name for name in sorted(set(groups))}
            for (scope, mask), (analysis, side) in product(
                scopes.items(), (("centroid_void", True), ("centroid_control", False))
            ):
                is_selected = mask & (split.void == side)
                share = is_assigned_void[is_selected].mean() if is_selected.any() else None
                rows.append(_row(analysis, (source, target), layer, share, split.rows(mask), scope=scope))
        return rows

    def _score_row(self, analysis: str, path: Path, layer: int, of: Split, scores: np.ndarray) -> Row:
        weights = self._weights[probed_taxonomy(path[1])]
        interval = auroc_interval(of.void, scores, of.scenario, weights)
        return _row(analysis, path, layer, float(auroc(of.void, scores)), of, interval=interval)

    def _problems(self) -> list[Row]:
        """Return a row with the reason for each Cf->Cf pair without a score."""
        rows = []
        for source, target in self._pairs:
            reasons = [self.confabulated.problems[n] for n in (source, target) if n in self.confabulated.problems]
            if reasons:
                rows.append(_row("confabulated", (source, target), -1, None, note="; ".join(reasons)))
        return rows


def each_layer(work: Callable[[int], Result], n_layers: int) -> Iterator[Result]:
    """Yield the results of `work` for each layer, in order, on up to four cores.

    Each core works on one layer and holds its states in memory. Linear algebra uses one thread per layer: at these
    sizes a second thread costs more than it saves.
    """
    from threadpoolctl import threadpool_limits

    workers = min(cores(), MAX_WORKERS)
    with threadpool_limits(1), ThreadPoolExecutor(workers) as pool:
        yield from pool.map(work, range(n_layers))


def _row(
    analysis: str,
    path: Path,
    layer: int,
    value: float | None,
    of: Split | None = None,
    *,
    scope: str = "all",
    interval: tuple[float, float] | None = None,
    spread: float | None = None,
    note: str | None = None,
) -> Row:
    n_void = int(np.count_nonzero(of.void)) if of else 0
    low, high = interval or (None, None)
    numbers = {"value": value, "low": low, "high": high, "spread": spread}
    return {
        **{"analysis": analysis, "source": path[0], "target": path[1], "layer": layer, "scope": scope},
        **{name: None if number is None else float(number) for name, number in numbers.items()},
        **{"n_voids": n_void, "n_controls": len(of.void) - n_void if of else 0, "note": note},
        **{"own_best": False, "all_sample_best": False, "chosen": False},
    }


def mark_layers(rows: Sequence[Row]) -> list[Row]:
    """Return the rows of probes with marks on the layers that the report's tables show.

    own_best: the maximum of the row's own curve (the paper's choice, which uses target labels); all_sample_best: the
    maximum of the pair's all-sample transfer curve; chosen: the layer of the target without its labels
    (`layer_choice`). Of several layers with the same maximum the lowest is best.
    """
    curves: dict[tuple[str, str, str], dict[int, float]] = {}
    for row in rows:
        if row["analysis"] in CURVES and row["value"] is not None:
            key = (row["analysis"], row["source"], row["target"])
            curves.setdefault(key, {})[row["layer"]] = row["value"]
    best = {key: min(curve, key=lambda layer: (-curve[layer], layer)) for key, curve in curves.items()}
    curve_of = pair_curves(rows)
    targets = {row["target"] for row in rows if row["analysis"] in CURVES}
    layers = {target: layer_choice(curve_of, target).layer for target in targets} if curve_of else {}
    return [
        row
        if row["analysis"] not in CURVES
        else row
        | {
            "own_best": best.get((row["analysis"], row["source"], row["target"])) == row["layer"],
            "all_sample_best": best.get(("transfer", row["source"], row["target"])) == row["layer"],
            "chosen": layers.get(row["target"]) == row["layer"],
        }
        for row in rows
    ]
