"""What was planted in the pocket model by its recipe, and what the mechanistic stages find of it: figures for its card.

The recipe says beforehand that time stamps do not tell a chaotic void, that an occluder alone is no reason to abstain,
and that the prompt decides what is said about a void while its states stay the same. Each of these has a figure here.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import pandas as pd

from traps_pipeline.judging.judging_rows import VERDICTS
from traps_pipeline.mechanism.control_rows import GATE, PATCHING, PROBE_BASELINES, STEERING_NULLS
from traps_pipeline.mechanism.mechanism_rows import PROBES
from traps_pipeline.protocol.datasets import DATASETS
from traps_pipeline.storage.workspace import Workspace

DECOY, REMOVED = "decoy", "removed"


@dataclass(frozen=True)
class Truth:
    """A planted truth. label: as the card has it; wanted: what the recipe leads one to expect; percent: whether the
    value is a share that is printed so; of: the figure of a study, None where the study has none."""

    name: str
    label: str
    wanted: str
    percent: bool
    of: Callable[[Workspace, str], float | None]


def _mean(values: pd.Series) -> float | None:
    known = values.dropna().astype(float)
    return float(known.mean()) if len(known) else None


def _layer_0(group: str) -> Callable[[Workspace, str], float | None]:
    def of(workspace: Workspace, model: str) -> float | None:
        rows = workspace.tables.read_all(PATCHING, model=model)
        rows = rows.loc[(rows["dataset"] == "chaotic") & (rows["source"] == "pair") & (rows["site"] == "residual")]
        return _mean(rows.loc[(rows["layer"] == 0) & (rows["group"] == group), "effect"])

    return of


def _abstained(regime: str, dataset: str | None = None) -> Callable[[Workspace, str], float | None]:
    """Return the share of abstentions on voids, mean over the four datasets; or on all items of one dataset."""

    def of(workspace: Workspace, model: str) -> float | None:
        rows = workspace.tables.read_all(VERDICTS, ["dataset", "side", "abstained"], model=model, regime=regime)
        if dataset is not None:
            return _mean(rows.loc[rows["dataset"] == dataset, "abstained"])
        rows = rows.loc[rows["dataset"].isin(DATASETS) & (rows["side"] == "void") & rows["abstained"].notna()]
        return _mean(rows.assign(abstained=rows["abstained"].astype(float)).groupby("dataset")["abstained"].mean())

    return of


def _own(rows: pd.DataFrame) -> pd.DataFrame:
    """Return rows of a dataset on itself, fitted without the scored scenario."""
    return rows.loc[(rows["analysis"] == "held_out") & (rows["source"] == rows["target"])]


def _probe(prompt: str) -> Callable[[Workspace, str], float | None]:
    def of(workspace: Workspace, model: str) -> float | None:
        rows = _own(workspace.tables.read_all(PROBES, model=model, prompt=prompt))
        return _mean(rows.loc[rows["chosen"].eq(True), "value"])

    return of


def _margin(workspace: Workspace, model: str) -> float | None:
    rows = _own(workspace.tables.read_all(PROBE_BASELINES, model=model, prompt="standard"))
    return _mean(rows.loc[rows["features"] == "output margin", "value"])


def _look_alike(analysis: str, arm: str = DECOY) -> Callable[[Workspace, str], float | None]:
    def of(workspace: Workspace, model: str) -> float | None:
        rows = workspace.tables.read_all(PROBES, model=model, prompt="standard")
        rows = rows.loc[(rows["analysis"] == analysis) & (rows["source"] == "occlusion") & (rows["target"] == arm)]
        return _mean(rows.loc[rows["chosen"].eq(True), "value"])

    return of


def _gated_decoys(workspace: Workspace, model: str) -> float | None:
    rows = workspace.tables.read_all(GATE, model=model)
    rows = rows.loc[(rows["features"] == "states") & (rows["source"] == "other datasets") & (rows["target"] == DECOY)]
    return _mean(rows.loc[rows["threshold"] == "mid", "false_abs"])


def _beats_nulls(workspace: Workspace, model: str) -> float | None:
    """Return the share of rows in which the void direction is ahead of at least 19 of 20 draws of a null."""
    rows = workspace.tables.read_all(STEERING_NULLS)
    rows = rows.loc[(rows["model"] == model) & (rows["target"] != "all")]
    return float((rows["p"] < 0.1).mean()) if len(rows) else None


TRUTHS = (
    Truth("stamps", "indirect effect of the time stamps at layer 0, chaotic", "at most 0.1", False, _layer_0("stamps")),
    Truth("changed", "of the visual tokens that differ, layer 0, chaotic", "most of it", False, _layer_0("changed")),
    Truth("standard", "AbsRec under standard, mean of four datasets", "below one half", True, _abstained("standard")),
    Truth("guided", "AbsRec under guided", "30 points above", True, _abstained("guided")),
    Truth("probe_standard", "probe on a dataset itself, AUROC, standard prompt", "", False, _probe("standard")),
    Truth("probe_guided", "the same, guided prompt", "within 0.05", False, _probe("guided")),
    Truth("margin", "output margin, AUROC, standard prompt", "", False, _margin),
    Truth("decoy_standard", "decoys abstained on, standard", "at most 10", True, _abstained("standard", DECOY)),
    Truth("decoy_guided", "decoys abstained on, guided", "at most 10", True, _abstained("guided", DECOY)),
    Truth("decoy_void", "occlusion's probe: voids against decoys, AUROC", "1", False, _look_alike("answerable_void")),
    Truth("decoy_control", "decoys against controls", "0.5", False, _look_alike("answerable_control")),
    Truth(
        "removed_void",
        "the same: voids against the void’s own occluder, gone before the end",
        "1",
        False,
        _look_alike("answerable_void", REMOVED),
    ),
    Truth(
        "removed_control", "that occluder against controls", "0.5", False, _look_alike("answerable_control", REMOVED)
    ),
    Truth("decoy_gate", "decoys that the gate abstains on (other datasets, mid)", "", True, _gated_decoys),
    Truth("nulls", "rows in which void steering is ahead of 19 of 20 nulls", "", True, _beats_nulls),
)


def planted(workspace: Workspace, model: str) -> dict[str, float]:
    """Return the figures of a finished study by the names of TRUTHS, without those that the study has not."""
    truths = {truth.name: truth.of(workspace, model) for truth in TRUTHS}
    return {name: value for name, value in truths.items() if value is not None}
