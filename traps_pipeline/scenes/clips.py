"""The two clips of a scenario, replayed from its frozen trajectory: nothing is simulated here.

Occluder: the void is the same replay with the cover panel drawn. Truncation: the void is a prefix of the control.
"""

from __future__ import annotations

import json
import os
import signal
import threading
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict, dataclass
from multiprocessing import get_context
from pathlib import Path

import numpy as np

from traps_pipeline.digests import file_digest
from traps_pipeline.errors import TrapsError
from traps_pipeline.scenes import checks
from traps_pipeline.scenes.camera import Camera, Panel
from traps_pipeline.scenes.encode import DamagedClip, encode, frames_digest
from traps_pipeline.scenes.kit import Physics
from traps_pipeline.scenes.outcome import compile_scene, decisive_geoms
from traps_pipeline.scenes.registry import get_family
from traps_pipeline.scenes.render import Renderer
from traps_pipeline.scenes.spec import SceneSpec

SCENES_A_WORKER = 100  # GL drivers leak: a worker draws so many, then another takes over
ABLATION_FRAMES = 5  # evenly spaced void frames that are drawn once more without what they must not show


@dataclass(frozen=True)
class Clip:
    """What is known of an encoded clip. leaked_pixels: void pixels that anything decisive still has (0, or the panel
    does not hide): from segmentation of every sampled frame and from ablation; None where there is no panel."""

    file_sha256: str
    frames_sha256: str
    n_frames: int
    fps: int
    size_bytes: int
    leaked_pixels: float | None = None

    @property
    def duration_s(self) -> float:
        """Seconds shown."""
        return self.n_frames / self.fps


@dataclass(frozen=True)
class Job:
    """A pair to render: record, trajectory, and where the clips go."""

    spec: SceneSpec
    qpos: np.ndarray
    control: Path
    void: Path


def note_of(clip: Path) -> Path:
    """The small JSON beside a clip that says what it is; written after it, so that it vouches for it."""
    return clip.with_suffix(".json")


def read_clip(path: Path) -> Clip | None:
    """The clip if it is rendered; None if not. Raises DamagedClip when the file is not what its note says."""
    if not path.is_file() or not note_of(path).is_file():
        return None
    try:
        clip = Clip(**json.loads(note_of(path).read_text(encoding="utf-8")))
    except (ValueError, TypeError) as error:
        raise DamagedClip(f"{note_of(path)}: is not what was written ({error}); delete it and run again") from error
    check_clip(path, clip.file_sha256, clip.size_bytes)
    return clip


def check_clip(path: Path, sha256: str, size_bytes: int) -> None:
    """Raises DamagedClip, naming the file and the remedy, unless it has that size and digest."""
    size = path.stat().st_size if path.is_file() else 0
    if size != size_bytes or file_digest(path) != sha256:
        raise DamagedClip(
            f"{path}: is not the clip that was rendered ({size} of {size_bytes} bytes; truncated or altered); "
            "delete it and run again: it is rendered anew"
        )


def rendered(path: Path) -> bool:
    """Whether a clip is there with the size its note says: a quick look, digests aside."""
    try:
        return path.stat().st_size == json.loads(note_of(path).read_text(encoding="utf-8"))["size_bytes"]
    except (OSError, ValueError, KeyError):
        return False


def render_pair(job: Job) -> int:
    """Render and encode what is missing of a pair; returns the number of frames drawn into clips."""
    missing = [path for path in (job.control, job.void) if read_clip(path) is None]
    if not missing:
        return 0
    spec, physics = job.spec, Physics(**job.spec.physics)
    panel = Panel.from_record(spec.void["panel"]) if spec.void_kind == "occluder" else None
    family = get_family(spec.family)

    model, scene = compile_scene(family, family.params_from(spec.params), physics, panel)
    drawn = 0
    with Renderer(model, Camera.from_record(spec.camera)) as renderer:
        control: list[np.ndarray] = []
        if job.control in missing or panel is None:
            control = list(renderer.frames(job.qpos))
            drawn += len(control)
        if job.control in missing:
            _save(job.control, control, physics.fps)
        if job.void in missing and panel is not None:
            void = list(renderer.frames(job.qpos, panel=True))
            drawn += len(void)
            geoms = [*decisive_geoms(model, scene.decisive), *scene.hidden]
            _save(job.void, void, physics.fps, _leaked_pixels(renderer, geoms, job))
        elif job.void in missing:
            _save(job.void, control[: spec.void["cut_frame"]], physics.fps)
    return drawn


def _leaked_pixels(renderer: Renderer, geoms: Sequence[str], job: Job) -> float:
    """Pixels that decisive bodies and the hidden element have in the void from hiding on: 0 if the panel hides."""
    hidden = np.arange(job.spec.void["hidden_from_frame"], len(job.qpos))
    ablated = np.unique(np.linspace(hidden[0], hidden[-1], ABLATION_FRAMES).astype(int))
    seen = renderer.visible_pixels(job.qpos[hidden[::2]], geoms, panel=True)
    return float(seen.sum()) + checks.ablation_pixels(renderer, job.qpos[ablated], geoms)


def _save(path: Path, frames: Sequence[np.ndarray], fps: int, leaked_pixels: float | None = None) -> None:
    encode(frames, path, fps)
    clip = Clip(file_digest(path), frames_digest(frames), len(frames), fps, path.stat().st_size, leaked_pixels)
    part = note_of(path).with_suffix(f".{os.getpid()}.part")
    try:
        part.write_text(json.dumps(asdict(clip)), encoding="utf-8")
        part.replace(note_of(path))
    except OSError as error:
        raise TrapsError(
            f"{note_of(path)}: cannot be written ({error.strerror}); free some space and run again"
        ) from error
    finally:
        part.unlink(missing_ok=True)


# --- many pairs -------------------------------------------------------------------------------------------------------


def render_pairs(jobs: Sequence[Job], workers: int | None = None) -> Iterator[tuple[Job, int]]:
    """Render pairs with one process a core; yields each job with its frames drawn as it is done.

    A GL context belongs to a process, so each worker keeps its own; workers are recycled, since drivers leak.
    """
    todo = [job for job in jobs if read_clip(job.control) is None or read_clip(job.void) is None]
    yield from ((job, 0) for job in jobs if job not in todo)
    if not todo:
        return
    workers = min(workers or len(os.sched_getaffinity(0)), len(todo))
    chunk = workers * SCENES_A_WORKER  # a fresh pool for each: recycling inside a pool can deadlock (CPython 3.11)
    for start in range(0, len(todo), chunk):
        yield from _render_chunk(todo[start : start + chunk], workers)


def _render_chunk(jobs: Sequence[Job], workers: int) -> Iterator[tuple[Job, int]]:
    context = get_context("spawn")
    pool = ProcessPoolExecutor(workers, mp_context=context, initializer=_begin_worker, initargs=(os.getpid(),))
    try:
        futures = {pool.submit(render_pair, job): job for job in jobs}
        for future in as_completed(futures):
            yield futures[future], future.result()
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


def _begin_worker(parent: int) -> None:
    """Leave Ctrl-C to the parent, and do not outlive it when it is killed."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(1.0)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()
