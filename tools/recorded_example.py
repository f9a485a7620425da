"""The example of recorded pairs, docs/recorded_example: released scenes, filmed as by a hand-held camera.

`python -m tools.recorded_example` writes it anew. No package brings real video under a free licence, so the simulator
films: its own frames, without boards, shaken, in a warmer light, 320x240.
"""

from __future__ import annotations

import csv
from pathlib import Path

import cv2
import numpy as np

from traps_pipeline.base.paths import RELEASED
from traps_pipeline.benchmark.records import load_released
from traps_pipeline.scenes.family_registry import get_family
from traps_pipeline.scenes.physics.kit import Physics
from traps_pipeline.scenes.picture.camera import Camera, Occluder
from traps_pipeline.scenes.picture.render import Renderer
from traps_pipeline.scenes.worlds.outcome import compile_scene
from traps_pipeline.scenes.worlds.spec import SceneSpec, load_trajectory

FOLDER = Path(__file__).parents[1] / "docs" / "recorded_example"
COVERED = (
    "domino_chain-0002",
    "domino_chain-0005",
    "hidden_race-0001",
    "hidden_race-0004",
    "ramp_gap-0001",
    "head_on-0001",
)
CUT = ("plinko-0001", "plinko-0004", "tumbling_dice-0002", "tumbling_dice-0006")
OTHER_CLIP = ("hidden_drop-0001", "hidden_drop-0002")
SIZE, RATE, SHAKE_PX, MARGIN_PX = (320, 240), 20, 3, 6
TINT = np.array([1.0, 0.95, 0.84])


def world(spec: SceneSpec, name: str, occluder: Occluder | None = None) -> list[np.ndarray]:
    """Return frames of the record's world (`qpos`) or of its twin's (`twin`), behind the occluder if one is given."""
    family, physics = get_family(spec.family), Physics(**spec.physics)
    params = spec.twin.params if name == "twin" and spec.twin.params is not None else spec.params
    sha256 = spec.trajectory_sha256 if name == "qpos" else spec.twin.trajectory_sha256
    qpos = load_trajectory(
        RELEASED / "trajectories" / f"{spec.scenario_id}.npz", sha256, "twin" if name == "twin" else "qpos"
    )
    model, _ = compile_scene(family, family.params_from(params), physics, occluder)
    with Renderer(model, Camera.from_record(spec.camera)) as renderer:
        return list(renderer.frames(qpos, occluder=occluder is not None))


def film(frames: list[np.ndarray], path: Path, seed: int, *, lossless: bool) -> None:
    """Encode frames as a hand-held camera sees them; equal frames give equal pixels, whatever comes later."""
    import av

    rng = np.random.default_rng(seed)
    way = np.cumsum(rng.integers(-1, 2, (len(frames), 2)), axis=0).clip(-SHAKE_PX, SHAKE_PX)
    options = {"qp": "0" if lossless else "26", "preset": "veryslow", "x264-params": "bframes=0:scenecut=0:mbtree=0"}
    with av.open(str(path), "w") as file:
        stream = file.add_stream("libx264", rate=RATE, options=options)
        stream.width, stream.height, stream.pix_fmt = *SIZE, "yuv420p"
        for frame, (right, down) in zip(frames, way, strict=True):
            shaken = cv2.warpAffine(
                cv2.resize(frame, SIZE, interpolation=cv2.INTER_AREA),
                np.array([[1, 0, right], [0, 1, down]], float),
                SIZE,
                borderMode=cv2.BORDER_REPLICATE,
            )
            picture = av.VideoFrame.from_ndarray((shaken * TINT).astype(np.uint8), format="rgb24")
            for _ in range(RATE // 10):
                file.mux(stream.encode(picture))
        file.mux(stream.encode(None))


def part(spec: SceneSpec) -> str:
    """Return the part of the picture that hides what decides: x y width height."""
    corners = Camera.from_record(spec.camera).project(Occluder.from_record(spec.void["panel"]).corners())
    low, high = corners.min(axis=0) / 1.5 - MARGIN_PX - SHAKE_PX, corners.max(axis=0) / 1.5 + MARGIN_PX + SHAKE_PX
    (x, y), (right, bottom) = np.clip(low, 0, SIZE).astype(int), np.clip(high, 0, SIZE).astype(int)
    return f"{x} {y} {right - x} {bottom - y}"


def main() -> None:
    """Write the clips and pairs.csv."""
    FOLDER.mkdir(parents=True, exist_ok=True)
    specs, rows = load_released(), list[dict[str, str]]()
    for number, id_ in enumerate((*COVERED, *CUT, *OTHER_CLIP), start=1):
        spec, name = specs[id_], f"clip{number:02d}"
        row = {
            "id": f"toys-{number:04d}", "category": spec.sub_scenario.replace("_", " "), "control": f"{name}.mp4",
            "question": spec.question, "choices": "|".join(spec.labels), "answer": spec.ground_truth,
            "aliases": "|".join(f"{other}={label}" for other, label in spec.aliases.items()),
            "ill_posed_question": spec.ill_posed_question, "source": f"TRAPSBench 0.3.0, {id_}", "licence": "CC-BY-4.0",
        }  # fmt: skip
        film(world(spec, "qpos"), FOLDER / f"{name}.mp4", number, lossless=id_ in COVERED)
        if id_ in OTHER_CLIP:
            row["void"] = f"{name}-void.mp4"
            film(
                world(spec, "qpos", Occluder.from_record(spec.void["panel"])),
                FOLDER / row["void"],
                number,
                lossless=False,
            )
        else:
            row |= {"twin": f"{name}-twin.mp4", "twin_answer": spec.twin.ground_truth}
            film(world(spec, "twin"), FOLDER / row["twin"], number, lossless=id_ in COVERED)
        if id_ in CUT:
            row["cut_s"] = f"{spec.void['cut_frame'] / 10:g}"
        elif id_ in COVERED:
            row["cover"] = f"0 5 {part(spec)}"
            if number % 2 and spec.closes_frame is not None:
                row["control_cover"] = f"{spec.closes_frame / 10:g} 5 {part(spec)}"
        rows.append(row)
    with (FOLDER / "pairs.csv").open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, [*dict.fromkeys(name for row in rows for name in row)], lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


if __name__ == "__main__":
    main()
