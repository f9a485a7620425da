"""Render and certify, once, the clips of the arms (datasets beside the pairs) that a study asks for."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from traps_pipeline.base import progress
from traps_pipeline.base.digests import digest, file_digest
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.base.files import write_text
from traps_pipeline.benchmark.filmed_lanes import SECONDS_A_CLIP, film_lanes, lane_paths, lane_rows, lane_specs
from traps_pipeline.benchmark.sharing import RenderWork, Row, existing_clips, make_together
from traps_pipeline.benchmark.specs import clips_version, released_in_study, spec_of, spec_rows, trajectory_of
from traps_pipeline.protocol.datasets import ARMS as ARM_NAMES
from traps_pipeline.protocol.datasets import GRADED, RECORDED, TWO_EVENTS, arms_of_category, sides_of
from traps_pipeline.scenes.variants import arms as shortcut_arms
from traps_pipeline.scenes.variants import graded_cuts, variations
from traps_pipeline.scenes.variants.arms import ARMS as SHORTCUT_ARMS
from traps_pipeline.scenes.variants.arms import Arm, Question, Scenario
from traps_pipeline.scenes.variants.graded_cuts import GRADED_CUT
from traps_pipeline.scenes.variants.variations import VARIATIONS
from traps_pipeline.scenes.worlds.clip_notes import Clip, clip_note_path, read_clip, save_clip
from traps_pipeline.scenes.worlds.lane_records import TwoEventsSpec
from traps_pipeline.scenes.worlds.outcome import Rejected
from traps_pipeline.scenes.worlds.spec import SceneSpec
from traps_pipeline.storage.benchmark_tables import ARMS, VIDEOS, ArmRow
from traps_pipeline.storage.workspace import Workspace

ARMS_BY_NAME: Mapping[str, Arm] = {**SHORTCUT_ARMS, GRADED: GRADED_CUT, **VARIATIONS}
SECONDS_AN_ARM = 2.0  # mean of one core per arm, which is a clip, or two questions, or a proof that it is refused
_RESULT_SUFFIX = ".arm.json"  # suffix of the files with an arm's result


@dataclass(frozen=True)
class ArmResult:
    """The stored result of rendering an arm's clip; `of` is the digest of record and code."""

    of: str
    refused: str | None
    evidence: Mapping[str, Any]
    frames: int = 0

    @staticmethod
    def read(path: Path, of: str) -> ArmResult | None:
        """Return the result stored in a file if it is of this record and this code, else None."""
        if not path.is_file():
            return None
        result = ArmResult(**json.loads(path.read_text(encoding="utf-8")))
        return result if result.of == of else None


@dataclass(frozen=True)
class Job:
    """A scenario's clips of arms to render: paths by arm, and trajectories (F, nq)."""

    spec: SceneSpec
    qpos: np.ndarray
    twin: np.ndarray
    clips: Mapping[str, Path]


def asked_arms(workspace: Workspace, category: str) -> list[str]:
    """Return the names of a category's arms and variations that some experiment requests."""
    datasets = {dataset for experiment in workspace.study.experiments.values() for dataset in experiment.datasets}
    return [arm for arm in arms_of_category(category) if arm in datasets]


def arms_of_pairs(workspace: Workspace, category: str) -> list[str]:
    """Return the names of the requested arms whose clips are rendered from scenarios of pairs."""
    return [arm for arm in asked_arms(workspace, category) if arm != TWO_EVENTS]


def asked_lanes(workspace: Workspace, category: str) -> dict[str, TwoEventsSpec]:
    """Return by id a category's records of two events; none if no experiment requests them."""
    return lane_specs(workspace, category) if TWO_EVENTS in asked_arms(workspace, category) else {}


