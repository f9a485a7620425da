"""Give researchers a study's states (arrays), prompts, directions, and probe protocol.

    from traps_pipeline import inside

    states = inside.load(".workspaces/mechanism", "pocket")            # states.X, states.void, states.items
    figures = inside.protocol(".workspaces/mechanism", "pocket", fit=inside.mean_difference)
    with inside.direction(".workspaces/mechanism", "pocket", "occlusion").apply(network, gaps=-1):
        network.generate(...)                                          # a plain transformers model

Where no layer is named, it is the one that the study chose without labels of the dataset (`layer`).

docs/inside.ipynb walks through this; a test runs it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from traps_pipeline.base.errors import TrapsError
from traps_pipeline.judging.judging_rows import VERDICTS
from traps_pipeline.mechanism.hook import Site, register_change
from traps_pipeline.mechanism.notebook import AnyLayer, Where, check_layer, check_name, chosen_layer, study_states
from traps_pipeline.mechanism.notebook import gate as gate
from traps_pipeline.mechanism.notebook import layer as layer
from traps_pipeline.mechanism.notebook import lens as lens
from traps_pipeline.mechanism.notebook import load_model as load_model
from traps_pipeline.mechanism.notebook import prompt as prompt
from traps_pipeline.mechanism.notebook import sweep as sweep
from traps_pipeline.mechanism.other_probes import erased as erased
from traps_pipeline.mechanism.other_probes import from_sklearn as from_sklearn
from traps_pipeline.mechanism.other_probes import mean_difference as mean_difference
from traps_pipeline.mechanism.probes import Fit, fit_probe
from traps_pipeline.mechanism.probing import ProbeRun
from traps_pipeline.mechanism.stages import saved_directions
from traps_pipeline.protocol.cells import Cell, Evaluation
from traps_pipeline.protocol.regimes import REGIMES
from traps_pipeline.storage.workspace import Workspace

if TYPE_CHECKING:
    from torch import Tensor
    from torch.nn import Module

# --- states -----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False, repr=False)
class LoadedStates:
    """States with their items and verdicts.

    X: (n, d) float32. items: n rows with item_id, dataset, scenario_id, side, sub_scenario, void, and for each regime
    with verdicts abstained_REGIME and correct_REGIME (null if there is none).

    Examples
    --------
    >>> states = inside.load(".workspaces/mechanism", "pocket", layer=2)
    >>> states.X.dtype, len(states.X) == len(states.items)
    (dtype('float32'), True)
    """

    X: np.ndarray
    items: pd.DataFrame

    def __repr__(self) -> str:
        """Return the numbers of items and of values, and the datasets."""
        return f"LoadedStates({' x '.join(map(str, self.X.shape))}, {', '.join(dict.fromkeys(self.items['dataset']))})"

    @property
    def void(self) -> np.ndarray:
        """Whether each item is a void, (n,) bool.

        Examples
        --------
        >>> states = inside.load(".workspaces/mechanism", "pocket", layer=2, datasets=["occlusion"])
        >>> states.void.mean()  # half of a dataset of pairs
        np.float64(0.5)
        """
        return self.items["void"].to_numpy(bool)

    def where(self, chosen: Any) -> LoadedStates:
        """Return the items that a mask (n,) or a query on `items` selects. Raises TrapsError for another one.

        Examples
        --------
        >>> states = inside.load(".workspaces/mechanism", "pocket", layer=2)
        >>> states.where("dataset == 'occlusion' and void").void.all()
        np.True_
        """
        try:
            mask = np.asarray(self.items.eval(chosen) if isinstance(chosen, str) else chosen, bool)
        except (NameError, SyntaxError, TypeError, ValueError, LookupError, AttributeError) as error:
            raise TrapsError(f"no query {chosen!r:.80} ({error}); columns: {', '.join(self.items)}") from error
        if mask.shape != (len(self.items),):
            raise TrapsError(f"a mask of {mask.shape} for {len(self.items)} items; give one value an item")
        return LoadedStates(self.X[mask], self.items.loc[mask].reset_index(drop=True))


def load(
    workspace: Where,
    model: str,
    *,
    layer: AnyLayer | None = None,
    prompt: str = "standard",
    datasets: Sequence[str] | None = None,
) -> LoadedStates:
    """Return a study's states at one layer, joined with the verdicts of run 1.

    layer: 0 for embeddings; `normed`: the last one after the final norm; by default the study's chosen one of a single
    dataset, else over all pairs. datasets: some of those with states; all by default. Raises TrapsError if the study
    has no such states, model, layer or dataset.

    Examples
    --------
    >>> states = inside.load(".workspaces/mechanism", "pocket", layer="normed", datasets=["chaotic"])
    >>> set(states.items["dataset"])
    {'chaotic'}
    """
    states = study_states(workspace, model, prompt)
    available = [*dict.fromkeys(states.items["dataset"])]
    for dataset in datasets or ():
        check_name("hidden states of dataset", dataset, available)
    if layer is None:
        layer = chosen_layer(states, *(datasets if datasets and len(datasets) == 1 else ()))
    check_layer(states, layer)
    parts, vectors = list[pd.DataFrame](), list[np.ndarray]()
    for dataset in datasets or available:
        items = pd.DataFrame(
            states.dataset(dataset)[["item_id", "dataset", "scenario_id", "side", "sub_scenario"]]
        ).reset_index(drop=True)
        items["void"] = items["side"] == "void"
        for regime in REGIMES:
            items = items.merge(
                _verdicts(states.workspace, Cell(dataset, Evaluation(model, regime, 1))), on="item_id", how="left"
            )
        parts.append(items)
        vectors.append(states.read(dataset, layer))
    joined = pd.concat(parts, ignore_index=True)
    return LoadedStates(np.concatenate(vectors), joined.dropna(axis=1, how="all"))


def _verdicts(workspace: Workspace, cell: Cell) -> pd.DataFrame:
    names = ["abstained", "correct"]
    rows = workspace.tables.read_all(VERDICTS, ["item_id", *names], **cell.partition)
    return rows.rename(columns={name: f"{name}_{cell.evaluation.regime}" for name in names})


# --- probes -----------------------------------------------------------------------------------------------------------


def protocol(
    workspace: Where,
    model: str,
    *,
    layer: int | None = None,
    fit: Fit = fit_probe,
    prompt: str = "standard",
    change: Callable[[np.ndarray], np.ndarray] = lambda states: states,
    features: LoadedStates | None = None,
) -> pd.DataFrame:
    """Run the study's own protocol with another probe; return its rows.

    Rows are like those of `probe_baselines`, with the same items, folds, splits by scenario and intervals as the
    study's. layer: by default each target's chosen one. fit: maps states (n, d) and void (n,) to an object with
    `scores` (`from_sklearn`, `mean_difference`, your own). change: transforms the states of a dataset, (n, d) to
    (n, k). features: used instead of the study's states; datasets without features are left out. Columns: analysis,
    source, target, layer, value (AUROC), low, high, n_voids, n_controls.

    Examples
    --------
    >>> rows = inside.protocol(".workspaces/mechanism", "pocket", layer=2, fit=inside.mean_difference)
    >>> rows.query("target == 'occlusion'")["value"].between(0, 1).all()
    np.True_
    """
    states = study_states(workspace, model, prompt)
    items, settings = states.items, states.workspace.mechanism
    if features is not None:
        items = items.loc[items["dataset"].isin([*dict.fromkeys(features.items["dataset"])])].reset_index(drop=True)

    def read(dataset: str, number: int) -> np.ndarray:
        if features is None:
            return change(states.read(dataset, number))
        places = pd.Index(features.items["item_id"]).get_indexer(pd.Index(states.dataset(dataset)["item_id"]))
        if (places < 0).any():
            raise TrapsError(f"`features` lacks {int((places < 0).sum())} items of {dataset}; give all items of it")
        return change(features.X[places])

    targets = [*dict.fromkeys(items["dataset"])]
    if layer is None and features is None:
        layers = {target: chosen_layer(states, target) for target in targets}
    else:
        check_layer(states, layer or 0)
        layers = dict.fromkeys(targets, layer or 0)
    run = ProbeRun(items, read, states.n_layers, 0, settings.probes, settings.seed, fit=fit)
    rows = (row for number in sorted({*layers.values()}) for row in run.comparable_rows(number))
    columns = ["analysis", "source", "target", "layer", "value", "low", "high", "n_voids", "n_controls"]
    return pd.DataFrame((row for row in rows if layers[row["target"]] == row["layer"]), columns=pd.Index(columns))


# --- interventions ----------------------------------------------------------------------------------------------------

Change = Callable[["Tensor", "Tensor", float], "Tensor"]  # states (rows, T, d), unit direction (d,), amount -> states


@dataclass(frozen=True, eq=False)
class Direction:
    """A direction at a layer of a model.

    vector: (d,), of any length but 0. layer: 1 to the number of blocks, counted as in hidden_states. gap: the distance
    between the sides' means along it, the unit of doses in gaps.

    Examples
    --------
    >>> inside.Direction(np.array([2.0, 0.0]), layer=3)
    Direction(layer=3, gap=None)
    """

    vector: np.ndarray = field(repr=False)
    layer: int
    gap: float | None = None

    @contextmanager
    def apply(
        self,
        model: Any,
        amount: float | None = None,
        *,
        gaps: float | None = None,
        change: Change = lambda states, unit, amount: states + amount * unit,
        site: Site = "residual",
    ) -> Iterator[None]:
        """Change a model's passes inside the context; always remove the hook after it.

        model: a transformers model, or one of ours. amount: in the model's own unit, or gaps: in class gaps. change:
        maps the states at a site (rows, T, d), the unit direction and the amount to new states; with a cache, T is 1
        after the prompt. Raises TrapsError for a layer or width that the model lacks.

        Examples
        --------
        >>> push = inside.direction(".workspaces/mechanism", "pocket", "occlusion", layer=2)
        >>> with push.apply(network, gaps=-1):  # a transformers model
        ...     tokens = network.generate(**inputs, max_new_tokens=4)
        """
        import torch

        block, width = _block(model, self.layer)
        unit = np.asarray(self.vector, np.float32)
        length = float(np.linalg.norm(unit))
        if unit.shape != (width,) or not np.isfinite(unit).all() or not length:
            raise TrapsError(
                f"the direction has shape {unit.shape}, but states of this model are {width} finite numbers"
            )
        if (amount is None) == (gaps is None):
            raise TrapsError("give amount, or gaps, and not both")
        if gaps is not None and self.gap is None:
            raise TrapsError("this direction has no class gap; give amount, or take a direction of `inside.direction`")
        dose = float(amount) if amount is not None else float(gaps or 0) * float(self.gap or 0)
        along = torch.from_numpy(unit / length)
        handle = register_change(
            block, site, lambda states: change(states, along.to(states.device, states.dtype), dose)
        )
        try:
            yield
        finally:
            handle.remove()


def _block(model: Any, layer: int) -> tuple[Module, int]:
    """Return a block, and the width of the model's states."""
    network = getattr(model, "network", model)
    decoder = network.get_decoder() if hasattr(network, "get_decoder") else None
    blocks = getattr(decoder, "layers", None)
    if blocks is None:
        raise TrapsError(f"{type(network).__name__} has no get_decoder().layers, so no block can be changed in it")
    if not 1 <= layer <= len(blocks):
        raise TrapsError(f"no block {layer}; {type(network).__name__} has blocks 1 to {len(blocks)}")
    return blocks[layer - 1], int(network.config.get_text_config().hidden_size)


