"""List clips and questions whose hidden states are read: pairs, and controls."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from traps_pipeline.base.errors import TrapsError
from traps_pipeline.benchmark.items import categories_of_dataset
from traps_pipeline.mechanism.mechanism_rows import ProbeItemRow
from traps_pipeline.protocol.datasets import ANSWERABLE
from traps_pipeline.storage.benchmark_tables import ITEMS, SCENE_SPECS, VIDEOS
from traps_pipeline.storage.workspace import Workspace

COPIED = ("pair_id", "scenario_id", "side", "category", "sub_scenario", "question", "clip", "media_digest")


def probe_items(workspace: Workspace, dataset: str) -> list[ProbeItemRow]:
    """Return a dataset's PROBE_ITEMS rows.

    These are the dataset's items, or occlusion's void clips with the answerable question.
    """
    if dataset != ANSWERABLE:
        rows = workspace.tables.read(ITEMS, {"dataset": dataset}).to_dict("records")
        columns = ("item_id", "dataset", *COPIED, "benchmark_version")
        return [ProbeItemRow(**{name: row[name] for name in columns}) for row in rows]
    rows = []
    for category in categories_of_dataset("occlusion"):
        if workspace.tables.state(SCENE_SPECS, {"category": category}) is None:
            continue
        clips = workspace.tables.read(VIDEOS, {"category": category})
        voids = clips.loc[clips["side"] == "void"].set_index("scenario_id")
        for spec in workspace.tables.read(SCENE_SPECS, {"category": category}).to_dict("records"):
            if spec["answerable_question"] == "null":  # recorded
                continue
            if spec["scenario_id"] not in voids.index:
                raise TrapsError(f"{spec['scenario_id']}: has no void clip yet; materialize videos for {category}")
            rows.append(_answerable_item(spec, voids.loc[spec["scenario_id"]].to_dict()))
    if not rows:
        raise TrapsError(f"probe_items {dataset}: no occlusion scenarios yet; materialize scene_specs and videos first")
    return rows


def other_clip(workspace: Workspace, row: Mapping[str, Any]) -> tuple[Path, str]:
    """Return path and SHA-256 of the clip that a row of PROBE_ITEMS is compared with.

    It is the clip of the other side of the scenario, whichever question the row has, and for any other clip (an arm's)
    the control's. So an ill-posed row, whose two sides have one clip, is compared at the position of the scenario's
    occluder. Raises TrapsError for a scenario without both clips.
    """
    clips = workspace.tables.read(VIDEOS, {"category": row["category"]})
    sides = clips.loc[clips["scenario_id"] == row["scenario_id"]].set_index("side")
    if not {"control", "void"} <= set(sides.index):
        raise TrapsError(f"{row['scenario_id']}: lacks a clip of its pair; materialize videos for {row['category']}")
    side = "void" if sides.loc["control", "file_sha256"] == row["media_digest"] else "control"
    return workspace.resolve(str(sides.loc[side, "path"])), str(sides.loc[side, "file_sha256"])


def _answerable_item(spec: Mapping[str, Any], clip: Mapping[str, Any]) -> ProbeItemRow:
    """Return the void clip with an answerable question, of side `control`."""
    pair = f"{ANSWERABLE}:{spec['scenario_id']}"
    return ProbeItemRow(
        **{name: spec[name] for name in ("scenario_id", "category", "sub_scenario", "benchmark_version")},
        item_id=f"{pair}:control",
        pair_id=pair,
        dataset=ANSWERABLE,
        side="control",
        question=json.loads(spec["answerable_question"])["question"],
        clip=clip["path"],
        media_digest=clip["file_sha256"],
    )
