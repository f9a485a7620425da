"""Read a study's hidden states layer by layer, in the order of their table."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import pandas as pd

from traps_pipeline.base.errors import TrapsError
from traps_pipeline.mechanism.mechanism_rows import HIDDEN_STATES
from traps_pipeline.mechanism.probing_versions import joined_models, states_folder
from traps_pipeline.models.registry.entries import get_model
from traps_pipeline.protocol.cells import Extraction, StatesCell
from traps_pipeline.protocol.datasets import PROBED_DATASETS
from traps_pipeline.protocol.regimes import RANDOM_WEIGHTS
from traps_pipeline.storage.workspace import Workspace


@dataclass
class StoredStates:
    """The stored hidden states of an extraction: a table of items, and a reader of layers in its order."""

    workspace: Workspace
    extraction: Extraction
    items: pd.DataFrame

    @staticmethod
    def of(workspace: Workspace, extraction: Extraction, datasets: Sequence[str] = PROBED_DATASETS) -> StoredStates:
        """Return the stored states of an extraction for datasets. Raises TrapsError if there are none."""
        items = workspace.tables.read_all(HIDDEN_STATES, dataset=datasets, **extraction.partition)
        if items.empty:
            raise TrapsError(f"no hidden states of {extraction.key}; materialize hidden_states for it first")
        return StoredStates(workspace, extraction, items.reset_index(drop=True))

    @staticmethod
    def of_random(workspace: Workspace, model: str) -> list[StoredStates]:
        """Return the stored states of a model's network with random weights, one for each extracted seed."""
        entry = get_model(model)
        extractions = [Extraction(model, name) for name in RANDOM_WEIGHTS if entry.has_random_weights]
        made = workspace.tables.partitions(HIDDEN_STATES)
        return [
            StoredStates.of(workspace, extraction)
            for extraction in extractions
            if any(extraction.partition.items() <= part.items() for part in made)
        ]

    @property
    def n_layers(self) -> int:
        """The number of layers, the embeddings included."""
        return int(self.items["n_layers"].iloc[0]) + 1

    @property
    def joined(self) -> dict[str, Any]:
        """Values of the columns of rows that join these states with answers."""
        entry = get_model(self.extraction.model)
        return {**self.extraction.partition, "joins": joined_models(entry, self.workspace.mechanism)}

    def dataset(self, name: str) -> pd.DataFrame:
        """Return the table's rows of a dataset."""
        return self.items.loc[self.items["dataset"] == name]

    def read_as(self, order: StoredStates, dataset: str, layer: int | Literal["normed"]) -> np.ndarray:
        """Return states (n, d) in the order of another extraction's items."""
        places = pd.Index(self.dataset(dataset)["item_id"]).get_indexer(pd.Index(order.dataset(dataset)["item_id"]))
        if (places < 0).any():
            raise TrapsError(
                f"{self.extraction.key} lacks states of items of {dataset}; materialize hidden_states again"
            )
        return self.read(dataset, layer)[places]

    def read(self, dataset: str, layer: int | Literal["normed"]) -> np.ndarray:
        """Return states (n, d) float32 in the order of the rows.

        Layer `normed` is the last one after the final norm. Raises TrapsError when the shards do not hold these items.
        """
        from traps_pipeline.mechanism.hidden_states import read_layer

        cell = StatesCell(dataset, self.extraction)
        ids, states = read_layer(self.workspace.bring_folder(states_folder(self.workspace, cell)), layer)
        rows = self.dataset(dataset)
        # By item, not by key: two items with the same clip and question share one.
        places = pd.Index(ids["item_id"]).get_indexer(pd.Index(rows["item_id"]))
        if (places < 0).any() or (ids["key"].to_numpy()[places] != rows["states_key"].to_numpy()).any():
            raise TrapsError(
                f"hidden states {cell.key}: the shards hold other items than the table; materialize hidden_states for "
                "it again"
            )
        return states[places]
