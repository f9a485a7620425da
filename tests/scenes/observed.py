"""What every family's observer says of its first released record: whole, cut short, mirrored, backwards.

The answers are frozen in `data/observed.json`. After a change that is meant to alter them:
`python -m tests.scenes.observed [family ...]`.
"""

from __future__ import annotations

import json
import sys
import tempfile
from pathlib import Path

import numpy as np

from tests.scenes.released import SAMPLED, Released, load
from traps_pipeline.benchmark.records import load_released
from traps_pipeline.scenes.family_registry import family_names
from traps_pipeline.scenes.picture.render import Renderer
from traps_pipeline.scenes.worlds.outcome import compile_scene
from traps_pipeline.video.encode import decode_sampled, encode

FROZEN = Path(__file__).parent / "data" / "observed.json"
PREFIXES = (8, 14, 20)  # frames of the control that an observer is shown besides the whole clip


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


def frozen() -> dict[str, dict[str, str | None]]:
    """Return the frozen answers by family."""
    return json.loads(FROZEN.read_text(encoding="utf-8"))


if __name__ == "__main__":
    answers, released = frozen(), load_released()
    for name in sys.argv[1:] or [name for name in family_names() if f"{name}-0001" in released]:
        answers[name] = observed(load(f"{name}-0001"))
        print(name, flush=True)
    FROZEN.write_text(json.dumps(answers, indent=1, sort_keys=True) + "\n", encoding="utf-8")
