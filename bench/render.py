"""Our rendering against stock `mujoco.Renderer` with 4x MSAA, and the videos stage against its OpenGL calls alone: the
same scenes, the same size, one run.

python bench/render.py
"""

from __future__ import annotations

import argparse
import os
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Literal

os.environ.setdefault("MUJOCO_GL", "osmesa")  # MuJoCo reads it when it is first imported

import mujoco
import numpy as np

from bench.quick import parse
from traps_pipeline.base.paths import RELEASED
from traps_pipeline.base.workers import run_in_order
from traps_pipeline.benchmark.records import load_released
from traps_pipeline.scenes.family_registry import get_family
from traps_pipeline.scenes.physics.kit import Physics
from traps_pipeline.scenes.picture.camera import HEIGHT, WIDTH, Camera
from traps_pipeline.scenes.picture.render import Renderer
from traps_pipeline.scenes.worlds.clips import Job, render_pair
from traps_pipeline.scenes.worlds.outcome import compile_scene
from traps_pipeline.scenes.worlds.spec import SceneSpec, load_trajectory

SCENES = ("domino_chain-0001", "hidden_race-0001", "plinko-0001", "seesaw_sorter-0001", "tumbling_dice-0001")


def _qpos(spec: SceneSpec, world: Literal["qpos", "twin"] = "qpos") -> np.ndarray:
    digest = spec.trajectory_sha256 if world == "qpos" else spec.twin.trajectory_sha256
    return load_trajectory(RELEASED / "trajectories" / f"{spec.scenario_id}.npz", digest, world)


def _model(spec: SceneSpec) -> mujoco.MjModel:
    family = get_family(spec.family)
    return compile_scene(family, family.params_from(spec.params), Physics(**spec.physics))[0]


def ours(spec: SceneSpec) -> int:
    """Return the frames of the control as the videos stage draws them; how many."""
    with Renderer(_model(spec), Camera.from_record(spec.camera)) as renderer:
        return sum(1 for _ in renderer.frames(_qpos(spec)))


def stock(spec: SceneSpec) -> int:
    """Return the same frames through `mujoco.Renderer`, as MuJoCo's own tutorial draws them; how many."""
    model, camera, qpos = _model(spec), Camera.from_record(spec.camera), _qpos(spec)
    model.vis.quality.offsamples = 4
    data = mujoco.MjData(model)
    view = mujoco.MjvCamera()
    view.lookat[:], view.distance = camera.lookat, camera.distance
    view.azimuth, view.elevation = camera.azimuth_deg, camera.elevation_deg
    with mujoco.Renderer(model, HEIGHT, WIDTH) as renderer:
        for row in qpos:
            data.qpos[:] = row
            mujoco.mj_forward(model, data)
            renderer.update_scene(data, view)
            renderer.render()
    return len(qpos)


def _rate(draw: Callable[[], int]) -> float:
    began = time.perf_counter()
    return draw() / (time.perf_counter() - began)


def _on_all_cores(specs: list[SceneSpec]) -> int:
    return sum(frames for _, frames in run_in_order(ours, specs))


@contextmanager
def _gl_seconds() -> Iterator[list[float]]:
    """Seconds inside OpenGL draw calls while the context is open, drawing included that the driver would put off."""
    from OpenGL import GL

    module: Any = mujoco
    spent, draw = [0.0], module.mjr_render

    def timed(*args: object) -> None:
        began = time.perf_counter()
        draw(*args)
        GL.glFinish()
        spent[0] += time.perf_counter() - began

    module.mjr_render = timed
    try:
        yield spent
    finally:
        module.mjr_render = draw


def stage_against_gl(specs: list[SceneSpec]) -> float:
    """Time of the videos stage (control, void, twin, checks, encoding) over the time inside its draw calls."""
    with tempfile.TemporaryDirectory() as folder, _gl_seconds() as gl:
        began = time.perf_counter()
        for spec in specs:
            clips = [Path(folder) / f"{spec.scenario_id}-{side}.mp4" for side in ("control", "void", "twin")]
            render_pair(Job(spec, _qpos(spec), _qpos(spec, "twin"), clips[0], clips[1], clips[2]))
        return (time.perf_counter() - began) / gl[0]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenes", type=int, default=len(SCENES))
    specs = [load_released()[name] for name in SCENES[: parse(parser, scenes=1).scenes]]
    for draw in (ours, stock):
        draw(specs[0])  # first use opens contexts and compiles shaders
    print(f"frames a second at {WIDTH} x {HEIGHT}")
    print(f"{'scene':<22} {'ours':>7} {'stock 4x MSAA':>15} {'ratio':>7}")
    seconds = {"ours": 0.0, "stock": 0.0}
    for spec in specs:
        a, b = _rate(lambda: ours(spec)), _rate(lambda: stock(spec))  # noqa: B023 (called at once)
        seconds = {"ours": seconds["ours"] + 1 / a, "stock": seconds["stock"] + 1 / b}
        print(f"{spec.scenario_id:<22} {a:>7.1f} {b:>15.1f} {a / b:>7.2f}")
    one, stock_rate = len(specs) / seconds["ours"], len(specs) / seconds["stock"]
    print(f"{'one process':<22} {one:>7.1f} {stock_rate:>15.1f} {one / stock_rate:>7.2f}")
    all_cores = _rate(lambda: _on_all_cores(specs * 8))
    cores = f"{len(os.sched_getaffinity(0))} processes"
    print(f"{cores:<22} {all_cores:>7.1f} {stock_rate:>15.1f} {all_cores / stock_rate:>7.2f}  (stock: one process)")
    print(f"videos stage / its OpenGL draw calls: {stage_against_gl(specs):.2f}")


if __name__ == "__main__":
    main()
