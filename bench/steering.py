"""A sheet of steered answers, every prompt along every direction at every dose: the shipped path against the plain one.

    python bench/steering.py [--model ID] [--prompts 8] [--directions 8]

Plain: one batch for each direction and dose, which shows the vision tower every clip again. Shipped: rows of all
directions and doses share batches, and the vision tower sees each clip once (`models/local/clips.py`). Answers must be
equal, token by token. Times are CPU seconds of this process, so that a loaded machine hardly matters; on a GPU they are
seconds.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from itertools import product

import numpy as np

from traps_pipeline.mechanism.hook import Steering
from traps_pipeline.models.local.adapter import Generated, load_local_model
from traps_pipeline.models.prompts import system_prompt
from traps_pipeline.models.registry import get_model
from traps_pipeline.scenes.camera import HEIGHT, WIDTH
from traps_pipeline.storage.media import pick, resized

ALPHAS, NEW_TOKENS = (-40.0, 5.0, 40.0), 24
CLIP_S = np.arange(50) / 10  # a clip of five seconds
ROWS = 64  # of a shipped batch


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--model", default="pocket", help="a local model of the registry")
    parser.add_argument("--prompts", type=int, default=8)
    parser.add_argument("--directions", type=int, default=8)
    chosen = parser.parse_args()
    entry = get_model(chosen.model)
    assert entry.media is not None
    spec, model = entry.media, load_local_model(entry, inside=True)
    rng, times = np.random.default_rng(0), CLIP_S[pick(CLIP_S, spec)]
    prompts = []
    for number in range(chosen.prompts):
        frames = rng.integers(0, 256, (len(times), HEIGHT, WIDTH, 3), dtype=np.uint8)
        asked = f"Does the ball end up left or right of the wall, in clip {number}?"
        prompts.append(model.prompt(system_prompt("standard"), asked, resized(frames, spec.size), times))
    drawn = rng.normal(size=(chosen.directions, model.d_model))
    vectors = (drawn / np.linalg.norm(drawn, axis=1, keepdims=True)).astype(np.float32)
    layer = max(1, model.n_layers // 2)
    sheet = [*product(range(len(vectors)), ALPHAS, range(len(prompts)))]

    def plain() -> list[Generated]:
        answers = []
        for direction, alpha in product(range(len(vectors)), ALPHAS):
            hook = Steering(vectors[direction], layer, (alpha,) * len(prompts))
            answers += model.generate(prompts, NEW_TOKENS, steering=hook)
        return answers

    def shipped() -> list[Generated]:
        answers = []
        for start in range(0, len(sheet), ROWS):
            rows = sheet[start : start + ROWS]
            along, alphas = vectors[[d for d, _, _ in rows]], tuple(alpha for _, alpha, _ in rows)
            with model.remembering_clips():
                of = [prompts[number] for _, _, number in rows]
                answers += model.generate(of, NEW_TOKENS, steering=Steering(along, layer, alphas))
        return answers

    model.generate(prompts[:1], 2)  # what is loaded at the first call
    taken = {name: _timed(work, entry.device) for name, work in (("plain", plain), ("shipped", shipped))}
    (old, theirs), (new, ours) = taken["plain"], taken["shipped"]
    equal = [one.tokens for one in theirs] == [one.tokens for one in ours]
    what = f"{chosen.prompts} prompts, {chosen.directions} directions, {len(ALPHAS)} doses"
    print(f"{entry.id}: {len(sheet)} answers ({what})")
    print(f"plain {len(sheet) / old:.1f} answers/s, shipped {len(sheet) / new:.1f}: {old / new:.2f} times as many")
    print("answers are equal" if equal else "ANSWERS DIFFER")


def _timed(work: Callable[[], list[Generated]], device: str | None) -> tuple[float, list[Generated]]:
    clock = time.process_time if device in (None, "cpu") else time.perf_counter
    start = clock()
    answers = work()
    return clock() - start, answers


if __name__ == "__main__":
    main()