def film_arms(workspace: Workspace, category: str, *, wait: bool = True) -> tuple[int, bool]:
    """Render missing arms; return the number of frames drawn, and whether all exist. Raises TrapsError."""
    specs, arms = spec_rows(workspace, category), arms_of_pairs(workspace, category)

    def files(row: Row) -> list[Path]:
        return [file for clip in _clips(workspace, row, arms).values() for file in _files(clip)]

    def missing(rows: Sequence[Row]) -> list[Row]:
        all_files = [file for row in rows for file in files(row)]
        workspace.store.bring(file for file in all_files if file.name.endswith(_RESULT_SUFFIX))
        existing = workspace.store.there(all_files)
        return [row for row in rows if _is_missing(row, _clips(workspace, row, arms), existing)]

    def job(row: Row) -> Job | None:
        spec, clips = spec_of(row), _clips(workspace, row, arms)
        missing_clips = {arm: clip for arm, clip in clips.items() if not _is_made(spec, arm, clip)}
        if not missing_clips:
            return None
        return Job(spec, trajectory_of(workspace, row), trajectory_of(workspace, row, "twin"), missing_clips)

    def tick(finished: int) -> None:
        progress.current().tick("arms", f"{category}, scenarios", finished, len(specs))

    render_work = RenderWork(f"arms/{category}", missing, files, job, film)
    frames, is_whole = make_together(workspace.store, specs, render_work, tick, wait=wait)
    lane_frames, are_lanes_whole = film_lanes(workspace, category, asked_lanes(workspace, category), wait=wait)
    return frames + lane_frames, is_whole and are_lanes_whole


def seconds_left(workspace: Workspace, category: str) -> float:
    """Estimate one core's seconds to render missing arms of released records."""
    clips = [
        _finding_of(workspace.clip(id_, arm, spec.scene_hash))
        for id_, spec in released_in_study(workspace, category).items()
        for arm in arms_of_pairs(workspace, category)
    ]
    lanes = [spec for spec in asked_lanes(workspace, category).values() if spec.family != RECORDED]
    lane_clips = [path for spec in lanes for path in lane_paths(workspace, spec)]
    n_missing, n_missing_lanes = (len(paths) - len(workspace.store.there(paths)) for paths in (clips, lane_clips))
    return SECONDS_AN_ARM * n_missing + SECONDS_A_CLIP * n_missing_lanes


def build_arms(workspace: Workspace, category: str) -> list[ArmRow]:
    """Return a category's rows of the table of arms. Raises TrapsError for a missing or damaged clip."""
    specs, arms = spec_rows(workspace, category), arms_of_pairs(workspace, category)
    pair_clips = {
        (row["scenario_id"], row["side"]): row
        for row in workspace.tables.read(VIDEOS, {"category": category}).to_dict("records")
    }
    films = [clip for row in specs for clip in _clips(workspace, row, arms).values()]
    workspace.store.bring(map(_finding_of, films))
    clips = existing_clips(workspace.store, films)
    version = clips_version(workspace, category, specs)
    rows = [
        arm_row for row in specs for arm in arms for arm_row in _rows(workspace, row, arm, pair_clips, clips, version)
    ]
    return [*rows, *lane_rows(workspace, category, asked_lanes(workspace, category))]


def _clips(workspace: Workspace, row: Row, arms: Sequence[str]) -> dict[str, Path]:
    return {arm: workspace.clip(row["scenario_id"], arm, row["scene_hash"]) for arm in arms}


def _is_missing(row: Row, clips: Mapping[str, Path], existing: set[Path]) -> bool:
    """Return whether the study lacks files of these arms of a scenario."""
    spec = spec_of(row)
    for arm, clip in clips.items():
        result = ArmResult.read(_finding_of(clip), _record_digest(spec, arm)) if _finding_of(clip) in existing else None
        if result is None or (result.frames and not {clip, clip_note_path(clip)} <= existing):
            return True
    return False


def _finding_of(clip: Path) -> Path:
    return clip.with_suffix(_RESULT_SUFFIX)


def _files(clip: Path) -> tuple[Path, ...]:
    """Return an arm's files: its clip with the note (none if refused), and the result."""
    return clip, clip_note_path(clip), _finding_of(clip)


@cache
def _code(arm: str) -> str:
    """Return the code version of an arm or variation; a change renders it again."""
    declared_in = graded_cuts if arm == GRADED else shortcut_arms if arm in ARM_NAMES else variations
    return file_digest(Path(declared_in.__file__))


def _record_digest(spec: SceneSpec, arm: str) -> str:
    return digest([spec.spec_hash, arm, _code(arm)])[:24]


