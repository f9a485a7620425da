"""A small study of a tiny random model: real clips and tables, no renderer and no Dagster."""

from __future__ import annotations

import json
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from traps_pipeline.base.digests import file_digest
from traps_pipeline.judging.judging_rows import VERDICTS
from traps_pipeline.models.local.tiny import build_tiny
from traps_pipeline.models.registry import entries as registry
from traps_pipeline.models.registry.entries import ModelEntry
from traps_pipeline.protocol.datasets import DATASETS, SIDES, is_ill_posed, taxonomy_of
from traps_pipeline.storage.benchmark_tables import ITEMS, SCENE_SPECS, VIDEOS, SceneSpecRow
from traps_pipeline.storage.study import MechanismSettings, Study
from traps_pipeline.storage.tables import Row, Table
from traps_pipeline.storage.workspace import Workspace
from traps_pipeline.video.encode import encode

CATEGORY = {"occlusion": "hidden", "chaotic": "plinko"}
PAIRS = 4
SETTINGS = {
    "models": {"tiny": {"steering": 2, "centroid": 1, "sweep": [1]}},
    "probes": {"folds": 2, "resamples": 100},
    "steering": {
        **{"alphas": [2, 8], "pairs": 2, "well_posed_pairs": 3, "ill_posed_pairs": 2, "max_new_tokens": 4},
        **{"direction_regimes": ["standard"], "inference_regimes": ["guided"], "signs": ["plus"], "gaps": [0.5]},
        "nulls": {"kinds": ["covariance"], "draws": 2},
    },
}


def filled(table: Table[Row], **values: Any) -> Row:
    """A row of a table: the values given, else empty ones of the column's type."""
    empty = {str: "", int: 0, float: 0.0, bool: False, list[str]: [], datetime: None}
    nothing = {c.name: None if c.nullable else empty[c.type] for c in table.columns}
    return table.row_type(**(nothing | values))


def make_study(root: Path) -> Workspace:
    """A workspace with clips, scene_specs, videos and items of four scenarios a taxonomy."""
    settings = MechanismSettings.model_validate(SETTINGS)
    workspace = Workspace.create(root / "study", Study(panel="rules", mechanism=settings, scenarios=["a"]))
    rng, clips = np.random.default_rng(0), {}
    for taxonomy, category in CATEGORY.items():
        names = [f"{category}-{n}" for n in range(PAIRS)]
        for name in names:
            base = rng.integers(0, 256, (4, 6, 8, 3))
            for side in SIDES:
                frames = np.kron(base, np.ones((1, 8, 8, 1))).astype(np.uint8)
                frames[2:, :, 32:] = 0 if side == "void" else frames[2:, :, 32:]
                path = workspace.clip(name, side, f"{taxonomy}0123456789abcdef")
                encode(list(frames), path, 2)
                clips[name, side] = (workspace.relative(path), file_digest(path))
        specs = [_spec(name, taxonomy, category) for name in names]
        workspace.tables.write(SCENE_SPECS, {"category": category}, specs, {})
        videos = [
            filled(VIDEOS, scenario_id=name, category=category, side=side, path=clips[name, side][0],
                   file_sha256=clips[name, side][1])
            for name in names for side in SIDES
        ]  # fmt: skip
        workspace.tables.write(VIDEOS, {"category": category}, videos, {})
        for dataset in (d for d in DATASETS if taxonomy_of(d) == taxonomy):
            write_items(workspace, dataset, names, clips)
    return workspace


def _spec(name: str, taxonomy: str, category: str) -> SceneSpecRow:
    asked = json.dumps({"question": f"Which colour is the floor of {name}?", "labels": ["grey"], "answer": "grey"})
    return filled(SCENE_SPECS, scenario_id=name, taxonomy=taxonomy, category=category, sub_scenario=category,
                  answerable_question=asked)  # fmt: skip


def write_items(workspace: Workspace, dataset: str, names: list[str], clips: dict, **other: str) -> None:
    """The items table of a dataset; `other` has other questions by scenario."""
    rows = []
    for name in names:
        for side in SIDES:
            unanswerable = side == "void" and is_ill_posed(dataset)
            clip = clips[name, "control" if is_ill_posed(dataset) else side]
            question = f"What does the ball of {name} weigh?" if unanswerable else f"Does {name} end left or right?"
            rows.append(
                filled(
                    ITEMS, item_id=f"{dataset}:{name}:{side}", pair_id=f"{dataset}:{name}", dataset=dataset,
                    scenario_id=name, side=side, taxonomy=taxonomy_of(dataset), category=name.split("-")[0],
                    sub_scenario=name.split("-")[0], question=other.get(name, question), labels=["left", "right"],
                    aliases="{}", answer_type="direction", ground_truth="left" if side == "control" else None,
                    clip=clip[0], media_digest=clip[1], benchmark_version="test",
                )
            )  # fmt: skip
    workspace.tables.write(ITEMS, {"dataset": dataset}, rows, {})


def write_verdicts(workspace: Workspace, dataset: str, abstained: dict[str, bool]) -> None:
    """Verdicts of the void items under Standard in run 1."""
    partition = {"dataset": dataset, "model": "tiny", "regime": "standard", "run": 1}
    rows = [
        filled(VERDICTS, item_id=f"{dataset}:{name}:void", pair_id=f"{dataset}:{name}", scenario_id=name, side="void",
               abstained=answer, **partition)
        for name, answer in abstained.items()
    ]  # fmt: skip
    workspace.tables.write(VERDICTS, partition, rows, {})


def tiny_entry(folder: Path) -> ModelEntry:
    """The registry entry of a tiny random checkpoint."""
    if not folder.is_dir():
        build_tiny("qwen3-vl", folder)
    return ModelEntry.model_validate(
        {
            "id": "tiny",
            "backend": "local",
            "device": "cpu",
            "media": {"profile": "frames", "uniform": 2, "size": (32, 32)},
            "params": {
                **{"checkpoint": str(folder), "dtype": "float32", "quantisation": "none"},
                **{"do_sample": True, "temperature": 0.8, "top_p": 0.95, "max_new_tokens": 4},
            },
            "runs": 1,
        }
    )


def register(patch: pytest.MonkeyPatch, entry: ModelEntry) -> None:
    """Make the registry know the entry as well."""
    known = registry.load_models() | {entry.id: entry}
    patch.setattr(registry, "load_models", lambda: known)
