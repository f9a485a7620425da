"""A sheet of steered answers, every prompt along every direction at every dose: the shipped path against the plain one.

    python bench/steering.py [--model ID | --random] [--prompts 8] [--directions 8] [--layer L]

Plain: one batch for each direction and dose, which shows the vision tower every clip again. Shipped: rows of all
directions and doses share batches, and the vision tower sees each clip once (`models/local/vision_cache.py`). Answers
must be equal, token by token. Times are CPU seconds of this process, so that a loaded machine hardly matters; on a GPU
they are seconds.

Then the states of every clip under four prompts, as a study reads those of a control (two questions, two system
prompts): each pass with its own vision pass, against passes that remember the clip. States must be equal, bit for bit.

--random: a random checkpoint of the Qwen3-VL class with 149 M parameters, in the proportions of the 2B model: decoder
and vision tower have about the same share of a pass. --layer: default the one at 5/9 of the depth, as the paper's layer
20 of 36.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from itertools import product
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TypeVar

import numpy as np

from bench.quick import parse
from traps_pipeline.base.paths import ASSETS
from traps_pipeline.mechanism.hook import Steering
from traps_pipeline.models.local.adapter import GeneratedAnswer, LocalModel, load_local_model
from traps_pipeline.models.local.tiny import build_tiny
from traps_pipeline.models.local.vision_cache import ClipMemory
from traps_pipeline.models.registry.entries import LOCAL, ModelEntry, get_model
from traps_pipeline.models.registry.prompts import system_prompt, vqa_prompt
from traps_pipeline.scenes.picture.camera import HEIGHT, WIDTH
from traps_pipeline.storage.media import MediaSpec, pick, resize

T = TypeVar("T")
ALPHAS, NEW_TOKENS = (-40.0, 5.0, 40.0), 24
CLIP_S = np.arange(50) / 10  # a clip of five seconds
ROWS = 64  # of a shipped batch
TEXT = {"hidden_size": 640, "intermediate_size": 1920, "num_hidden_layers": 20, "num_attention_heads": 10}
TEXT |= {"num_key_value_heads": 5, "head_dim": 64, "vocab_size": 32000, "initializer_range": 0.05}
TEXT |= {"rope_parameters": {"rope_type": "default", "rope_theta": 10000.0, "mrope_section": [16, 8, 8]}}
VISION = {"hidden_size": 320, "intermediate_size": 1280, "depth": 16, "num_heads": 5, "num_position_embeddings": 256}
VISION |= {"deepstack_visual_indexes": [3, 7, 11]}


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--model", default="pocket", help="a local model of the registry")
    parser.add_argument("--random", action="store_true", help="a random checkpoint of 149 M parameters")
    parser.add_argument("--layer", type=int, help="the steered block")
    parser.add_argument("--prompts", type=int, default=8)
    parser.add_argument("--directions", type=int, default=8)
    chosen = parse(parser, prompts=2, directions=2)
    with TemporaryDirectory() as folder:
        measure(random_entry(Path(folder)) if chosen.random else get_model(chosen.model), chosen)


def random_entry(folder: Path) -> ModelEntry:
    """Return the entry of a random checkpoint of middle size, in float32 on the CPU. With the pocket model's tokenizer,
    since bytes as tokens would make a prompt mostly text."""
    from tokenizers import Tokenizer

    words = Tokenizer.from_file(str(ASSETS / "pocket" / "weights" / "tokenizer.json"))
    video = {"size": {"shortest_edge": 1024, "longest_edge": 2**22}}
    build_tiny("qwen3-vl", folder, tokenizer=words, text=TEXT, vision=VISION, video=video)
    params = {"checkpoint": str(folder), "dtype": "float32", "quantisation": "none"}
    params |= {"do_sample": False, "max_new_tokens": NEW_TOKENS}
    spec = MediaSpec(profile="frames", uniform=8, size=(320, 256))
    return ModelEntry(id="random", backend=LOCAL, device="cpu", media=spec, params=params)


def measure(entry: ModelEntry, chosen: argparse.Namespace) -> None:
    """Both ways, in turn."""
    assert entry.media is not None
    spec, model = entry.media, load_local_model(entry, inside=True)
    rng, times = np.random.default_rng(0), CLIP_S[pick(CLIP_S, spec)]
    prompts = []
    for number in range(chosen.prompts):
        frames = rng.integers(0, 256, (len(times), HEIGHT, WIDTH, 3), dtype=np.uint8)
        asked = f"Does the ball end up left or right of the wall, in clip {number}?"
        prompts.append(model.prompt(system_prompt("standard"), asked, resize(frames, spec.size), times))
    drawn = rng.normal(size=(chosen.directions, model.d_model))
    vectors = (drawn / np.linalg.norm(drawn, axis=1, keepdims=True)).astype(np.float32)
    layer = chosen.layer or max(1, round(model.n_layers * 5 / 9))
    sheet = [*product(range(len(prompts)), range(len(vectors)), ALPHAS)]

    def plain() -> list[GeneratedAnswer]:
        answers = list[list[GeneratedAnswer]]()
        for direction, alpha in product(range(len(vectors)), ALPHAS):
            hook = Steering(vectors[direction], layer, (alpha,) * len(prompts))
            answers.append(model.generate(prompts, NEW_TOKENS, steering=hook))
        return [row[number] for number in range(len(prompts)) for row in answers]

    def shipped() -> list[GeneratedAnswer]:
        answers = []
        for start in range(0, len(sheet), ROWS):
            rows = sheet[start : start + ROWS]
            along, alphas = vectors[[d for _, d, _ in rows]], tuple(alpha for _, _, alpha in rows)
            with model.caching_clips():
                of = [prompts[number] for number, _, _ in rows]
                answers += model.generate(of, NEW_TOKENS, steering=Steering(along, layer, alphas))
        return answers

    model.generate(prompts[:1], 2)  # what is loaded at the first call
    taken = {name: _timed(work, entry.device) for name, work in (("plain", plain), ("shipped", shipped))}
    (old, theirs), (new, ours) = taken["plain"], taken["shipped"]
    equal = [one.tokens for one in theirs] == [one.tokens for one in ours]
    size = sum(parameter.numel() for parameter in model.network.parameters()) / 1e6
    print(
        f"{size:.0f} M parameters, {prompts[0].n_tokens} tokens a prompt, steered at block {layer} of {model.n_layers}"
    )
    what = f"{chosen.prompts} prompts, {chosen.directions} directions, {len(ALPHAS)} doses"
    print(f"{entry.id}: {len(sheet)} answers ({what})")
    print(f"plain {len(sheet) / old:.1f} answers/s, shipped {len(sheet) / new:.1f}: {old / new:.2f} times as many")
    print("answers are equal" if equal else "ANSWERS DIFFER")
    extraction(model, spec, entry.device, chosen.prompts)


def extraction(model: LocalModel, spec: MediaSpec, device: str | None, clips: int) -> None:
    """States of made-up clips under four prompts each, without and with remembered clips."""
    rng, times = np.random.default_rng(1), CLIP_S[pick(CLIP_S, spec)]
    prompts = []
    for _ in range(clips):
        frames = resize(rng.integers(0, 256, (len(times), HEIGHT, WIDTH, 3), dtype=np.uint8), spec.size)
        asked = ("Does the ball end up left or right?", "What does the ball weigh?")
        prompts += [model.prompt(vqa_prompt(name), q, frames, times) for name in ("standard", "guided") for q in asked]

    def plain() -> list[np.ndarray]:
        return [model.forward_states(prompt).raw for prompt in prompts]

    def remembering() -> list[np.ndarray]:
        model.clips = ClipMemory()
        with model.caching_clips():
            return plain()

    (old, theirs), (new, ours) = _timed(plain, device), _timed(remembering, device)
    print(f"extraction of {len(prompts)} states: {old:.1f} s, with remembered clips {new:.1f} s: {old / new:.2f} times")
    equal = all((one == other).all() for one, other in zip(theirs, ours, strict=True))
    print("states are equal" if equal else "STATES DIFFER")


def _timed(work: Callable[[], list[T]], device: str | None) -> tuple[float, list[T]]:
    clock = time.process_time if device in (None, "cpu") else time.perf_counter
    start = clock()
    answers = work()
    return clock() - start, answers


if __name__ == "__main__":
    main()
