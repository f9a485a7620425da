"""Render scenarios to clips, each once, and build the table of clips."""

import json
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path

from traps_pipeline.base import progress
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.base.paths import RELEASED
from traps_pipeline.benchmark.recorded_clips import copy_clips
from traps_pipeline.benchmark.sharing import RenderWork, Row, existing_clips, make_together
from traps_pipeline.benchmark.specs import clips_version, released_in_study, spec_of, spec_rows, trajectory_of
from traps_pipeline.protocol.datasets import RECORDED
from traps_pipeline.scenes.parts.look import frame_size
from traps_pipeline.scenes.worlds.clip_cache import ClipCache
from traps_pipeline.scenes.worlds.clip_notes import Clip, clip_note_path, read_clip
from traps_pipeline.scenes.worlds.clips import Job, render_pair
from traps_pipeline.storage.benchmark_tables import VideoRow
from traps_pipeline.storage.workspace import Workspace

CLIPS = ("control", "void", "twin")
SECONDS_A_CLIP = 1.4  # measured on one core (docs/engineering-notes.md)


def render_videos(workspace: Workspace, category: str, *, wait: bool = True) -> tuple[int, bool]:
    """Render missing clips; return the number of frames drawn, and whether all exist. Raises TrapsError."""
    specs = spec_rows(workspace, category)

    def missing(rows: Sequence[Row]) -> list[Row]:
        existing = workspace.store.there(file for row in rows for file in _files(workspace, row))
        return [row for row in rows if not existing.issuperset(_files(workspace, row))]

    cache = ClipCache.of_user()

    def is_here(clip: Path, row: Row) -> bool:
        return read_clip(clip) is not None or (cache is not None and cache.bring(clip, row["scene_hash"]))

    def job(row: Row) -> Job | None:
        if row["family"] == RECORDED:
            copy_clips(RELEASED, row["scenario_id"], json.loads(row["params"])["clips"], _clips(workspace, row))
            return None
        are_here = [is_here(clip, row) for clip in _clips(workspace, row).values()]
        return None if all(are_here) else _job(workspace, row)

    tick = partial(_tick, category, len(specs))
    rendering = RenderWork(f"videos/{category}", missing, partial(_files, workspace), job, _render)
    frames, is_whole = make_together(workspace.store, specs, rendering, tick, wait=wait)
    if frames and cache is not None:
        cache.trim()
    return frames, is_whole


def _render(job: Job) -> int:
    """Render a scenario's missing clips, cached for other studies; return frame count."""
    frames, cache = render_pair(job), ClipCache.of_user()
    if cache is not None:
        cache.keep(job.clips, job.spec.scene_hash)
    return frames


def seconds_left(workspace: Workspace, category: str) -> float:
    """Estimate one core's seconds to render missing clips of released records."""
    clips = [
        workspace.clip(id_, side, spec.scene_hash)
        for id_, spec in released_in_study(workspace, category).items()
        for side in (CLIPS if not spec.is_recorded else ())
    ]
    return SECONDS_A_CLIP * (len(clips) - len(workspace.store.there(clips)))


def build_videos(workspace: Workspace, category: str) -> tuple[list[VideoRow], dict[str, float]]:
    """Return a category's VIDEOS rows, and leaked pixels by void with an occluder. Raises TrapsError without a clip."""
    specs = spec_rows(workspace, category)
    clips = existing_clips(workspace.store, (clip for row in specs for clip in _clips(workspace, row).values()))
    version = clips_version(workspace, category, specs)
    rows = [row for spec in specs for row in _rows(workspace, spec, clips, version)]
    voids = {row["scenario_id"]: clips[_clips(workspace, row)["void"]].leaked_pixels for row in specs}
    return rows, {id_: pixels for id_, pixels in voids.items() if pixels is not None}


def _tick(category: str, total: int, finished: int) -> None:
    progress.current().tick("videos", f"{category}, scenarios", finished, total)


def _clips(workspace: Workspace, row: Row) -> dict[str, Path]:
    """Return a scenario's clips by side: a recorded one may lack a twin."""
    recorded = json.loads(row["params"])["clips"] if row["family"] == RECORDED else CLIPS
    return {s: workspace.clip(row["scenario_id"], s, row["scene_hash"]) for s in CLIPS if s in recorded}


def _files(workspace: Workspace, row: Row) -> list[Path]:
    return [file for clip in _clips(workspace, row).values() for file in (clip, clip_note_path(clip))]


def _job(workspace: Workspace, row: Row) -> Job:
    trajectories = trajectory_of(workspace, row), trajectory_of(workspace, row, "twin")
    return Job(spec_of(row), *trajectories, *_clips(workspace, row).values())


def _rows(workspace: Workspace, spec: Row, clips: Mapping[Path, Clip], version: str) -> list[VideoRow]:
    params = json.loads(spec["params"])
    rows, (width, height) = [], params["size"] if spec["family"] == RECORDED else frame_size(params)
    for side, path in _clips(workspace, spec).items():
        clip = clips.get(path)
        if clip is None:
            raise TrapsError(f"{path}: was not rendered; run again")
        rows.append(
            VideoRow(
                scenario_id=spec["scenario_id"],
                category=spec["category"],
                side=side,
                path=workspace.relative(path),
                file_sha256=clip.file_sha256,
                frames_sha256=clip.frames_sha256,
                n_frames=clip.n_frames,
                fps=clip.fps,
                width=width,
                height=height,
                duration_s=clip.duration_s,
                size_bytes=clip.size_bytes,
                scene_hash=spec["scene_hash"],
                benchmark_version=version,
            )
        )
    return rows
