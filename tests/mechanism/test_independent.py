"""Everything that is done inside a model, once more without this package: plain transformers on a network of its own
(`test_probes.py` holds probes against scikit-learn). From the package come the inputs (clips, prompts, the tokens whose
odds are the outcome) and what is compared: states exactly, steered texts row by row, effects of patches to 1e-5."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from functools import cache, partial
from itertools import product
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, cast

import numpy as np
import pytest
import torch

from tests import local_models
from tests.local_models import FAMILIES, QUESTIONS, SYSTEM, Family
from tools.tiny_checkpoints import build_tiny
from traps_pipeline.mechanism.margin import abstention_tokens
from traps_pipeline.mechanism.patching_effects import SITES, Patch, Site, patched_changes, trace_pass
from traps_pipeline.mechanism.steered_backend import SteeredBackend
from traps_pipeline.models.local.adapter import LocalModel, Prompt, load_local_model
from traps_pipeline.models.local.library import load_transformers
from traps_pipeline.models.registry.entries import ModelEntry, get_model
from traps_pipeline.models.request import Request
from traps_pipeline.storage.media import Frames, MediaSpec, pick_frames
from traps_pipeline.video.encode import encode

pytestmark = pytest.mark.slow
POCKET = "pocket"
NEW_TOKENS = 8
PROMISED = "qwen3-vl"  # in `make test`; the others in the campaign
each = pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[pytest.mark.promise] * (name == PROMISED)) for name in (*FAMILIES, POCKET)]
)


@dataclass(frozen=True, eq=False)
class Subject:
    """A checkpoint in memory twice. of: the package's. network: the library's own."""

    entry: ModelEntry
    of: LocalModel
    network: Any

    @property
    def decoder(self) -> Any:
        return self.network.model.language_model

    def shown(self, clip: Path) -> Frames:
        return pick_frames(clip, cast(MediaSpec, self.entry.media))

    def prompt(self, frames: np.ndarray, times_s: np.ndarray, question: str = QUESTIONS[1]) -> Prompt:
        return self.of.prompt(SYSTEM, question, frames, times_s)


@cache
def _folder() -> TemporaryDirectory[str]:
    return TemporaryDirectory(prefix="independent-")


@cache
def subject(name: str) -> Subject:
    """The pocket model, or the tiny random one of a family; Qwen3-VL's with a vision tower whose deepstack features are
    as large as its states, so that it shows who forgets them."""
    if name == POCKET:
        entry = get_model(POCKET)
    else:
        family, folder = cast(Family, name), Path(_folder().name) / name
        loud = {"initializer_range": 0.2} if name == "qwen3-vl" else None
        entry = local_models.entry(family, build_tiny(family, folder, vision=loud))
    of = load_local_model(entry, inside=True)
    network = load_transformers().AutoModelForImageTextToText.from_pretrained(
        of.checkpoint.folder, dtype=torch.float32, attn_implementation="sdpa", local_files_only=True
    )
    return Subject(entry, of, network.eval())


def hooked(module: Any, hook: Callable[..., Any], before: bool = False) -> Callable[[], None]:
    """A forward hook, or one that sees the arguments; returns what removes it."""
    made = module.register_forward_pre_hook(hook, with_kwargs=True) if before else module.register_forward_hook(hook)
    return made.remove


def first(output: Any) -> torch.Tensor:
    return output[0] if isinstance(output, tuple) else output


# --- states -----------------------------------------------------------------------------------------------------------


def plain_states(of: Subject, prompt: Prompt) -> np.ndarray:
    """(layers + 2, d), of the last token: embeddings, each block's output, the last one after the final norm."""
    raw: list[torch.Tensor] = []
    remove = hooked(of.decoder.layers[-1], lambda _, __, output: raw.append(first(output)))
    with torch.no_grad():
        out = of.network(**prompt.inputs, output_hidden_states=True, use_cache=False)
    remove()
    own = [*out.hidden_states[:-1], *raw, out.hidden_states[-1]]
    return np.stack([states[0, -1].numpy() for states in own])


