"""Check in seconds what looking into a local model relies on (docs/local.md).

`traps doctor --local` runs the checks on a tiny checkpoint of each family, and on named models. The tests go further
(tests/models/local, tests/mechanism).
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from traps_pipeline.base.errors import TrapsError
from traps_pipeline.mechanism.hook import Steering
from traps_pipeline.mechanism.margin import abstention_tokens
from traps_pipeline.mechanism.patching_effects import SITES, Patch, patched_changes, require_patchable, trace_pass
from traps_pipeline.models.local.model import LocalModel
from traps_pipeline.models.local.prompt_batches import Prompt
from traps_pipeline.models.local.spans import token_spans
from traps_pipeline.models.local.vision_cache import ClipMemory

if TYPE_CHECKING:
    from torch import Tensor

SYSTEM = "You are asked about a video."
QUESTIONS = ("Does it grow brighter?", "Does the picture end up bright, dark, or as it was?", "Which?")
NEW_TOKENS = 8
FLOAT_STEP = 4e-6  # of an outcome in float32, which a small gap does not outweigh
CLOSE = 1e-4  # tolerances of effects, and of means relative to the largest state
EXACT = ("float32",)  # in 16 bits rounding differs with the shape of a batch


@dataclass(frozen=True)
class Subject:
    """A model and a clip: frames (N ≥ 2, H, W, 3) uint8 RGB with their times in s."""

    model: LocalModel
    frames: np.ndarray
    times_s: np.ndarray

    @cached_property
    def prompts(self) -> list[Prompt]:
        """Prompts of three lengths about the clip."""
        return [self.model.prompt(SYSTEM, question, self.frames, self.times_s) for question in QUESTIONS]

    @cached_property
    def direction(self) -> np.ndarray:
        """A random unit vector as wide as the states, (d,) float32."""
        vector = np.random.default_rng(0).normal(size=self.model.d_model)
        return (vector / np.linalg.norm(vector)).astype(np.float32)

    @property
    def layer(self) -> int:
        """The index of the middle layer, on which adapters are tried."""
        return max(1, self.model.n_layers // 2)

    def steered(self, *alphas: float) -> Steering:
        """Return steering by the random direction; alphas are in lengths of the state."""
        length = float(np.linalg.norm(self.model.forward_states(self.prompts[0]).raw[self.layer]))
        return Steering(self.direction, self.layer, tuple(alpha * length for alpha in alphas))


@dataclass(frozen=True)
class Check:
    """A property that an adapter must have, and the function that checks it.

    run: returns the observation in a few words; raises TrapsError if the promise is broken. exact: the check needs
    float32, since it allows hardly any rounding.
    """

    name: str
    promise: str
    run: Callable[[Subject], str]
    exact: bool = True

    def found(self, subject: Subject) -> str:
        """Run the check and return its observation. Raises TrapsError if it fails."""
        dtype = subject.model.params.dtype
        if self.exact and (dtype not in EXACT or subject.model.params.quantisation != "none"):
            return f"not looked at: in {dtype} rounding differs with the shape of a pass"
        return self.run(subject)


def _require(holds: bool, message: str) -> None:
    if not holds:
        raise TrapsError(f"{message}; install the pinned versions, or do not look into this model")


# --- states -----------------------------------------------------------------------------------------------------------


def _library_states(subject: Subject, prompt: Prompt) -> list[Tensor]:
    """Return the library's states (T, d): embeddings, block outputs, last one normed."""
    import torch

    model = subject.model
    with torch.inference_mode():
        output = model.network.base_model(**model.placed(prompt.inputs), use_cache=False, output_hidden_states=True)
    return [states[0].float().cpu() for states in output.hidden_states]


def _states(subject: Subject) -> str:
    prompt = subject.prompts[0]
    library, hooked = _library_states(subject, prompt), subject.model.forward_states(prompt)
    hooked_states = [*hooked.raw[:-1], hooked.normed]
    state_pairs = zip(hooked_states, library, strict=True)
    wrong_layers = [layer for layer, (a, b) in enumerate(state_pairs) if (a != b[-1].numpy()).any()]
    _require(not wrong_layers, f"hooked states differ from the library's own at layers {wrong_layers}")
    return f"{len(library)} states, bit for bit"


def _check_steered_states(subject: Subject) -> str:
    prompt, layer = subject.prompts[0], subject.layer
    push = subject.steered(-0.5)
    plain_states, steered_states = (
        subject.model.forward_states(prompt, steering=steering) for steering in (None, push)
    )
    is_exact = steered_states.raw[layer] == plain_states.raw[layer] + np.float32(push.alphas[0]) * push.direction
    _require(bool(is_exact.all()), f"a steered state at layer {layer} is not the plain one and alpha times v")
    _require(
        bool((steered_states.raw[:layer] == plain_states.raw[:layer]).all()),
        f"steering layer {layer} changes a layer below it",
    )
    _require(
        bool((steered_states.normed != plain_states.normed).any()), f"steering layer {layer} changes nothing above it"
    )
    return "exactly"


