"""What looking inside costs: extraction against the bare forward pass, steered against unsteered generation, and both
against a plain loop over transformers; the same model, prompts and device, in alternation.

    python bench/extraction.py [--model ID] [--runs 50]

Without --model: the pocket model where its weights are there, else a random checkpoint of its class and size. Prompts
have the frames that the model's entry says. What is looked into is measured in the precision of `mechanism:`, answers
in that of `params:`, one after the other in memory. With a GPU, name a model of the registry whose entry says `device:
cuda`: the peak memory of extraction and of answering is printed then. On a loaded machine set OMP_NUM_THREADS=1.
"""

from __future__ import annotations

import argparse
import gc
import statistics
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from bench.quick import parse
from traps_pipeline.base.paths import ASSETS
from traps_pipeline.base.progress import Progress, use_progress
from traps_pipeline.mechanism.hidden_states import Item, extract
from traps_pipeline.mechanism.hook import Steering
from traps_pipeline.models.local import adapter
from traps_pipeline.models.local.adapter import LocalModel, Prompt, load_local_model
from traps_pipeline.models.local.tiny import build_tiny
from traps_pipeline.models.registry.entries import LOCAL, ModelEntry, load_models
from traps_pipeline.scenes.picture.camera import HEIGHT, WIDTH
from traps_pipeline.storage.media import MediaSpec, pick

SYSTEM = "You are a helpful visual question answering assistant. Please answer the question based on the video."
NEW_TOKENS, ROWS, ITEMS = 24, 4, 16
CLIP_S = np.arange(50) / 10  # a clip of five seconds
# About 3 M parameters.
TEXT = {"hidden_size": 192, "intermediate_size": 384, "num_hidden_layers": 6, "head_dim": 48}
TEXT |= {"rope_parameters": {"rope_type": "default", "rope_theta": 10000.0, "mrope_section": [12, 6, 6]}}
VISION = {"hidden_size": 96, "intermediate_size": 256, "depth": 4, "num_heads": 4}


def the_entry(name: str | None, folder: Path) -> ModelEntry:
    """Return the entry of the model to measure."""
    models = load_models()
    if name is None and "pocket" in models and (ASSETS / "pocket" / "weights" / "model.safetensors").exists():
        name = "pocket"
    if name is not None:
        return models[name]
    build_tiny(
        "qwen3-vl", folder, text=TEXT, vision=VISION, video={"size": {"shortest_edge": 1024, "longest_edge": 2**22}}
    )
    params = {"checkpoint": str(folder), "dtype": "float32", "quantisation": "none"}
    params |= {"do_sample": False, "max_new_tokens": NEW_TOKENS}
    spec = MediaSpec(profile="frames", uniform=8, size=(128, 96))
    return ModelEntry(id="tiny", backend=LOCAL, device="cpu", media=spec, params=params)


@dataclass(frozen=True)
class Subject:
    """A model in memory, and how it is shown clips."""

    model: LocalModel
    spec: MediaSpec

    def prompt(self, number: int) -> Prompt:
        """Return a prompt about one made-up clip, with the frames that the entry's media would take of it."""
        times = CLIP_S[pick(CLIP_S, self.spec)]
        width, height = self.spec.size or (WIDTH, HEIGHT)
        shape = (len(times), height, width, 3)
        frames = np.random.default_rng(number).integers(0, 255, shape, dtype=np.uint8)
        return self.model.prompt(SYSTEM, f"Does it stop within {number} seconds, yes or no?", frames, times)

    def describe(self) -> str:
        """Return what is measured."""
        count = sum(p.numel() for p in self.model.network.parameters())
        shown = f"{len(pick(CLIP_S, self.spec))} frames, prompt of {self.prompt(0).n_tokens} tokens"
        return f"{self.model.served_model}, {count / 1e6:.1f} M parameters, {shown}"


def loaded(entry: ModelEntry, *, inside: bool) -> Subject:
    """Return the entry's model, alone in memory."""
    assert entry.media is not None, "local entries have media"
    adapter._LOADED.clear()
    gc.collect()
    return Subject(load_local_model(entry, inside=inside), entry.media)


def told_peak(model: LocalModel, what: str, work: Callable[[], object]) -> None:
    """Print the peak memory of one piece of work on a GPU, the weights included."""
    if not model.device.startswith("cuda"):
        return
    import torch

    torch.cuda.empty_cache()
    torch.cuda.reset_peak_memory_stats(model.device)
    work()
    print(f"peak memory, {what}: {torch.cuda.max_memory_allocated(model.device) / 1e9:.1f} GB")


def alternating(runs: int, **ways: Callable[[], object]) -> dict[str, tuple[float, float]]:
    """Return median wall and CPU seconds of each way, run in turn."""
    import torch

    times: dict[str, list[tuple[float, float]]] = {name: [] for name in ways}
    for run in range(runs + 2):  # two to warm up
        for name, way in ways.items():
            wall, cpu = time.perf_counter(), time.process_time()
            way()
            if torch.cuda.is_available():
                torch.cuda.synchronize()
            if run >= 2:
                times[name].append((time.perf_counter() - wall, time.process_time() - cpu))
    return {name: tuple(map(statistics.median, zip(*pairs, strict=True))) for name, pairs in times.items()}  # pyright: ignore[reportReturnType]


