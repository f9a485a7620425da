"""Frames a second of our renderer against stock `mujoco.Renderer` with 4x MSAA, same scenes, same size, one run.

python bench/render.py
"""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np

from traps_pipeline.benchmark.records import load_released
from traps_pipeline.paths import RELEASED
from traps_pipeline.scenes.camera import HEIGHT, WIDTH, Camera
from traps_pipeline.scenes.kit import Physics
from traps_pipeline.scenes.outcome import compile_scene
from traps_pipeline.scenes.registry import get_family
from traps_pipeline.scenes.render import Renderer
from traps_pipeline.scenes.spec import SceneSpec, load_trajectory

SCENES = ("domino_chain-0001", "hidden_race-0001", "plinko-0001", "tumbling_dice-0001")
FRAMES = 20


def _scene(spec: SceneSpec) -> tuple[object, Camera, np.ndarray]:
    family = get_family(spec.family)
    model, _ = compile_scene(family, family.params_from(spec.params), Physics(**spec.physics))
    camera = Camera.from_record(spec.camera)
    qpos = load_trajectory(RELEASED / "trajectories" / f"{spec.scenario_id}.npz", spec.trajectory_sha256)
    return model, camera, qpos[:FRAMES]


def ours(spec: SceneSpec) -> None:
    model, camera, qpos = _scene(spec)
    with Renderer(model, camera) as renderer:  # type: ignore[arg-type]
        for _ in renderer.frames(qpos):
            pass


def stock(spec: SceneSpec) -> None:
    import mujoco

    model, camera, qpos = _scene(spec)
    model.vis.quality.offsamples = 4  # type: ignore[attr-defined]
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


def _seconds(render: Callable[[SceneSpec], None], spec: SceneSpec) -> float:
    began = time.perf_counter()
    render(spec)
    return time.perf_counter() - began


def main() -> None:
    specs = [load_released()[name] for name in SCENES]
    for render in (ours, stock):
        render(specs[0])  # first use compiles and opens contexts
    totals = {"ours": 0.0, "stock": 0.0}
    print(f"{'scene':<22} {'ours, frames/s':>15} {'stock 4x MSAA':>15} {'ratio':>7}")
    for spec in specs:
        a, b = _seconds(ours, spec), _seconds(stock, spec)
        totals["ours"], totals["stock"] = totals["ours"] + a, totals["stock"] + b
        print(f"{spec.scenario_id:<22} {FRAMES / a:>15.1f} {FRAMES / b:>15.1f} {b / a:>7.2f}")
    print(f"ratio over all scenes: {totals['stock'] / totals['ours']:.2f}")


if __name__ == "__main__":
    main()