def _zero(subject: Subject) -> str:
    import torch

    model, zero_steering = subject.model, subject.steered(0.0, 0.0, 0.0)

    def hooks() -> int:
        return sum(len(module._forward_hooks) for module in model.network.modules())

    previous_hooks, plain_state = hooks(), model.forward(subject.prompts[0]).last_hidden_state
    with zero_steering.applied(model):
        _require(hooks() == previous_hooks, "steering with alpha 0 leaves a hook")
        _require(
            torch.equal(model.forward(subject.prompts[0]).last_hidden_state, plain_state), "alpha 0 changes states"
        )
    answers = [model.generate(subject.prompts, NEW_TOKENS, steering=steering) for steering in (None, zero_steering)]
    _require(answers[0] == answers[1], "alpha 0 changes answers")
    return "no bit changes"


# --- parts of a prompt ------------------------------------------------------------------------------------------------


def _parts(subject: Subject) -> str:
    prompt, question = subject.prompts[1], QUESTIONS[1]
    parts, decode = token_spans(subject.model, prompt, SYSTEM, question), subject.model.processor.tokenizer.decode
    ids = prompt.inputs["input_ids"][0]
    for name, text in (("system", SYSTEM), ("question", question)):
        decoded_text = "".join(decode(ids[parts[name]]).split())
        _require(decoded_text == "".join(text.split()), f"the tokens of the {name} read {decoded_text[:80]!r}")
    _require(bool(parts["visual"].any()), "no visual token is found")
    stamps = int(parts["stamps"].sum())
    times = f"{stamps} of time stamps" if stamps else "it writes no times"
    return f"{int(parts['visual'].sum())} visual tokens, {times}"


def _check_pooling(subject: Subject) -> str:
    prompt = subject.prompts[1]
    positions = token_spans(subject.model, prompt, SYSTEM, QUESTIONS[1])["question"]
    pooled_state = subject.model.forward_states(prompt, "question", chosen=positions).raw[subject.layer]
    mean_state = _library_states(subject, prompt)[subject.layer][positions].mean(dim=0).numpy()
    _require(
        np.abs(pooled_state - mean_state).max() <= CLOSE * np.abs(mean_state).max(),
        "the mean over the question is another one",
    )
    return "equal"


def _check_times(subject: Subject) -> str:
    """Compare what a prompt says of time with the clip's, and with that of the clip at half the speed."""
    model, step = subject.model, float(np.diff(subject.times_s).mean())
    prompt = subject.prompts[1]
    slow = model.prompt(SYSTEM, QUESTIONS[1], subject.frames, 2 * subject.times_s)
    scales = [name for name, value in prompt.inputs.items() if value.is_floating_point() and value.numel() == 1]
    for name in scales:
        seconds, of_slow = (float(inputs[name]) for inputs in (prompt.inputs, slow.inputs))
        frames = seconds / step  # of one step of positions: as many as the tower merges
        _require(
            abs(frames - round(frames)) < 0.02 * frames and abs(of_slow - 2 * seconds) < 0.02 * of_slow,
            f"{name} is {seconds:.3g} s, but frames are {step:.3g} s apart",
        )
    if scales:
        return f"{', '.join(scales)} is the frames' own"
    ids = prompt.inputs["input_ids"], slow.inputs["input_ids"]
    if ids[0].shape == ids[1].shape and bool((ids[0] == ids[1]).all()):
        return "it is told no times"
    return f"written in the prompt, to {_require_stamps(subject, slow):.1g} s"


def _require_stamps(subject: Subject, slow: Prompt) -> float:
    """Return how far written times are from those of the frames that they stand for, at half the speed."""
    parts = token_spans(subject.model, slow, SYSTEM, QUESTIONS[1])
    ids, places = slow.inputs["input_ids"][0], np.flatnonzero(parts["stamps"])
    runs = np.split(places, np.flatnonzero(np.diff(places) > 1) + 1)  # a stamp each, between pictures
    text = " ".join(subject.model.processor.tokenizer.decode(ids[run]) for run in runs)
    written = [60 * float(minutes or 0) + float(s) for minutes, s in re.findall(r"(?:(\d+):)?(\d+(?:\.\d+)?)", text)]
    times = 2 * subject.times_s
    merged = len(times) // max(1, len(written))
    means = times[: merged * len(written)].reshape(len(written), -1).mean(axis=1) if written and merged else times
    _require(len(means) == len(written), f"its prompt has {len(written)} times for {len(times)} frames ({text[:60]!r})")
    error = float(np.abs(means - written).max())
    _require(error <= 1, f"its prompt says {written} s, but the frames are at {means.tolist()} s")
    return error


