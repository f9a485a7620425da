"""Check in seconds, before a run, that the machine has what coming stages need."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from functools import cache
from typing import TYPE_CHECKING

from traps_pipeline.base.files import check_disk
from traps_pipeline.base.network import check_network
from traps_pipeline.models.asking.answer_rows import RESPONSES
from traps_pipeline.models.registry.entries import NETWORK, Entry, get_model
from traps_pipeline.models.registry.judges import load_panel
from traps_pipeline.pipeline.graph import Stage, the_graph
from traps_pipeline.pipeline.lineage import Lineage
from traps_pipeline.pipeline.wanted import StudyPartitions
from traps_pipeline.protocol.cells import Cell
from traps_pipeline.scenes.picture.trial import check_rendering, opengl_variables
from traps_pipeline.scenes.worlds.clip_cache import ClipCache
from traps_pipeline.storage.workspace import Workspace

if TYPE_CHECKING:
    import dagster as dg

MIN_GB = 0.1  # less would run out before the first tables are written
MAX_PARTITIONS = 5  # partitions in a sentence
CLIPS = "mp4"  # the kind of a stage that renders

Parts = Mapping[str, Sequence[str | None]]  # by stage: the partitions that a run is to make


def wanted_parts(workspace: Workspace, stages: Collection[str], experiment: str | None = None) -> Parts:
    """Return the partitions of these stages that a study, or its experiment, wants."""
    partitions = StudyPartitions(workspace, experiment)
    return {stage.name: stage.wanted(partitions) for stage in the_graph().stages if stage.name in stages}


def parts_of_run(context: dg.AssetExecutionContext, stage: Stage, partitions: StudyPartitions) -> Parts:
    """Return stages of a Dagster run that share a step's partitions, with wanted keys."""
    keys = {str(key) for key in context.partition_keys} if stage.scheme else {None}
    asset_keys = context.run.asset_selection or context.job_def.asset_layer.executable_asset_keys
    names = {key.path[-1] for key in asset_keys}
    same_partitions = [
        candidate for candidate in the_graph().stages if candidate.name in names and candidate.scheme is stage.scheme
    ]
    return {
        candidate.name: [key for key in candidate.wanted(partitions) if key in keys] for candidate in same_partitions
    }


def nothing_to_do_reason(keys: Sequence[str | None], tags: Mapping[str, str], workspace: Workspace) -> str:
    """Return in words why a run whose keys are all unwanted has nothing to do."""
    if keys:
        return f"no experiment in {workspace.root / 'study.yaml'} asks for {', '.join(map(str, keys[:MAX_PARTITIONS]))}"
    first, last = (tags.get(f"dagster/asset_partition_range_{end}", "its end") for end in ("start", "end"))
    return f"no partition lies between {first} and {last}; exchange the two"


def require_machine(workspace: Workspace, parts: Parts) -> None:
    """Raise TrapsError unless the machine can build what is still missing.

    Disk, OpenGL, codecs, proxies and certificates are checked as far as these partitions need them; the error names the
    first that is missing or that a variable breaks. A study whose clips exist needs no OpenGL, and one whose answers
    and votes exist needs no network.
    """
    check_disk(workspace.root, MIN_GB)
    if any(entry.backend == NETWORK for entry in _asked_entries(workspace, parts)):
        check_network()
    graph = the_graph()
    drawing = ((graph[name].shared, key) for name, keys in parts.items() for key in keys if CLIPS in graph[name].kinds)
    if any(build is not None and build.seconds(workspace, key) > 0 for build, key in drawing):
        ClipCache.of_user()
        _check_rendering(*opengl_variables().items())


def _asked_entries(workspace: Workspace, parts: Parts) -> Iterator[Entry]:
    """Yield the models and judges of cells whose answers or votes are missing."""
    lineage = Lineage(workspace)
    for name, keys in parts.items():
        stage = the_graph()[name]
        if stage.cost != "money" or stage.scheme is None:
            continue
        for key in keys:
            if stage.table is RESPONSES:
                entries: Iterable[Entry] = [get_model(Cell.parse(str(key)).evaluation.model)]
            else:
                entries = load_panel(workspace.study.panel) if workspace.study.panel else ()
            network = [entry for entry in entries if entry.backend == NETWORK]
            if network and lineage.status(name, key).kind != "fresh":
                yield from network


@cache
def _check_rendering(*_: tuple[str, str]) -> None:
    """Check rendering once per process and set of variables."""
    check_rendering()