@each
def test_states_of_every_layer_are_the_librarys_own_to_the_bit(name: str) -> None:
    of, rng = subject(name), np.random.default_rng(0)
    shown = of.shown(local_models.clip())
    for _ in range(4):
        prompt = of.prompt(rng.integers(0, 256, shown.frames.shape, np.uint8), shown.times_s)
        own, found = plain_states(of, prompt), of.of.forward_states(prompt)
        assert found.raw.shape == (of.of.n_layers + 1, of.of.d_model)
        assert np.array_equal(own, np.vstack([found.raw, found.normed]))


# --- steering ---------------------------------------------------------------------------------------------------------


def plain_answer(of: Subject, prompt: Prompt, layer: int, added: np.ndarray | None) -> str:
    """One row, no batch, the library's whole `generate` from the pixels, with one hook that adds a vector."""
    places = [of.of.processor.image_token_id, of.of.processor.video_token_id]
    if hasattr(of.of.processor, "audio_token_id"):
        places.append(of.of.processor.audio_token_id)
    with ExitStack() as hooks:
        if added is not None:
            vector = torch.from_numpy(added)

            def add(_: Any, __: Any, output: Any) -> Any:
                return (output[0] + vector, *output[1:]) if isinstance(output, tuple) else output + vector

            hooks.callback(hooked(of.decoder.layers[layer - 1], add))
        with torch.no_grad():
            made = of.network.generate(
                **prompt.inputs, do_sample=False, max_new_tokens=NEW_TOKENS, suppress_tokens=sorted(places)
            )
    return of.of.processor.tokenizer.decode(made[0, prompt.n_tokens :], skip_special_tokens=True).strip()