# --- patching ---------------------------------------------------------------------------------------------------------


def _check_patching(subject: Subject) -> str:
    model = subject.model
    try:
        require_patchable(model)
    except TrapsError as why:
        return f"refused: {str(why).partition(': ')[2].partition(' (')[0]}"
    tokens = abstention_tokens(model)
    other_prompt = model.prompt(SYSTEM, QUESTIONS[0], 255 - subject.frames, subject.times_s)
    target, source = (trace_pass(model, prompt, tokens) for prompt in (subject.prompts[0], other_prompt))
    all_tokens = np.ones(target.length, bool)
    full_patches = [Patch("residual", layer, all_tokens) for layer in range(model.n_layers + 1)]
    sites = [Patch(site, layer, all_tokens) for site in SITES for layer in range(1, model.n_layers + 1)]
    gap = source.margin - target.margin
    tolerance = max(CLOSE * abs(gap), FLOAT_STEP)
    self_patched = np.abs(patched_changes(model, target, target, [*full_patches, *sites], tokens)).max()
    _require(self_patched <= tolerance, f"a patch with itself changes the outcome by {self_patched:.1e}")
    missed = np.abs(patched_changes(model, target, source, full_patches, tokens) - gap).max()
    _require(
        bool(missed <= tolerance < abs(gap)), f"patching all positions misses the outcome, {gap:.1e}, by {missed:.1e}"
    )
    side_paths = {
        "deepstack features": target.visual is not None,
        "shared keys and values": bool(target.shared),
        "per-layer inputs": bool(target.per_layer),
    }
    path_names = ", ".join(name for name, is_different in side_paths.items() if is_different)
    return "0 within rounding, and 1" + (f" with {path_names}" if path_names else "")


# --- faster ways ------------------------------------------------------------------------------------------------------


def _clips(subject: Subject) -> str:
    model, memory = subject.model, ClipMemory()
    uncached_states = [model.forward_states(prompt).raw for prompt in subject.prompts]
    with memory.remembering(model.network):
        cached_states = [model.forward_states(prompt).raw for prompt in subject.prompts]
    _require(
        all((a == b).all() for a, b in zip(uncached_states, cached_states, strict=True)),
        "a remembered clip gives other states",
    )
    return "seen once" if memory.passes == 1 else "seen by every pass"


def _batches(subject: Subject) -> str:
    model, prompts = subject.model, subject.prompts
    again, push = [prompts[0], *prompts, prompts[0]], subject.steered(0.5, -0.5, 0.5, 0.5, 0.5)
    steered = model.generate(again, NEW_TOKENS, steering=push)
    alone = [model.generate([prompt], NEW_TOKENS, steering=push.rows([n]))[0] for n, prompt in enumerate(again)]
    _require([a.tokens for a in steered] == [a.tokens for a in alone], "a steered answer depends on its batch")
    with _end_at(model, model.generate(prompts[:1], 2)[0].tokens[-1]):
        batched_answers = model.generate(prompts, NEW_TOKENS)
        single_answers = [model.generate([prompt], NEW_TOKENS)[0] for prompt in prompts]
    _require(
        [a.tokens for a in batched_answers] == [a.tokens for a in single_answers], "an answer depends on its batch"
    )
    return "equal"


@contextmanager
def _end_at(model: LocalModel, token: int) -> Iterator[None]:
    """Stop generation at a token, so that rows of a batch end at different steps."""
    config = model.network.generation_config
    previous_ending, config.eos_token_id = config.eos_token_id, [token]
    try:
        yield
    finally:
        config.eos_token_id = previous_ending


CHECKS = (
    Check("states", "hooked states are the library's own", _states, exact=False),
    Check("alpha 0", "steering with alpha 0 leaves no hook and changes no bit of states or answers", _zero),
    Check(
        "alpha", "a steered state is the plain one and alpha times v, and none below it changes", _check_steered_states
    ),
    Check("parts", "system prompt, question and visual tokens are where their texts are", _parts, exact=False),
    Check("times", "a prompt says of the clip's times what is so, or nothing", _check_times, exact=False),
    Check("means", "the mean over the question's tokens is that of the library's states", _check_pooling),
    Check("patching", "a patch with itself changes nothing, one of all positions gives the source", _check_patching),
    Check("clips", "the vision tower sees a clip once, and states stay as they are", _clips),
    Check("batches", "answers, steered or not, do not depend on their batch, nor on rows that end early", _batches),
)


def brightening_clip() -> tuple[np.ndarray, np.ndarray]:
    """Return a clip for the checks: four frames (4, 64, 96, 3), half a second apart."""
    return np.stack([np.full((64, 96, 3), shade, np.uint8) for shade in range(40, 200, 40)]), np.arange(4) / 2
