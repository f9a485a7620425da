"""Render scenarios of two events, four clips each, and make their rows of the arms table."""

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from traps_pipeline.base import progress
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.base.paths import TWO_EVENTS_RELEASED
from traps_pipeline.benchmark.corrections import load_two_events, of_study
from traps_pipeline.benchmark.recorded_clips import copy_clips
from traps_pipeline.benchmark.records import two_events_lines
from traps_pipeline.benchmark.sharing import RenderWork, Row, existing_clips, make_together
from traps_pipeline.benchmark.versions import version_of
from traps_pipeline.protocol.datasets import TWO_EVENTS
from traps_pipeline.protocol.two_events import CLIPS, LANES
from traps_pipeline.scenes.picture.render import Renderer
from traps_pipeline.scenes.worlds.clip_notes import clip_note_path, read_clip, save_clip
from traps_pipeline.scenes.worlds.lane_records import RecordedEvents, TwoEventsSpec
from traps_pipeline.scenes.worlds.spec import load_trajectory
from traps_pipeline.storage.benchmark_tables import ArmRow
from traps_pipeline.storage.workspace import Workspace

SECONDS_A_CLIP = 1.9  # measured on one core (docs/engineering-notes.md)


@dataclass(frozen=True)
class LaneJob:
    """A scenario's missing clips, by the lanes that boards hide in them, and its trajectory (F, nq)."""

    spec: TwoEventsSpec
    qpos: np.ndarray
    clips: Mapping[str, Path]


def lane_specs(workspace: Workspace, category: str) -> dict[str, TwoEventsSpec]:
    """Return by id a category's records of two events in the study, after corrections."""
    scenarios = load_two_events(workspace.study).items()
    return {id_: scenario.spec for id_, scenario in scenarios if scenario.category == category}


def lanes_version(workspace: Workspace, categories: Sequence[str]) -> str:
    """Return the version (digest) of some categories' records of two events."""
    released = of_study(two_events_lines(), workspace.study, two_events_lines())
    current = [spec for category in categories for spec in lane_specs(workspace, category).values()]
    return version_of(
        (line.spec.spec_hash for line in released.values() if line.category in categories),
        (spec.spec_hash for spec in current),
    )


def trajectories_of(spec: TwoEventsSpec, path: Path | None = None) -> dict[str, np.ndarray]:
    """Return a record's trajectories by name: `qpos`, and those where a lane differs. Raises ValueError.

    path: of their file, by default the released one.
    """
    path = path or TWO_EVENTS_RELEASED / "trajectories" / f"{spec.scenario_id}.npz"
    digests = {"qpos": spec.trajectory_sha256}
    digests |= {lane: record.twin.trajectory_sha256 for lane, record in zip(LANES, spec.lanes, strict=True)}
    return {world: load_trajectory(path, sha256, world) for world, sha256 in digests.items()}


def film_lanes(
    workspace: Workspace, category: str, specs: Mapping[str, TwoEventsSpec], *, wait: bool
) -> tuple[int, bool]:
    """Render missing clips; return the number of frames drawn, and whether all exist. Raises TrapsError."""
    rows: list[Row] = [{"scenario_id": id_} for id_ in specs]

    def files(row: Row) -> list[Path]:
        clips = lane_paths(workspace, specs[row["scenario_id"]])
        return [file for clip in clips for file in (clip, clip_note_path(clip))]

    def missing(rows: Sequence[Row]) -> list[Row]:
        existing = workspace.store.there(file for row in rows for file in files(row))
        return [row for row in rows if not existing.issuperset(files(row))]

    def job(row: Row) -> LaneJob | None:
        spec = specs[row["scenario_id"]]
        if isinstance(spec, RecordedEvents):
            copy_clips(TWO_EVENTS_RELEASED, spec.scenario_id, spec.clips, _clips(workspace, spec))
            return None
        clips = {name: clip for name, clip in _clips(workspace, spec).items() if read_clip(clip) is None}
        try:
            return LaneJob(spec, trajectories_of(spec)["qpos"], clips) if clips else None
        except ValueError as error:
            raise TrapsError(str(error)) from error

    def tick(finished: int) -> None:
        progress.current().tick("arms", f"{category}, scenarios of two events", finished, len(rows))

    return make_together(
        workspace.store, rows, RenderWork(f"{TWO_EVENTS}/{category}", missing, files, job, film), tick, wait=wait
    )


def film(job: LaneJob) -> int:
    """Render a scenario's missing clips; return the number of frames drawn."""
    world = job.spec.world(job.qpos)
    with Renderer(world.model, world.camera) as renderer:
        return sum(
            save_clip(path, [*renderer.frames(world.clip(CLIPS[name]))], world.physics.fps)
            for name, path in job.clips.items()
        )


def lane_rows(workspace: Workspace, category: str, specs: Mapping[str, TwoEventsSpec]) -> Iterator[ArmRow]:
    """Yield the eight rows of each record of two events. Raises TrapsError for a missing or damaged clip."""
    version = lanes_version(workspace, [category])
    clips = existing_clips(workspace.store, [path for spec in specs.values() for path in lane_paths(workspace, spec)])
    for spec in specs.values():
        for asked in spec.questions():
            path = _clips(workspace, spec)[asked.item.clip]
            if path not in clips:
                raise TrapsError(f"{path}: was not rendered; run again")
            yield ArmRow(
                scenario_id=spec.scenario_id,
                category=category,
                arm=TWO_EVENTS,
                item=asked.item.name,
                side=asked.item.side,
                question=asked.text,
                labels=list(spec.labels),
                ground_truth=asked.answer,
                refused=None,
                evidence=json.dumps(_evidence(spec, asked.item.lane)),
                clip=workspace.relative(path),
                media_digest=clips[path].file_sha256,
                n_frames=clips[path].n_frames,
                duration_s=clips[path].duration_s,
                scene_hash=spec.scene_hash,
                benchmark_version=version,
            )


def _evidence(spec: TwoEventsSpec, lane: str) -> dict[str, Any]:
    """Return the numbers behind a lane's certificate, and between which frames the board stands that comes and goes."""
    k = LANES.index(lane)
    if isinstance(spec, RecordedEvents):
        return spec.lanes[k].model_dump(mode="json") | {"fps": spec.physics["fps"]}
    numbers = {name: spec.evidence[name][k] for name in ("settled_frames", "least_px", "hidden_from")}
    return numbers | {"fps": spec.physics["fps"], "stands": spec.lanes[k].lane.timetable.spans}


def _clips(workspace: Workspace, spec: TwoEventsSpec) -> dict[str, Path]:
    return {name: workspace.clip(spec.scenario_id, name, spec.scene_hash) for name in CLIPS}


def lane_paths(workspace: Workspace, spec: TwoEventsSpec) -> list[Path]:
    """Return the paths of the four clips of a record of two events."""
    return [*_clips(workspace, spec).values()]
