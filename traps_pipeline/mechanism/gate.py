"""Gate answers: a linear probe of hidden states decides whether an answer is kept or becomes an abstention.

The paper's probes find that states separate what can be known from what cannot, while answers do not. A gate uses that:
if the probe's score is above a threshold, the answer becomes an abstention. No call is made and no answer is judged
again: a gated answer is an abstention, and every other answer keeps its verdict.

No gate has seen the scenario that it decides about, in its fit or in its threshold. Its source says what else it has
not seen: `one:DATASET` (fitted on one dataset), `other datasets` (all but the target) and `other families` (no scenario
of the target's family in any dataset).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import pandas as pd

from traps_pipeline.base.errors import TrapsError
from traps_pipeline.mechanism.probes import Scorer, auroc, fit_probe, scenario_folds
from traps_pipeline.mechanism.transfer_paths import probed_taxonomy
from traps_pipeline.protocol.datasets import DATASETS
from traps_pipeline.scoring.metrics import pecs_of

MID, J, CONFORMAL = THRESHOLDS = ("mid", "J", "conformal")
OTHER_DATASETS, OTHER_FAMILIES = "other datasets", "other families"
SOURCES = (*(f"one:{name}" for name in DATASETS), OTHER_DATASETS, OTHER_FAMILIES)
NO_THRESHOLD = float("inf")  # threshold above every score


# A probe, its thresholds, and the shares of calibrating controls above each.
FittedGate = tuple[Scorer, dict[str, float], dict[str, float]]


@dataclass(frozen=True, eq=False)
class GateItems:
    """The items that a gate is fitted on or applied to, with their features.

    table: rows with dataset, scenario_id, family, prompt (equal for items with the same prompt) and void (bool).
    features: (n, d), rows in the same order. fitted: the gates fitted on some of these rows, which several targets
    share.
    """

    table: pd.DataFrame
    features: np.ndarray
    fitted: dict[object, FittedGate] = field(default_factory=dict)

    def rows(self, chosen: np.ndarray) -> GateItems:
        """Return the items that a boolean mask selects, with their features."""
        return GateItems(self.table.loc[chosen].reset_index(drop=True), self.features[chosen])

    @property
    def void(self) -> np.ndarray:
        """Whether each item is a void, (n,) bool."""
        return self.table["void"].to_numpy(bool)


@dataclass(frozen=True, eq=False)
class Decisions:
    """A gate's decisions about some items.

    place: (n,) rows of the items' table. score: (n,) log-odds of void. threshold: by name, (n,). expected: by name,
    (n,) share of the calibrating controls above the threshold.
    """

    place: np.ndarray
    score: np.ndarray
    threshold: Mapping[str, np.ndarray]
    expected: Mapping[str, np.ndarray]


def thresholds(score: np.ndarray, void: np.ndarray, false_abs: float) -> dict[str, float]:
    """Return by name the thresholds that scores and labels, (n,) each, of calibrating items give.

    A score above a threshold is gated. mid: half-way between the mean scores of voids and of controls. J: the cut with
    the largest AbsRec - FalseAbs, half-way to the next score. conformal: the smallest control score that at most a
    share `false_abs` of new controls from the same source exceeds, in expectation over sources (split conformal
    prediction: rank ceil((n + 1)(1 - false_abs)) of n); with too few controls for that (18 at 0.05), no answer is
    gated.
    """
    control = np.sort(score[~void])
    midpoint = (score[void].mean() + control.mean()) / 2
    levels = np.unique(score)
    cuts = np.concatenate([[levels[0] - 1], (levels[1:] + levels[:-1]) / 2, [NO_THRESHOLD]])
    j_of_cuts = [(score[void] > cut).mean() - (control > cut).mean() for cut in cuts]
    rank = int(np.ceil((len(control) + 1) * (1 - false_abs) - 1e-9))
    conformal = float(control[rank - 1]) if rank <= len(control) else NO_THRESHOLD
    return {MID: float(midpoint), J: float(cuts[int(np.argmax(j_of_cuts))]), CONFORMAL: conformal}


def sources_of_gate(source: str, target: str, datasets: Sequence[str] = DATASETS) -> list[str]:
    """Return the names of the datasets that a gate of a source is fitted on for a target."""
    if source == OTHER_DATASETS:
        return [name for name in datasets if name != target]
    return [name for name in datasets if source in (OTHER_FAMILIES, f"one:{name}")]


def gate_answers(items: GateItems, source: str, target: str, *, folds: int, seed: int, false_abs: float) -> Decisions:
    """Return the decisions of a source's gates about every item of a dataset.

    A gate is fitted for each fold of the target's scenarios (each family, for `other families`) on source items of all
    other scenarios. Its thresholds come from cross-validated scores of those same source items, so that they are scores
    of unseen items too; items with the same prompt count once. Raises TrapsError for a source without items.
    """
    target_rows = np.flatnonzero(items.table["dataset"].to_numpy(str) == target)
    score = np.full(len(target_rows), np.nan)
    cut = {name: np.full(len(target_rows), NO_THRESHOLD) for name in THRESHOLDS}
    expected = {name: np.zeros(len(target_rows)) for name in THRESHOLDS}
    for is_in_fold, is_training in _each_fold(items, source, target, folds, seed):
        key = (is_training.tobytes(), folds, seed, false_abs)
        if key not in items.fitted:
            items.fitted[key] = fit_gate(items.rows(is_training), folds, seed, false_abs)
        probe, cuts, shares = items.fitted[key]
        score[is_in_fold] = probe.scores(items.features[target_rows[is_in_fold]])
        for name in THRESHOLDS:
            cut[name][is_in_fold], expected[name][is_in_fold] = cuts[name], shares[name]
    return Decisions(target_rows, score, cut, expected)


def unseen_scores(items: GateItems, source: str, target: str, folds: int, seed: int) -> np.ndarray:
    """Return the log-odds (n,) of a dataset's items by the probes of `gate_answers`, without thresholds."""
    target_features = items.features[items.table["dataset"].to_numpy(str) == target]
    score = np.full(len(target_features), np.nan)
    for is_in_fold, is_training in _each_fold(items, source, target, folds, seed):
        probe = fit_probe(items.features[is_training], items.void[is_training])
        score[is_in_fold] = probe.scores(target_features[is_in_fold])
    return score


