"""Fit a gate for live prompts in a notebook, as the gate stage evaluates it."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from traps_pipeline.base.errors import TrapsError
from traps_pipeline.base.wording import count_noun
from traps_pipeline.mechanism.gate import THRESHOLDS, GateItems, fit_gate, sources_of_gate
from traps_pipeline.mechanism.gating import chosen_layers, gate_items, gate_table
from traps_pipeline.mechanism.probes import Scorer
from traps_pipeline.mechanism.stored_states import StoredStates
from traps_pipeline.models.local.capture import OF_PARTS, Pooling
from traps_pipeline.models.registry.entries import get_model
from traps_pipeline.protocol.cells import Extraction
from traps_pipeline.protocol.datasets import DATASETS
from traps_pipeline.storage.workspace import Workspace

if TYPE_CHECKING:
    from traps_pipeline.models.local.adapter import LocalModel, Prompt

Where = str | Path | Workspace
ABSTENTION = "I don't know: this cannot be determined from the video."
Threshold = Literal["mid", "J", "conformal"]


@dataclass(frozen=True, eq=False)
class Gate:
    """A probe of a layer's states of this pooling, whose score above the threshold means abstain."""

    layer: int
    probe: Scorer
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


def open_study(where: Where) -> Workspace:
    """Return the workspace at a place, or the one given."""
    return where if isinstance(where, Workspace) else Workspace.open(Path(where))


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
    workspace, extraction = open_study(workspace), Extraction(get_model(model).id, prompt)
    states, settings = StoredStates.of(workspace, extraction), workspace.mechanism
    if threshold not in THRESHOLDS:
        raise TrapsError(f"no threshold {threshold!r}; there are {', '.join(THRESHOLDS)}")
    pooling = str(states.items["pooling"].iloc[0])
    if pooling in OF_PARTS:
        raise TrapsError(
            f"these states are means over a part of the prompt ({pooling}), which a prompt alone does not tell; "
            "set `pooling: last`"
        )
    if layer is None:
        layer = chosen_layers(workspace, states, [target])[target]
    if not 0 <= layer < states.n_layers:
        raise TrapsError(f"no layer {layer}; these states have layers 0 to {states.n_layers - 1}")
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
