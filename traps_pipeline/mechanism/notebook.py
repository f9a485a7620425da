"""Give notebooks a study's models, prompts, chosen layers, sweeps, lens and gate (`traps_pipeline.inside`)."""

from __future__ import annotations

from collections.abc import Collection, Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np
import pandas as pd

from traps_pipeline.base.errors import TrapsError
from traps_pipeline.base.suggestions import did_you_mean
from traps_pipeline.base.wording import count_noun
from traps_pipeline.mechanism.gate import THRESHOLDS, GateItems, fit_gate, sources_of_gate
from traps_pipeline.mechanism.gating import chosen_layers, gate_items, gate_table
from traps_pipeline.mechanism.layer_choice import pair_curves
from traps_pipeline.mechanism.lens import lens_rows
from traps_pipeline.mechanism.mechanism_rows import HIDDEN_STATES, PROBE_ITEMS, PROBES
from traps_pipeline.mechanism.probes import Fit, Scorer, fit_probe, side_swapped_labels
from traps_pipeline.mechanism.probing import ProbeRun, each_layer
from traps_pipeline.mechanism.stages import examined_model
from traps_pipeline.mechanism.stored_states import StoredStates
from traps_pipeline.models.local.capture import OF_PARTS, Pooling
from traps_pipeline.models.registry.entries import ModelEntry, get_model
from traps_pipeline.models.registry.prompts import states_prompt
from traps_pipeline.protocol.cells import Extraction
from traps_pipeline.protocol.datasets import DATASETS, EXTRACTED, dataset_of
from traps_pipeline.protocol.regimes import VQA_PROMPTS
from traps_pipeline.storage.media import pick_frames
from traps_pipeline.storage.workspace import Workspace

if TYPE_CHECKING:
    from traps_pipeline.models.local.adapter import LocalModel, Prompt

AnyLayer = int | Literal["normed"]
Where = str | Path | Workspace
ABSTENTION = "I don't know: this cannot be determined from the video."
Threshold = Literal["mid", "J", "conformal"]


def open_study(where: Where) -> Workspace:
    """Return the workspace in a folder, or the workspace given."""
    return where if isinstance(where, Workspace) else Workspace.open(Path(where))


def check_name(kind: str, name: str, known: Iterable[str]) -> None:
    """Raise TrapsError for an unknown name, naming the nearest one or all."""
    known = [*known]
    if name not in known:
        hint = did_you_mean(str(name), known) or f"; there are {', '.join(known[:12]) or 'none'}"
        raise TrapsError(f"no {kind} {name!r:.60}{hint}")


def study_states(workspace: Where, model: str, prompt: str) -> StoredStates:
    """Return a model's stored states in a study. Raises TrapsError naming what the study has."""
    opened, entry = open_study(workspace), get_model(model)
    extracted = {(str(part["model"]), str(part["prompt"])) for part in opened.tables.partitions(HIDDEN_STATES)}
    check_name("hidden states of model", entry.id, sorted({name for name, _ in extracted}))
    check_name(f"hidden states of {entry.id} under prompt", prompt, sorted(p for m, p in extracted if m == entry.id))
    return StoredStates.of(opened, Extraction(entry.id, prompt))


def check_layer(states: StoredStates, layer: AnyLayer) -> None:
    """Raise TrapsError for a layer that the states lack."""
    if layer != "normed" and layer not in range(states.n_layers):
        model = states.extraction.model
        raise TrapsError(f"no layer {layer!r:.20}; {model} has 0 (embeddings) to {states.n_layers - 1}, and `normed`")


def chosen_layer(states: StoredStates, dataset: str = "") -> int:
    """Return the index of the layer of a dataset, or over all pairs, chosen without its labels. Raises TrapsError."""
    if dataset:
        check_name("dataset", dataset, EXTRACTED)
    if states.workspace.tables.state(PROBES, states.extraction.partition) is None:
        raise TrapsError(
            f"no probes of {states.extraction.key}, by which the study chooses a layer; `traps run EXPERIMENT --until "
            f"probes` makes them, or name a layer, 0 to {states.n_layers - 1}"
        )
    return chosen_layers(states.workspace, states, [dataset])[dataset]


def layer(workspace: Where, model: str, dataset: str = "", *, prompt: str = "standard") -> int:
    """Return the index of the layer at which the study reads a dataset, chosen without its labels.

    Without a dataset all pairs choose. Raises TrapsError for unknown names, and without probes.

    Examples
    --------
    >>> inside.layer(".workspaces/mechanism", "pocket", "occlusion") in range(5)
    True
    """
    return chosen_layer(study_states(workspace, model, prompt), dataset)