def _each_fold(
    items: GateItems, source: str, target: str, folds: int, seed: int
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yield which of a target's items a gate decides, and which items it is fitted on."""
    targets = items.table["dataset"].to_numpy(str)
    is_source = np.isin(targets, sources_of_gate(source, target))
    if not is_source.any():
        raise TrapsError(f"a gate from {source} has no items; extract the hidden states of its datasets first")
    groups = items.table["family" if source == OTHER_FAMILIES else "scenario_id"].to_numpy(str)
    target_groups = groups[targets == target]
    for fold in _held_out_groups(target_groups, source, folds, seed):
        is_training = is_source & ~np.isin(groups, fold)
        if len(set(items.void[is_training])) == 2:
            yield np.isin(target_groups, fold), is_training


def fit_gate(train: GateItems, folds: int, seed: int, false_abs: float) -> FittedGate:
    """Return a gate's probe, thresholds, and shares of controls above these; both sides need two scenarios."""
    probe = fit_probe(train.features, train.void)
    calibration_scores, void = _own_scores(train, folds, seed)
    cuts = thresholds(calibration_scores, void, false_abs)
    return probe, cuts, {name: float((calibration_scores[~void] > cut).mean()) for name, cut in cuts.items()}


def _held_out_groups(groups: np.ndarray, source: str, folds: int, seed: int) -> Iterator[np.ndarray]:
    """Yield the groups of scored items to hold out, one gate after another."""
    names = np.unique(groups)
    if source == OTHER_FAMILIES or len(names) < folds:
        yield from (names[k : k + 1] for k in range(len(names)))
        return
    fold = scenario_folds(names, folds, seed)
    yield from (names[fold == k] for k in range(folds))


def _own_scores(train: GateItems, folds: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Return held-out scores, by scenario, and labels of the distinct prompts."""
    fold = scenario_folds(train.table["scenario_id"].to_numpy(str), folds, seed)
    score = np.full(len(fold), np.nan)
    for k in range(folds):
        other_folds = train.rows(fold != k)
        if len(set(other_folds.void)) == 2:
            score[fold == k] = fit_probe(other_folds.features, other_folds.void).scores(train.features[fold == k])
    first = ~train.table.duplicated(["prompt"]).to_numpy() & np.isfinite(score)
    return score[first], train.void[first]


# --- what gating does to an evaluation --------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Outcomes:
    """Verdicts (n,): void; correct (of controls) and abstained, NaN if undecided."""

    void: np.ndarray
    correct: np.ndarray
    abstained: np.ndarray

    def gated(self, gate: np.ndarray) -> Outcomes:
        """Return the outcomes after a gate (n,) bool; a gated answer that was undecided counts as an abstention."""
        return Outcomes(self.void, np.where(gate, 0.0, self.correct), np.where(gate, 1.0, self.abstained))

    def metrics(self) -> dict[str, float]:
        """Return acc, false_abs, abs_rec and pecs; NaN where nothing was decided."""
        yes, n_decided = self.counts().sum(axis=0).reshape(3, 2).T
        with np.errstate(invalid="ignore"):
            acc, false_abs, abs_rec = yes / n_decided
        shares = {"acc": acc, "false_abs": false_abs, "abs_rec": abs_rec, "pecs": pecs_of(acc, abs_rec - false_abs)}
        return {name: float(value) for name, value in shares.items()}

    def counts(self) -> np.ndarray:
        """Return the numerators and denominators of Acc, FalseAbs, AbsRec, (n, 6), as COUNTS."""
        parts = ((~self.void, self.correct), (~self.void, self.abstained), (self.void, self.abstained))
        is_decided = [side & np.isfinite(values) for side, values in parts]
        yes = [np.where(decision, values, 0.0) for decision, (_, values) in zip(is_decided, parts, strict=True)]
        return np.stack([column for pair in zip(yes, is_decided, strict=True) for column in pair], axis=-1).astype(
            float
        )


def gate_auroc(decisions: Decisions, void: np.ndarray) -> float:
    """Return AUROC of a gate's scores against labels void (n,); NaN with one side."""
    is_known = np.isfinite(decisions.score)
    return float(auroc(void[is_known], decisions.score[is_known]))


def families(items: pd.DataFrame) -> np.ndarray:
    """Return the family of each item, (n,) text, for `other families`: taxonomy and sub-scenario."""
    return np.array([f"{probed_taxonomy(d)}:{s}" for d, s in zip(items["dataset"], items["sub_scenario"], strict=True)])