@cache
def other_clip() -> Path:
    """Stripes that move downwards."""
    lines = np.arange(72)[:, None, None]
    frames = [np.broadcast_to(((lines + 3 * i) // 12 % 2) * np.array([40, 90, 250]), (72, 96, 3)) for i in range(20)]
    path = Path(_folder().name) / "other.mp4"
    encode([np.ascontiguousarray(frame.astype(np.uint8)) for frame in frames], path, 10)
    return path


@each
def test_a_sheet_of_steered_answers_is_what_a_plain_hook_gives_row_by_row(name: str) -> None:
    """Batched and with clips seen once, against neither of these."""
    of, layer = subject(name), 2
    rng = np.random.default_rng(1)
    drawn = rng.normal(size=(2, of.of.d_model))
    vectors = {f"v{k}": (v / np.linalg.norm(v)).astype(np.float32) for k, v in enumerate(drawn)}
    asked = [(local_models.clip(), QUESTIONS[0]), (local_models.clip(), QUESTIONS[1]), (other_clip(), QUESTIONS[1])]
    shown = {clip: of.shown(clip) for clip, _ in asked}
    prompts = [of.prompt(shown[clip].frames, shown[clip].times_s, question) for clip, question in asked]
    length = float(np.linalg.norm(plain_states(of, prompts[0])[layer]))
    sheet = [*product(range(3), vectors, (-length, 0.5 * length, 2 * length))]
    rows: list[tuple[int, dict[str, Any] | None]] = [(number, None) for number in range(3)]  # unsteered ones between
    rows += [(number, {"direction": key, "layer": layer, "alpha": alpha}) for number, key, alpha in sheet]
    requests = [
        Request(
            POCKET, "local", {"max_new_tokens": NEW_TOKENS, "steering": steering}, SYSTEM, asked[number][1], {},
            media=asked[number][0], media_digest=asked[number][0].name,
        )
        for number, steering in rows
    ]  # fmt: skip
    backend = SteeredBackend(of.entry, vectors)
    before = of.of.clips.passes
    found = [outcome.text or "" for outcome in backend.generate(requests, lambda: False)]
    assert of.of.clips.passes - before <= 2  # clips, of classes whose features come clip by clip
    expected = []
    for number, steering in rows:
        added = None if steering is None else np.float32(steering["alpha"]) * vectors[steering["direction"]]
        expected.append(plain_answer(of, prompts[number], layer, added))
    assert found == expected
    assert len(set(found)) > 4, "the rows must differ, or nothing is compared"


# --- patching ---------------------------------------------------------------------------------------------------------


def plain_pass(of: Subject, prompt: Prompt, hooks: ExitStack) -> torch.Tensor:
    with hooks, torch.no_grad():
        return of.network(**prompt.inputs, use_cache=False).logits[0, -1].double()


def plain_margin(of: Subject, logits: torch.Tensor, tokens: list[int]) -> float:
    """Log-odds of the tokens against all others that an answer may begin with."""
    places = {getattr(of.of.processor, f"{kind}_token_id", None) for kind in ("image", "video", "audio")}
    rest = [token for token in range(len(logits)) if token not in places and token not in tokens]
    return float(torch.logsumexp(logits[tokens], 0) - torch.logsumexp(logits[rest], 0))


def module_of(of: Subject, site: Site, layer: int) -> Any:
    """Where a site is replaced. A residual is replaced where it is read: at the next block, or at the final norm."""
    if site == "residual":
        return of.decoder.layers[layer] if layer < len(of.decoder.layers) else of.decoder.norm
    return getattr(of.decoder.layers[layer - 1], {"attention": "self_attn", "mlp": "mlp"}[site])


def maker_of(of: Subject, reader: int) -> int | None:
    """Of a block of Gemma's that reads another one's keys and values, which one that is, both counted from 0: the last
    block with the same kind of attention among those that make their own."""
    config = of.decoder.config
    makers = config.num_hidden_layers - getattr(config, "num_kv_shared_layers", 0)
    if reader < makers:
        return None
    return max(block for block in range(makers) if config.layer_types[block] == config.layer_types[reader])


def plain_patch(
    of: Subject, target: Prompt, source: Prompt, at: tuple[Site, int], chosen: torch.Tensor, naive: bool = False
) -> torch.Tensor:
    """Logits of the target, from its pixels, with what the source has at some positions of a site. What blocks behind a
    residual read beside it is the source's at these positions, too, but in a naive patch: what is added to the residual
    stream behind the block that reads it (deepstack), what a block is given of each token, and the keys and values that
    a block up to the site made and another one reads."""
    kept: dict[str, Any] = {}
    module, reading, layer = module_of(of, *at), at[0] == "residual", at[1]

    def keep(_: Any, args: Any, output: Any) -> None:
        kept["states"] = first(args if reading else output).clone()

    def keep_features(_: Any, __: Any, kwargs: dict[str, Any]) -> None:
        kept["features"] = kwargs.get("deepstack_visual_embeds")

    def keep_beside(number: int, _: Any, args: Any, kwargs: dict[str, Any]) -> None:
        kept["own", number], kept["shared"] = args[1], kwargs["shared_kv_states"]

    def swap_beside(number: int, _: Any, args: Any, kwargs: dict[str, Any]) -> Any:
        own, maker, shared = torch.where(chosen[None, :, None], kept["own", number], args[1]), maker_of(of, number), {}
        if maker is not None and maker < layer:
            kind = of.decoder.config.layer_types[number]
            both = zip(kept["shared"][kind], kwargs["shared_kv_states"][kind], strict=True)
            pair = [torch.where(chosen[None, None, :, None], theirs, mine) for theirs, mine in both]
            shared = {"shared_kv_states": {kind: (pair[0], pair[1])}}
        return (args[0], own, *args[2:]), kwargs | shared

    def swapped(states: torch.Tensor) -> torch.Tensor:
        return torch.where(chosen[None, :, None], kept["states"], states)

    def swap_read(_: Any, args: Any, kwargs: dict[str, Any]) -> Any:
        return (swapped(args[0]), *args[1:]), kwargs

    def swap_made(_: Any, __: Any, output: Any) -> Any:
        return (swapped(output[0]), *output[1:]) if isinstance(output, tuple) else swapped(output)

    def swap_features(_: Any, args: Any, kwargs: dict[str, Any]) -> Any:
        visual = chosen[kwargs["visual_pos_masks"][0]][:, None]
        both = zip(kept["features"], kwargs["deepstack_visual_embeds"], strict=True)
        mixed = [
            own if number < layer else torch.where(visual, theirs, own) for number, (theirs, own) in enumerate(both)
        ]
        return args, kwargs | {"deepstack_visual_embeds": mixed}

    hooks = ExitStack()
    hooks.callback(hooked(module, keep))
    hooks.callback(hooked(of.decoder, keep_features, before=True))
    beside = [*enumerate(of.decoder.layers)] if hasattr(of.decoder, "project_per_layer_inputs") else []  # Gemma's
    for number, block in beside:
        hooks.callback(hooked(block, partial(keep_beside, number), before=True))
    plain_pass(of, source, hooks)
    hooks = ExitStack()
    hooks.callback(hooked(module, swap_read, before=True) if reading else hooked(module, swap_made))
    if reading and not naive and kept["features"] is not None:
        hooks.callback(hooked(of.decoder, swap_features, before=True))
    for number, block in beside[layer:] if reading and not naive else ():
        hooks.callback(hooked(block, partial(swap_beside, number), before=True))
    return plain_pass(of, target, hooks)


def groups_of(of: Subject, prompt: Prompt) -> dict[str, torch.Tensor]:
    """Positions by their token ids alone: visual tokens, every third of them, what stands before and between them
    (system prompt and time stamps), time stamps, question and end, all."""
    ids, kind = prompt.inputs["input_ids"][0], of.of.processor
    visual = ids == kind.video_token_id
    places = visual.nonzero()[:, 0]
    some = torch.zeros_like(visual)
    some[places[::3]] = True
    behind = torch.arange(len(ids)) > places[-1]
    found = {"visual": visual, "some": some, "before": ~visual & ~behind, "behind": behind, "all": visual | ~visual}
    if "qwen3" in type(of.network).__name__.lower():  # <|vision_start|><0.2 seconds><|vision_start|>...<|vision_end|>
        marks = (ids == kind.vision_start_token_id) | (ids == kind.vision_end_token_id)
        found["stamps"] = ~visual & ~marks & ~behind & (torch.arange(len(ids)) > marks.nonzero()[0, 0])
    return found


@each
def test_effects_of_patches_are_those_of_plain_hooks_at_every_site_and_group(name: str) -> None:
    of = subject(name)
    here, there = of.shown(local_models.clip()), of.shown(other_clip())
    target = of.prompt(here.frames, here.times_s)
    turned = QUESTIONS[1].replace("left, right", "right, left")
    source = of.prompt(there.frames, there.times_s + 7, turned)
    tokens, groups = abstention_tokens(of.of), groups_of(of, target)
    recorded = [trace_pass(of.of, prompt, tokens) for prompt in (target, source)]
    own = [plain_margin(of, plain_pass(of, prompt, ExitStack()), tokens) for prompt in (target, source)]
    assert [one.margin for one in recorded] == pytest.approx(own, abs=1e-5)
    gap = own[1] - own[0]
    wanted: list[tuple[Site, int, str]] = [
        (site, layer, group)
        for site, layer, group in product(SITES, range(of.of.n_layers + 1), groups)
        if layer or site == "residual"
    ]
    patches = [Patch(site, layer, groups[group].numpy()) for site, layer, group in wanted]
    found = patched_changes(of.of, recorded[0], recorded[1], patches, tokens) / gap
    plain = [plain_patch(of, target, source, (site, layer), groups[group]) for site, layer, group in wanted]
    expected = np.array([(plain_margin(of, logits, tokens) - own[0]) / gap for logits in plain])
    assert np.abs(found - expected).max() < 1e-5
    effect = dict(zip(wanted, found, strict=True))
    assert abs(effect["residual", 0, "visual"]) > 0.01, "the clip must tell in the answer, or nothing is compared"
    assert max(abs(effect["residual", layer, "all"] - 1) for layer in range(of.of.n_layers + 1)) < 1e-4
    if "stamps" in groups:
        assert abs(effect["residual", 0, "stamps"]) > 0.01
    told = {"qwen3-vl": [(0, "visual")], POCKET: [(0, "visual")]}
    told["gemma-4"] = [(layer, "all") for layer in range(of.of.n_layers)]
    for layer, group in told.get(name, ()):
        logits = plain_patch(of, target, source, ("residual", layer), groups[group], naive=True)
        naive = (plain_margin(of, logits, tokens) - own[0]) / gap
        assert abs(naive - effect["residual", layer, group]) > 1e-3
