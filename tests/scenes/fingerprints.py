"""Digests of all that a scene family gives: its draws and words, its worlds, their readings, what its observer says.

The frozen digests lie in `data/families.json`; `test_fingerprints.py` compares them with what the code gives today.
To freeze them anew, after a change that is meant to alter scenes: `python -m tests.scenes.fingerprints [family ...]`.
"""

from __future__ import annotations

import hashlib
import json
import math
import platform
import sys
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from tests.scenes.released import SAMPLED, Released, load
from traps_pipeline.base.digests import canonical_json
from traps_pipeline.benchmark.records import load_released
from traps_pipeline.scenes.certification.certificates import legible_groups
from traps_pipeline.scenes.family_registry import family_names, get_family
from traps_pipeline.scenes.physics.kit import Family, Scene, params_to_dict
from traps_pipeline.scenes.physics.simulate import replay
from traps_pipeline.scenes.picture.render import Renderer
from traps_pipeline.scenes.worlds.outcome import compile_scene
from traps_pipeline.video.encode import decode_sampled, encode

if TYPE_CHECKING:
    import mujoco

FROZEN = Path(__file__).parent / "data" / "families.json"
DRAWS = 300
PREFIXES = (8, 14, 20)  # frames of the control that an observer is shown besides the whole clip
_PARTS_OF_MODEL = ("opt", "vis", "stat")


def short(*parts: bytes | str) -> str:
    """The first 12 hexadecimal digits of the SHA-256 of all parts."""
    sha = hashlib.sha256()
    for part in parts:
        sha.update(part.encode() if isinstance(part, str) else part)
    return sha.hexdigest()[:12]


def plain(value: Any) -> Any:
    """A value as JSON has it; -0.0 becomes 0.0, which no physics tells apart."""
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, Sequence) and not isinstance(value, str | bytes):
        return [plain(item) for item in value]
    if isinstance(value, np.ndarray):
        return plain(value.tolist())
    if isinstance(value, np.generic):
        value = value.item()
    return value + 0.0 if isinstance(value, float) else value


def in_floats(value: Any) -> Any:
    """A plain value whose numbers are floats: 0 and 0.0 are the same place."""
    if isinstance(value, dict):
        return {key: in_floats(item) for key, item in value.items()}
    if isinstance(value, list):
        return [in_floats(item) for item in value]
    return float(value) if isinstance(value, int) else value


def of_value(value: Any) -> str:
    """Digest of a JSON-able value."""
    return short(canonical_json(plain(value)))


# --- what the numbers depend on ---------------------------------------------------------------------------------------


def versions() -> dict[str, str]:
    """What equal digests need besides equal code. arithmetic: the last bits of this machine's elementary functions."""
    import mujoco

    grid = np.linspace(0.01, 0.99, 997)
    places = np.stack([grid, np.sin(grid), np.cos(grid)], axis=1)
    vectors = [f(grid) for f in (np.sin, np.cos, np.tan, np.arcsin, np.exp)]
    vectors += [np.hypot(grid, 1 - grid), places @ places[0], np.linalg.norm(places, axis=1)]
    scalars = [f(float(x)) for f in (math.sin, math.cos, math.tan, math.atan, math.exp) for x in grid]
    return {
        "mujoco": mujoco.__version__,
        "numpy": np.__version__,
        "machine": f"{platform.system()} {platform.machine()}",
        "arithmetic": short(*(v.tobytes() for v in vectors), np.array(scalars).tobytes()),
    }


# --- a compiled world -------------------------------------------------------------------------------------------------


@cache
def _array_names(kind: type) -> tuple[str, ...]:
    return tuple(name for name in dir(kind) if not name.startswith("_") and not callable(getattr(kind, name)))


def model_values(model: mujoco.MjModel) -> dict[str, Any]:
    """Every array and number of a compiled model by name, those of its options, look and statistics too."""
    found: dict[str, Any] = {}
    groups = {"": model, **{f"{part}.": getattr(model, part) for part in _PARTS_OF_MODEL}}
    groups |= {f"vis.{part}.": getattr(model.vis, part) for part in ("global_", "headlight", "map", "quality", "rgba")}
    for prefix, group in groups.items():
        for name in _array_names(type(group)):
            value = getattr(group, name)
            if isinstance(value, np.ndarray | int | float | bytes):
                found[prefix + name] = value
    return found


def of_model(model: mujoco.MjModel) -> str:
    """Digest of `model_values`."""
    parts: list[bytes | str] = []
    for name, value in sorted(model_values(model).items()):
        array = np.asarray(value)
        array = array + 0.0 if array.dtype.kind == "f" else array  # -0.0 becomes 0.0
        parts += [f"{name} {array.dtype} {array.shape}", array.tobytes()]
    return short(*parts)