def direction(
    workspace: Where,
    model: str,
    dataset: str,
    *,
    layer: int | None = None,
    prompt: str = "standard",
    kind: str = "void",
    draw: int = 0,
) -> Direction:
    """Return a saved direction: a dataset's void direction, or a draw of a null.

    It has the class gap. layer: by default the dataset's chosen one. Raises TrapsError if the study has no such
    direction.

    Examples
    --------
    >>> inside.direction(".workspaces/mechanism", "pocket", "occlusion", layer=2, kind="void").gap > 0
    True
    """
    states = study_states(workspace, model, prompt)
    directions: Mapping[str, Any] = saved_directions(states.workspace, states.extraction)
    if dataset not in directions or kind not in directions[dataset].vectors:
        available = ", ".join(
            f"{name} ({', '.join(directions_of.vectors)})" for name, directions_of in directions.items()
        )
        raise TrapsError(f"no {kind} direction of {dataset}; the study has {available or 'none'}")
    directions_of = directions[dataset]
    layer = chosen_layer(states, dataset) if layer is None else layer
    if not 0 <= layer < directions_of.n_layers or not 0 <= draw < len(directions_of.vectors[kind]):
        raise TrapsError(f"no draw {draw} at layer {layer}: layers are 0 to {directions_of.n_layers - 1}")
    return Direction(directions_of.vectors[kind][draw][layer], layer, float(directions_of.gaps[layer]))