def _examined(workspace: Where, model: str | None) -> tuple[Workspace, ModelEntry]:
    opened = open_study(workspace)
    return opened, examined_model(opened, get_model(model or next(iter(opened.mechanism.models))).id)


def load_model(workspace: Where, model: str | None = None) -> LocalModel:
    """Return a model as the study looks into it; by default its first one. `network` is transformers' own.

    Examples
    --------
    >>> inside.load_model(".workspaces/mechanism", "pocket").n_layers
    4
    """
    from traps_pipeline.models.local.adapter import load_local_model

    return load_local_model(_examined(workspace, model)[1], inside=True)


def prompt(
    workspace: Where, item: str, *, model: str | None = None, regime: str = "standard", system: str | None = None
) -> Prompt:
    """Return an item's prompt, as the study shows it to a model (by default its first one).

    item: an id, as `states.items` has it. regime: standard or guided. system: `vqa`, as states are read, or
    `benchmark`, as models are asked; by default the study's. Raises TrapsError for an unknown name.

    Examples
    --------
    >>> item = inside.load(".workspaces/mechanism", "pocket", layer=2).items["item_id"][0]
    >>> inside.prompt(".workspaces/mechanism", item, regime="guided").n_tokens > 20
    True
    """
    opened, entry = _examined(workspace, model)
    check_name("prompt", regime, VQA_PROMPTS)
    check_name("system", system or "vqa", ("vqa", "benchmark"))
    probed = [str(part["dataset"]) for part in opened.tables.partitions(PROBE_ITEMS)]
    check_name("dataset", dataset_of(item), probed)
    items = opened.tables.read(PROBE_ITEMS, {"dataset": dataset_of(item)}).set_index("item_id")
    check_name("item", item, items.index)
    assert entry.media is not None, "local entries have media"
    frames = pick_frames(opened.resolve(str(items.at[item, "clip"])), entry.media)
    text = states_prompt(system or opened.mechanism.system, regime)
    return load_model(opened, entry.id).prompt(text, str(items.at[item, "question"]), frames.frames, frames.times_s)


def sweep(
    workspace: Where, model: str, *, fit: Fit = fit_probe, prompt: str = "standard", draws: int = 20
) -> pd.DataFrame:
    """Return the mean AUROC of the study's pairs of datasets at every layer, beside its null.

    value: over all ordered pairs, and each dataset itself, held out by scenario within a taxonomy. null_low, null_high:
    95 % of `draws` in which each scenario swaps its sides by a coin. best_null: the same of the highest layer of a
    draw, which the best layer of `value` must pass, since it is chosen on the labels that it is scored on.

    Examples
    --------
    >>> rows = inside.sweep(".workspaces/mechanism", "pocket", fit=inside.mean_difference, draws=2)
    >>> rows.columns.tolist(), rows["best_null"].nunique()
    (['layer', 'value', 'null_low', 'null_high', 'best_null'], 1)
    """
    states = study_states(workspace, model, prompt)
    settings, items = states.workspace.mechanism, states.items.loc[states.items["dataset"].isin(DATASETS)]
    void, scenario = (items["side"] == "void").to_numpy(), pd.factorize(items["scenario_id"])[0]
    labels = np.column_stack([void, side_swapped_labels(void, scenario, draws, settings.seed)])
    probes = settings.probes.model_copy(update={"resamples": 1})  # no interval is read

    def means(number: int) -> list[float]:
        vectors = {name: states.read(name, number) for name in dict.fromkeys(items["dataset"])}
        metrics = []
        for column in labels.T:
            swapped = items.assign(side=np.where(column, "void", "control"))
            run = ProbeRun(swapped, lambda name, _: vectors[name], 1, 0, probes, settings.seed, fit=fit)
            metrics.append(np.mean([*(curve[0] for curve in pair_curves(run.comparable_rows(0)).values())]))
        return metrics

    metrics = np.array([*each_layer(means, states.n_layers)])
    low, high = np.quantile(metrics[:, 1:], [0.025, 0.975], axis=1)
    rows = {"layer": range(states.n_layers), "value": metrics[:, 0], "null_low": low, "null_high": high}
    return pd.DataFrame(rows | {"best_null": float(np.quantile(metrics[:, 1:].max(axis=0), 0.95))})