def scene_roles(family: Family, scene: Scene) -> dict[str, Any]:
    """What a built scene says besides its model. Of an occlusion scene's colours and nouns only the set matters."""
    inventory = asdict(scene.inventory)
    if family.taxonomy == "occlusion":
        inventory |= {key: sorted(set(inventory[key])) for key in ("colours", "objects")}
    return {
        "view": asdict(scene.view),
        "decisive": scene.decisive,
        "hidden": scene.hidden,
        "cover": None if scene.cover is None else asdict(scene.cover),
        "stage": [asdict(box) for box in scene.framed],
        "velocity": scene.velocity,
        "inventory": inventory,
    }


def of_world(case: Released, twin: bool) -> dict[str, str]:
    """Digests of one world of a record: its compiled model, the roles of its parts, its reading, its twins."""
    family, physics = case.family, case.physics
    stored = case.spec.twin.params if twin else None
    params = case.params if stored is None else family.params_from(stored)
    model, scene = compile_scene(family, params, physics)
    motion = replay(model, case.twin if twin else case.qpos, physics)
    reading = family.outcome(motion, params)
    twins = [] if family.twins is None else [params_to_dict(other) for other in family.twins(params)]
    return {
        "model": of_model(model),
        "scene": of_value(in_floats(plain(scene_roles(family, scene)))),
        "outcome": of_value(
            [
                reading.labels,
                reading.margin_m,
                legible_groups(family, model, scene, motion, params),
            ]
        ),
        "twins": of_value(twins),
    }


def of_record(scenario_id: str) -> str:
    """Digests of a record's two worlds in one line: model, scene, outcome and twins, the twin's world second."""
    case = load(scenario_id)
    worlds = [of_world(case, twin=False), of_world(case, twin=True)]
    return " ".join(short(*(world[part] for world in worlds)) for part in ("model", "scene", "outcome", "twins"))


# --- a family ---------------------------------------------------------------------------------------------------------


def constants(family: Family) -> dict[str, Any]:
    """What a family says of itself once and for all."""
    names = ("name", "taxonomy", "category", "sub_scenario", "answer_type", "min_margin_m", "perturbation")
    values = {name: getattr(family, name) for name in names}
    return values | {"physics": asdict(family.physics), "questions": sorted(family.questions)}


def drawn(family: Family, seed: int) -> list[Any]:
    """Parameters and words of one seed, and a number that tells whether as much was drawn for them."""
    rng = np.random.default_rng(seed)
    params = family.draw(rng)
    return [params_to_dict(params), asdict(family.word(params, rng)), int(rng.integers(2**32))]


def of_family(name: str) -> dict[str, str]:
    """Digests of a family's constants and of 300 seeded draws with their words."""
    family = get_family(name)
    draws = [of_value(drawn(family, seed)) for seed in range(DRAWS)]
    return {"constants": of_value(constants(family)), "draws": short(*draws)}


def records_of(name: str) -> list[str]:
    """Ids of a family's released records."""
    return sorted(id_ for id_, spec in load_released().items() if spec.family == name)


def observed(case: Released) -> dict[str, str | None]:
    """What a family's observer says of a record's sampled frames, encoded and decoded, whole and cut short."""
    observe, question, physics = case.family.observe, case.spec.question, case.physics
    assert observe is not None
    stored = case.spec.twin.params
    twin, _ = compile_scene(case.family, case.params if stored is None else case.family.params_from(stored), physics)
    with Renderer(twin, case.camera) as renderer:
        other = list(renderer.frames(case.twin[SAMPLED]))
    clips = {"control": case.control_frames, "twin": other, "void": case.void}
    said: dict[str, str | None] = {}
    with tempfile.TemporaryDirectory() as folder:
        for clip, frames in clips.items():
            path = Path(folder) / f"{clip}.mp4"
            encode([*frames], path, physics.fps // SAMPLED.step)
            sampled = decode_sampled(path)
            said[clip] = observe(sampled, question)
            if clip == "control":
                said |= {f"control[:{n}]": observe(sampled[:n], question) for n in PREFIXES}
                said["control, mirrored"] = observe(np.ascontiguousarray(sampled[:, :, ::-1]), question)
                said["control, backwards"] = observe(sampled[::-1], question)
                said["control, another question"] = observe(sampled, case.spec.ill_posed_question)
    return said


def frozen() -> dict[str, Any]:
    """The frozen digests: `versions` and, by family, `constants`, `draws`, `records` (by id) and `observed`."""
    return json.loads(FROZEN.read_text(encoding="utf-8"))


def freeze(names: Sequence[str]) -> None:
    """Write the digests of some families; those of others stay."""
    known = frozen()["families"] if FROZEN.is_file() else {}
    for name in names:
        records = {scenario_id: of_record(scenario_id) for scenario_id in records_of(name)}
        known[name] = of_family(name) | {"records": records, "observed": observed(load(records_of(name)[0]))}
        print(f"{name}: {len(records)} records, {DRAWS} draws", flush=True)
        text = json.dumps({"versions": versions(), "families": known}, indent=1, sort_keys=True)
        FROZEN.parent.mkdir(exist_ok=True)
        FROZEN.write_text(text + "\n", encoding="utf-8")


if __name__ == "__main__":
    freeze(sys.argv[1:] or [name for name in family_names() if records_of(name)])