@contextmanager
def endless(model: LocalModel) -> Iterator[None]:
    """Answers of one length: nothing ends them but the limit."""
    config = model.network.generation_config
    eos, config.eos_token_id = config.eos_token_id, -1
    yield
    config.eos_token_id = eos


def line(what: str, ours: tuple[float, float], other: tuple[float, float], target: float | None = None) -> str:
    """Return a ratio, with its medians and its target."""
    wall, cpu = ours[0] / other[0], ours[1] / other[1]
    said = f"{what:<44} {ours[0] * 1e3:8.2f} ms against {other[0] * 1e3:8.2f} ms: ratio {wall:.3f} (CPU time {cpu:.3f})"
    return said if target is None else f"{said}, target at most {target:.2f}"


def looked_into(entry: ModelEntry, runs: int, few: int) -> None:
    """What looking inside costs."""
    subject = loaded(entry, inside=True)
    print(f"looked into: {subject.describe()}")
    overheads(subject, runs)
    extraction(subject, few)


def overheads(subject: Subject, runs: int) -> None:
    """The two ratios that the design promises."""
    model, prompt = subject.model, subject.prompt(0)
    states = alternating(runs, bare=lambda: model.forward(prompt), ours=lambda: model.forward_states(prompt))
    print(line("extraction over the bare forward pass", states["ours"], states["bare"], 1.05))
    v = np.ones(model.d_model, np.float32) / np.sqrt(model.d_model, dtype=np.float32)
    rows = [subject.prompt(i) for i in range(ROWS)]
    push = Steering(v, max(1, model.n_layers // 2), tuple(float(2 * (-1) ** i) for i in range(ROWS)))
    with endless(model):
        answers = alternating(
            runs,
            plain=lambda: model.generate(rows, NEW_TOKENS),
            ours=lambda: model.generate(rows, NEW_TOKENS, steering=push),
        )
    print(line(f"steered over unsteered, {ROWS} x {NEW_TOKENS} tokens", answers["ours"], answers["plain"], 1.05))


def extraction(subject: Subject, runs: int) -> None:
    """Samples a second of extraction, prompts and files included, against what one would write by hand."""
    import torch

    model = subject.model

    def plain() -> None:
        kept = []
        for i in range(ITEMS):
            inputs = model.placed(subject.prompt(i).inputs)
            with torch.inference_mode():
                out = model.network(**inputs, output_hidden_states=True)
            kept.append(torch.stack([state[0, -1] for state in out.hidden_states]).cpu())

    def ours() -> None:
        items = [Item(f"i{i}", "void", {"number": i}, lambda i=i: subject.prompt(i)) for i in range(ITEMS)]
        with TemporaryDirectory() as folder:
            extract(model, items, Path(folder))

    against_a_plain_loop("extracted", runs, plain, ours)
    told_peak(model, "extraction", ours)


def answering(entry: ModelEntry, runs: int) -> None:
    """The same of answers, in the precision that the model answers in."""
    import torch

    subject = loaded(entry, inside=False)
    model = subject.model
    print(f"answering: {subject.describe()}")

    def plain() -> None:
        for i in range(ITEMS):
            inputs = model.placed(subject.prompt(i).inputs)
            with torch.inference_mode():
                model.network.generate(**inputs, max_new_tokens=NEW_TOKENS)

    def ours() -> None:
        model.generate([subject.prompt(i) for i in range(ITEMS)], NEW_TOKENS)

    with endless(model):
        against_a_plain_loop("answered", runs, plain, ours)
        told_peak(model, "answering", ours)


def against_a_plain_loop(what: str, runs: int, plain: Callable[[], None], ours: Callable[[], None]) -> None:
    """Print how fast both are."""
    took = alternating(runs, plain=plain, ours=ours)
    rates = {name: ITEMS / wall for name, (wall, _) in took.items()}
    ratio, cpu = rates["ours"] / rates["plain"], took["plain"][1] / took["ours"][1]
    pace = f"{rates['ours']:.1f} samples/s, plain loop {rates['plain']:.1f}"
    print(f"{what}: {pace}: {ratio:.2f} x (by CPU time {cpu:.2f} x)")


def main() -> None:
    """Print everything."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--model", help="id in assets/models.yaml")
    parser.add_argument("--runs", type=int, default=50)
    arguments = parse(parser, runs=1)
    import torch

    few = max(3, arguments.runs // 10)
    with TemporaryDirectory() as folder, use_progress(Progress()):
        entry = the_entry(arguments.model, Path(folder))
        threads = torch.get_num_threads()
        print(f"median of {arguments.runs} alternating runs ({few} against a plain loop), {threads} threads")
        looked_into(entry, arguments.runs, few)
        answering(entry, few)
    if entry.device == "cpu":
        print("no GPU was used: neither throughput nor peak memory of the 7-8B models was measured")


if __name__ == "__main__":
    main()
