"""Choose the layer of a dataset without its own labels, from rows of PROBES.

A probe's cross-validation on its own dataset cannot choose: it reaches 1 early and stays there (the paper: from layer
1), so its maximum is the lowest of many ties. Layers differ in whether a probe transfers to other datasets. So a target
is read at the layer where the probes of the *other* datasets transfer best to each other: no pair with the target on
either side counts, so no label of its voids does. Its controls are those of its taxonomy's other dataset too; pairs of
one taxonomy count as fitted without the scored scenario (`held_out`).
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from traps_pipeline.base.errors import TrapsError
from traps_pipeline.mechanism.transfer_paths import LOOK_ALIKES
from traps_pipeline.protocol.datasets import DATASETS, taxonomy_of

Curves = Mapping[tuple[str, str], Mapping[int, float]]
ROUNDING = 1e-9


@dataclass(frozen=True)
class LayerChoice:
    """The layer at which a target dataset is read, chosen without its labels.

    curve: by layer, the mean AUROC of pairs of other datasets. tied: the layers that reach its maximum; the middle one
    is taken, since the ends of a plateau are next to what is worse.
    """

    curve: Mapping[int, float]

    @property
    def tied(self) -> list[int]:
        """The indices of the layers with the highest mean, ascending."""
        best = max(self.curve.values())
        return sorted(layer for layer, value in self.curve.items() if value >= best - ROUNDING)

    @property
    def layer(self) -> int:
        """The index of the layer at which the target is read."""
        return self.tied[(len(self.tied) - 1) // 2]


def pair_curves(rows: Iterable[Mapping[str, Any]]) -> Curves:
    """Return the AUROC of PROBES rows by ordered pair, then by layer; within a taxonomy the held-out ones."""
    curves: dict[tuple[str, str], dict[int, float]] = {}
    for row in rows:
        pair, value = (str(row["source"]), str(row["target"])), row["value"]
        if not {*pair} <= {*DATASETS} or value is None or np.isnan(value):
            continue
        if row["analysis"] == ("held_out" if taxonomy_of(pair[0]) == taxonomy_of(pair[1]) else "transfer"):
            curves.setdefault(pair, {})[int(row["layer"])] = float(value)
    return curves


def layer_choice(curves: Curves, target: str = "") -> LayerChoice:
    """Return the layer choice for a dataset, a look-alike, or (empty) anything else.

    In a study with fewer than three datasets no pair is left: then the other dataset's own held-out metric counts,
    which may tie at many layers, and in a study of one dataset its own. Raises TrapsError without any metric.
    """
    target = LOOK_ALIKES.get(target, target)  # read at the layer of the dataset that it resembles
    other_pairs = [pair for pair in curves if target not in pair]
    pairs = [pair for pair in other_pairs if pair[0] != pair[1]] or other_pairs or [*curves]
    if not pairs:
        raise TrapsError("probes: no dataset has both sides, so no layer can be chosen; extract more hidden states")
    layers = sorted(set.intersection(*({*curves[pair]} for pair in pairs)))
    # States that are the same for all items, as the embedding of the last token, order nothing: chance is no choice.
    layers = [n for n in layers if any(abs(curves[pair][n] - 0.5) > ROUNDING for pair in pairs)] or layers
    return LayerChoice({n: float(np.mean([curves[pair][n] for pair in pairs])) for n in layers})