def lens(workspace: Where, model: str, *, prompt: str = "standard") -> pd.DataFrame:
    """Return the log-odds of abstaining that the output would have at every layer, by dataset (`lens` of the study).

    Stored states pass through the model's own final norm and head: means of voids and controls, and their AUROC.

    Examples
    --------
    >>> sorted(set(inside.lens(".workspaces/mechanism", "pocket")["layer"]))
    [0, 1, 2, 3, 4]
    """
    states = study_states(workspace, model, prompt)
    return pd.DataFrame(lens_rows(states.workspace, examined_model(states.workspace, model), states))


# --- a gate for live prompts ------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Gate:
    """A probe of a layer's states of this pooling, whose score above the threshold means abstain."""

    layer: int
    probe: Scorer = field(repr=False)
    threshold: float
    pooling: Pooling

    def score(self, model: LocalModel, prompt: Prompt) -> float:
        """Return the probe's log-odds of void for a prompt, by one plain pass."""
        with model.caching_clips():
            states = model.forward_states(prompt, self.pooling).raw[self.layer]
        return float(self.probe.scores(states[None])[0])

    def abstains(self, model: LocalModel, prompt: Prompt) -> bool:
        """Return whether the gate turns the model's answer to a prompt into an abstention."""
        return self.score(model, prompt) > self.threshold

    def answer(self, model: LocalModel, prompt: Prompt, max_new_tokens: int = 512) -> str:
        """Return the greedy answer, or ABSTENTION without generation if the gate abstains."""
        return ABSTENTION if self.abstains(model, prompt) else model.generate([prompt], max_new_tokens)[0].text


def gate(
    workspace: Where,
    model: str,
    *,
    source: str,
    threshold: Threshold = "mid",
    target: str = "",
    layer: int | None = None,
    prompt: str = "standard",
    without: Collection[str] = (),
) -> Gate:
    """Return a gate for live use: `abstains(model, prompt)`, `answer(model, prompt)`.

    model, prompt: a local model and its prompt. source: `one:DATASET`, `other datasets` (than the target) or `other
    families`. threshold: mid, J or conformal. layer: default: that of the gate stage. without: scenarios, or families
    as the gate stage names them (`occlusion:tunnel`), to hold out: without those of a fold, its decisions about that
    fold equal the stage's. Raises TrapsError for another source or threshold, for a source without both sides in as
    many scenarios as there are folds, and for states that are means over a part of the prompt.

    Examples
    --------
    >>> live = inside.gate(".workspaces/mechanism", "pocket", source="one:occlusion", layer=2)
    >>> live.abstains(local_model, prompt) in (True, False)
    True
    """
    states = study_states(workspace, model, prompt)
    settings = states.workspace.mechanism
    check_name("threshold", threshold, THRESHOLDS)
    pooling = str(states.items["pooling"].iloc[0])
    if pooling in OF_PARTS:
        raise TrapsError(
            f"these states are means over a part of the prompt ({pooling}), which a prompt alone does not tell; "
            "set `pooling: last`"
        )
    layer = chosen_layer(states, target) if layer is None else layer
    check_layer(states, layer)
    train = _train(states, source, target, layer, without)
    folds, false_abs = settings.probes.folds, settings.gate.false_abs
    if len(set(train.void)) < 2 or len(set(train.table["scenario_id"])) < folds:
        raise TrapsError(
            f"a gate from {source} needs both sides of {folds} scenarios (`probes.folds`), and has "
            f"{count_noun(len(train.table), 'item')}; extract the hidden states of more pairs"
        )
    probe, cuts, _ = fit_gate(train, folds, settings.seed, false_abs)
    return Gate(layer, probe, cuts[threshold], pooling)  # pyright: ignore[reportArgumentType]


def _train(states: StoredStates, source: str, target: str, layer: int, without: Collection[str]) -> GateItems:
    table = gate_table(states)
    datasets = [name for name in DATASETS if name in set(table["dataset"])]
    names = sources_of_gate(source, target, datasets)
    if not names:
        raise TrapsError(f"no gate from {source!r}; the study has states of {', '.join(datasets) or 'no dataset'}")
    table = table.loc[table["dataset"].isin(names)].reset_index(drop=True)
    is_training = ~(table["scenario_id"].isin(without) | table["family"].isin(without)).to_numpy(bool)
    features = {name: states.read(name, layer) for name in names}
    return gate_items(table, features, shuffled=False, seed=0).rows(is_training)