def _is_made(spec: SceneSpec, arm: str, clip: Path) -> bool:
    """Return whether an arm and its clip, if any, are complete. Raises DamagedClip."""
    result = ArmResult.read(_finding_of(clip), _record_digest(spec, arm))
    return result is not None and (not result.frames or read_clip(clip) is not None)


def film(job: Job) -> int:
    """Render and certify a scenario's missing clips of arms; return the number of frames drawn."""
    scenario, frame_count = Scenario.of_record(job.spec, job.qpos, job.twin), 0
    for arm, clip in job.clips.items():
        record_digest = _record_digest(job.spec, arm)
        try:
            variant = ARMS_BY_NAME[arm]
            variant.ask(job.spec)
            arm_clip = variant.film(scenario)
            if arm_clip.frames:
                frame_count += save_clip(clip, arm_clip.frames, scenario.fps)
            result = ArmResult(record_digest, None, arm_clip.evidence, len(arm_clip.frames))
        except Rejected as rejection:
            result = ArmResult(record_digest, str(rejection), {})
        write_text(_finding_of(clip), json.dumps(asdict(result)))
    return frame_count


def _rows(
    workspace: Workspace,
    row: Row,
    arm: str,
    of_pairs: Mapping[tuple[str, str], Row],
    clips: Mapping[Path, Clip],
    version: str,
) -> Iterator[ArmRow]:
    spec = spec_of(row)
    path = workspace.clip(spec.scenario_id, arm, row["scene_hash"])
    result, clip = ArmResult.read(_finding_of(path), _record_digest(spec, arm)), clips.get(path)
    if result is None or (result.frames and clip is None):
        raise TrapsError(f"{path}: was not filmed; run again")
    empty = ArmRow(
        scenario_id=spec.scenario_id,
        category=row["category"],
        arm=arm,
        item=sides_of(arm)[0],
        side=sides_of(arm)[0],
        question=spec.question,
        labels=list(spec.labels),
        ground_truth=None,
        refused=result.refused,
        evidence=json.dumps(result.evidence),
        clip=None,
        media_digest=None,
        n_frames=None,
        duration_s=None,
        scene_hash=row["scene_hash"],
        benchmark_version=version,
    )
    if result.refused is not None:
        yield replace(empty, ground_truth=None)
        return
    for question in ARMS_BY_NAME[arm].ask(spec):
        pair_side = question.clip
        if pair_side is not None:
            columns = _pair_clip_columns(of_pairs[spec.scenario_id, pair_side])
        else:
            assert clip is not None, "what shows a clip of its own has frames"
            columns = _clip_columns(workspace.relative(path), clip)
        yield replace(empty, **columns, **_question_columns(question, spec))


def _question_columns(question: Question, spec: SceneSpec) -> dict[str, Any]:
    words = {"question": question.text, "labels": list(question.labels or spec.labels)}
    return {"item": question.side, "side": question.side, "ground_truth": question.answer, **words}


def _clip_columns(path: str, clip: Clip) -> dict[str, Any]:
    return {"clip": path, "media_digest": clip.file_sha256, "n_frames": clip.n_frames, "duration_s": clip.duration_s}


def _pair_clip_columns(row: Row) -> dict[str, Any]:
    shown = {name: row[name] for name in ("n_frames", "duration_s")}
    return {"clip": row["path"], "media_digest": row["file_sha256"], **shown}


def incomplete_reasons(workspace: Workspace, category: str) -> list[str]:
    """Return in words why a category's table of arms is incomplete: a new arm or a lost clip."""
    rows = workspace.tables.read(ARMS, {"category": category}, ["arm", "clip"])
    arms_in_table = set(rows["arm"])
    expected = [*arms_of_pairs(workspace, category), *([TWO_EVENTS] if asked_lanes(workspace, category) else [])]
    reasons = [f"arm {arm} is asked for now" for arm in expected if arm not in arms_in_table]
    clips = sorted({str(clip) for clip in rows["clip"].dropna()})
    sizes = workspace.sizes(clips)
    return reasons + [f"clip {clip} is gone" for clip in clips if clip not in sizes]
