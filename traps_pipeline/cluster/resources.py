"""Tag runs on other hosts with study, submitter's code, and resources for Ray."""

from __future__ import annotations

import json
import os
from collections.abc import Collection, Iterable, Sequence
from typing import Any

from traps_pipeline.base.cores import CORES
from traps_pipeline.cluster.same_code import CODE, code_here
from traps_pipeline.models.answer_rows import RESPONSES
from traps_pipeline.models.registry import LOCAL, get_model
from traps_pipeline.pipeline.graph import Stage
from traps_pipeline.pipeline.ranges import Range
from traps_pipeline.protocol.cells import Cell
from traps_pipeline.storage.workspace import RAY, VARIABLE, Workspace

STUDY_TAG = "traps/study"
RESOURCES_TAG = "dagster-ray/config"  # dagster-ray's own name


def own_tags(
    workspace: Workspace, stages: Collection[Stage], keys: Iterable[str], cpus: int, gpus: float
) -> dict[str, str]:
    """Return the tags of a run on another host; they are public, so hold no secrets.

    keys: the partitions to build; cpus: of a run that can use several cores; gpus: of a run that loads a model.
    """
    takes: dict[str, Any] = {"num_cpus": cpus if any(stage.takes.each_gb for stage in stages) else 1}
    asks = RESPONSES.name in {stage.name for stage in stages} and any(map(_is_local, keys))
    if gpus and (asks or any(stage.cost == "machine" for stage in stages)):
        takes["num_gpus"] = gpus
    memory_gb = [stage.takes.memory_gb + takes["num_cpus"] * stage.takes.each_gb for stage in stages]
    if memory := max(memory_gb, default=0.0):
        takes["memory"] = int(memory * 2**30)
    exported = {VARIABLE: str(workspace.place), RAY: os.environ.get(RAY, ""), CODE: code_here()}
    takes["runtime_env"] = {"env_vars": exported | {CORES: str(takes["num_cpus"])}}
    return {STUDY_TAG: workspace.study.name, RESOURCES_TAG: json.dumps(takes)}


def keys_in(stages: Sequence[Stage], of: Range) -> Sequence[str]:
    """Return the partitions of a range; empty for stages without partitions."""
    scheme, (first, last) = stages[0].scheme if stages else None, of
    if scheme is None or first is None:
        return []
    return scheme.between(first, str(last))


def _is_local(cell: str) -> bool:
    return get_model(Cell.parse(cell).evaluation.model).backend == LOCAL
