"""Check in seconds, before a run, that the machine has what coming stages need."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from functools import cache
from typing import TYPE_CHECKING

from traps_pipeline.base.files import check_disk
from traps_pipeline.base.network import check_network
from traps_pipeline.models.asking.answer_rows import RESPONSES
from traps_pipeline.models.registry.entries import LOCAL, NETWORK, Entry, get_model
from traps_pipeline.models.registry.judges import load_panel
from traps_pipeline.pipeline.graph import Stage
from traps_pipeline.pipeline.run_plan import Parts, RunPlan
from traps_pipeline.protocol.cells import Cell
from traps_pipeline.scenes.picture.trial import check_rendering, opengl_variables
from traps_pipeline.scenes.worlds.clip_cache import ClipCache
from traps_pipeline.storage.workspace import Workspace

if TYPE_CHECKING:
    import dagster as dg

MIN_GB = 0.1  # less would run out before the first tables are written
MAX_PARTITIONS = 5  # partitions in a sentence
CLIPS = "mp4"  # the kind of a stage that renders


def parts_of_run(context: dg.AssetExecutionContext, stage: Stage, plan: RunPlan) -> Parts:
    """Return the wanted keys of each stage of a Dagster run whose partitions are those of this step."""
    keys = {str(key) for key in context.partition_keys} if stage.scheme else {None}
    asset_keys = context.run.asset_selection or context.job_def.asset_layer.executable_asset_keys
    names = {key.path[-1] for key in asset_keys}
    return {
        name: [key for key in wanted_keys if key in keys]
        for name, wanted_keys in plan.parts.items()
        if name in names and plan.graph[name].scheme is stage.scheme
    }


def nothing_to_do_reason(keys: Sequence[str | None], tags: Mapping[str, str], workspace: Workspace) -> str:
    """Return in words why a run whose keys are all unwanted has nothing to do."""
    if keys:
        return f"no experiment in {workspace.root / 'study.yaml'} asks for {', '.join(map(str, keys[:MAX_PARTITIONS]))}"
    first, last = (tags.get(f"dagster/asset_partition_range_{end}", "its end") for end in ("start", "end"))
    return f"no partition lies between {first} and {last}; exchange the two"


def require_machine(plan: RunPlan, parts: Parts | None = None) -> None:
    """Raise TrapsError unless this machine can build what a plan, or a part of it, still needs.

    Disk, OpenGL, codecs, proxies and certificates are checked as far as these partitions need them; the error names the
    first that is missing or that a variable breaks. A study whose clips exist needs no OpenGL, and one whose answers
    and votes exist needs no network.
    """
    workspace, graph, parts = plan.workspace, plan.graph, plan.parts if parts is None else parts
    check_disk(workspace.root, MIN_GB)
    if any(entry.backend == NETWORK for entry in pending_entries(plan, parts)):
        check_network()
    drawing = ((graph[name].shared, key) for name, keys in parts.items() for key in keys if CLIPS in graph[name].kinds)
    if any(build is not None and build.seconds(workspace, key) > 0 for build, key in drawing):
        ClipCache.of_user()
        _check_rendering(*opengl_variables().items())


def pending_entries(plan: RunPlan, parts: Parts) -> list[Entry]:
    """Return the models and judges, but for reference strategies, of cells whose answers or votes are missing."""
    pending, panel = dict[tuple[type[Entry], str], Entry](), plan.workspace.study.panel
    for name, keys in parts.items():
        stage = plan.graph[name]
        if stage.cost != "money" or stage.scheme is None:
            continue
        for key in keys:
            if stage.table is RESPONSES:
                entries: Iterable[Entry] = [get_model(Cell.parse(str(key)).evaluation.model)]
            else:
                entries = load_panel(panel) if panel else ()
            asked = {(type(entry), entry.id): entry for entry in entries if entry.backend in (LOCAL, NETWORK)}
            if asked.keys() - pending.keys() and plan.lineage.status(name, key).kind != "fresh":
                pending |= asked
    return [*pending.values()]


@cache
def _check_rendering(*_: tuple[str, str]) -> None:
    """Check rendering once per process and set of variables."""
    check_rendering()
