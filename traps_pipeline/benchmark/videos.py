"""The videos stage: rows of scene_specs to clips and their table. What is rendered once is never rendered again."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from traps_pipeline import progress
from traps_pipeline.benchmark.specs import released_in_study, spec_of, trajectory_of
from traps_pipeline.benchmark.tables import SCENE_SPECS, VIDEOS, VideoRow
from traps_pipeline.benchmark.versions import clip_content, version_of
from traps_pipeline.errors import TrapsError
from traps_pipeline.scenes.clips import Job, note_of, read_clip, render_pairs
from traps_pipeline.scenes.encode import DamagedClip
from traps_pipeline.scenes.look import frame_size
from traps_pipeline.storage.workspace import Workspace

CLIPS = ("control", "void", "twin")


def build_videos(workspace: Workspace, category: str) -> tuple[list[VideoRow], int, dict[str, float]]:
    """Rows of the category's clips (three a scenario), frames drawn for them, leaked pixels of each occluded void."""
    specs: list[dict[str, Any]] = workspace.tables.read(SCENE_SPECS, {"category": category}).to_dict("records")
    jobs = [_job(workspace, row) for row in specs]
    files = [file for job in jobs for clip in job.clips for file in (clip, note_of(clip))]
    workspace.store.bring(files)
    drawn = 0
    try:
        for done, (_, frames) in enumerate(render_pairs(jobs), start=1):
            drawn += frames
            progress.current().tick("videos", f"{category}, scenarios", done, len(jobs))
        workspace.store.keep(files)
        version = version_of(
            (clip_content(id_, spec.scene_hash) for id_, spec in released_in_study(workspace, category).items()),
            (clip_content(row["scenario_id"], row["scene_hash"]) for row in specs),
        )
        rows = [row for spec, job in zip(specs, jobs, strict=True) for row in _rows(workspace, spec, job, version)]
        leaks = {job.spec.scenario_id: clip.leaked_pixels for job in jobs if (clip := read_clip(job.void))}
    except DamagedClip as error:
        raise TrapsError(str(error)) from error
    return rows, drawn, {id_: pixels for id_, pixels in leaks.items() if pixels is not None}


def _job(workspace: Workspace, row: dict[str, Any]) -> Job:
    spec = spec_of(row)
    control, void, twin = (workspace.clip(spec.scenario_id, side, row["scene_hash"]) for side in CLIPS)
    return Job(spec, trajectory_of(workspace, row), trajectory_of(workspace, row, "twin"), control, void, twin)


def _rows(workspace: Workspace, spec: dict[str, Any], job: Job, version: str) -> list[VideoRow]:
    rows, (width, height) = [], frame_size(job.spec.params)
    for side, path in zip(CLIPS, job.clips, strict=True):
        clip = read_clip(path)
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


def missing_clips(workspace: Workspace, category: str) -> Sequence[str]:
    """Clips of the category's table that are gone or have another size: reasons for `traps status`."""
    table = workspace.tables.read_arrow(VIDEOS, ["path", "size_bytes"], category=category)
    wanted = dict(zip(table["path"].to_pylist(), table["size_bytes"].to_pylist(), strict=True))
    notes = {path: workspace.relative(note_of(workspace.root / path)) for path in wanted}
    found = workspace.sizes([*wanted, *notes.values()])
    return [path for path, size in wanted.items() if found.get(path) != size or notes[path] not in found]
