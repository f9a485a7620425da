"""Run a checkpoint in memory: prompts, hidden states and answers."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from functools import cached_property
from threading import Lock
from typing import TYPE_CHECKING, Any

import numpy as np

from traps_pipeline.base import progress
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.base.wording import count_noun
from traps_pipeline.models.local import chat_template
from traps_pipeline.models.local.capture import Pooling, capture_states
from traps_pipeline.models.local.decoding import Steers, decode, steering_context
from traps_pipeline.models.local.library import load_transformers
from traps_pipeline.models.local.prompt_batches import Prompt, prompt_batches
from traps_pipeline.models.local.sampling import Sampling
from traps_pipeline.models.local.vision_cache import ClipMemory
from traps_pipeline.models.registry.checkpoint import Checkpoint, free_bytes
from traps_pipeline.models.registry.local_settings import SPREAD, LocalParams

if TYPE_CHECKING:
    from torch import Tensor
    from torch.nn import Module

CLOCK_FPS = 1000  # resolution of time stamps for processors: milliseconds
MEMORY_SHARE = 0.7  # share of free memory for a batch, by estimate


@dataclass(frozen=True)
class GeneratedAnswer:
    """An answer, its end (stop, or length), and its likeliest first tokens' log-probs."""

    text: str
    prompt_tokens: int
    completion_tokens: int
    finish_reason: str
    tokens: tuple[int, ...]
    first_token: Mapping[str, float]


@dataclass(frozen=True, eq=False)
class States:
    """Hidden states of one prompt, float32.

    raw: (n_layers + 1, d_model), counted as in hidden_states, each as it leaves its block. normed: (d_model,), the last
    one after the final norm: the library's hidden_states[-1].
    """

    raw: np.ndarray = field(repr=False)
    normed: np.ndarray = field(repr=False)


class LocalModel:
    """A checkpoint in memory, with the entry's device, dtype and quantisation."""

    def __init__(self, network: Any, processor: Any, checkpoint: Checkpoint, params: LocalParams, device: str) -> None:
        self.network, self.processor, self.checkpoint, self.params, self.device = (
            network, processor, checkpoint, params, device,
        )  # fmt: skip
        self.inputs_device = str(network.device) if device == SPREAD else device  # device of the embeddings
        self.dtype, self.quantisation = params.dtype, params.quantisation
        self.blocks, self.norm = _decoder_parts(network, checkpoint.name)
        self.n_layers, self.d_model = len(self.blocks), int(network.config.get_text_config().hidden_size)
        self.clips = ClipMemory()
        self._processing = Lock()  # tokenizers are not thread-safe
        network.generation_config = self._plain_generation()

    def _plain_generation(self) -> Any:
        """Return generation settings with only the answer's end and suppressed tokens.

        A checkpoint's own top_k or repetition penalty would otherwise apply unasked. Placeholders of pictures are
        suppressed: an answer that contained one could not be tokenized again.
        """
        config, tokenizer = self.network.generation_config, self.processor.tokenizer
        eos = config.eos_token_id if config.eos_token_id is not None else tokenizer.eos_token_id
        if eos is None:
            raise TrapsError(
                f"checkpoint {self.checkpoint.name}: names no token that ends an answer; set eos_token_id in its "
                "generation_config.json"
            )
        pad = tokenizer.pad_token_id if tokenizer.pad_token_id is not None else config.pad_token_id
        placeholders = [getattr(self.processor, f"{kind}_token_id", None) for kind in ("image", "video", "audio")]
        return load_transformers().GenerationConfig(
            eos_token_id=eos,
            pad_token_id=pad if pad is not None else eos if isinstance(eos, int) else eos[0],
            bos_token_id=config.bos_token_id,
            suppress_tokens=sorted({*(config.suppress_tokens or ()), *filter(None, placeholders)}) or None,
            do_sample=False,
        )

    @cached_property
    def identity(self) -> dict[str, Any]:
        """The settings that decide hidden states besides the prompt (no paths, no device), for keys."""
        return {
            "checkpoint_digest": self.checkpoint.digest,
            "class": type(self.network).__name__,
            "dtype": self.dtype,
            "quantisation": self.quantisation,
            "nf4_skip": list(self.params.nf4_skip),
            "attn_implementation": self.params.attn_implementation,
            "template": self.params.template,
            "video": self.params.video,
        }

    @property
    def served_model(self) -> str:
        """The model's name in the ledger: checkpoint and digest, precision, and device."""
        precision = self.dtype if self.quantisation == "none" else f"{self.quantisation}/{self.dtype}"
        return f"{self.checkpoint.name}@{self.checkpoint.digest[:12]} {precision} on {self.device_name}"

    @property
    def device_name(self) -> str:
        """The device as in the entry, with the name of a GPU."""
        if not self.device.startswith("cuda"):
            return self.device
        import torch

        return f"{self.device} ({torch.cuda.get_device_name(self.device)})"

    def block(self, layer: int) -> Module:
        """Return the block whose output is hidden_states[layer]. Raises TrapsError for a layer that is missing."""
        if not 1 <= layer <= self.n_layers:
            raise TrapsError(
                f"{self.checkpoint.name}: no block {layer}; it has blocks 1 to {self.n_layers} (layer 0 are the "
                "embeddings, layer l the output of the l-th block): name one of these"
            )
        return self.blocks[layer - 1]

    # --- prompts ------------------------------------------------------------------------------------------------------

    def prompt(self, system: str, user: str, frames: np.ndarray, times_s: Sequence[float] | np.ndarray) -> Prompt:
        """Return the prompt: system prompt, then clip and question, nothing else (docs/spec.md 3.3).

        frames: (N, H, W, 3) uint8 RGB, all of them shown. times_s: (N,) seconds into the clip, which models that read
        time stamps get exactly. Raises TrapsError if the chat template loses a part.
        """
        text = self._render(system, user)
        marks = [round(1000 * float(time)) for time in times_s]
        total = shown_frames(marks)
        clock = {"total_num_frames": total, "fps": float(CLOCK_FPS), "frames_indices": marks,
                 "duration": total / CLOCK_FPS, "height": frames.shape[1], "width": frames.shape[2]}  # fmt: skip
        bos = self.processor.tokenizer.bos_token
        with self._processing:
            inputs = self.processor(
                text=[text],
                videos=[np.ascontiguousarray(frames)],
                video_metadata=[clock],
                do_sample_frames=False,
                return_tensors="pt",
                add_special_tokens=not (bos and text.startswith(bos)),
                **self.params.video,
            )
        inputs.pop("video_metadata", None)
        return Prompt(text, dict(inputs))

    def _render(self, system: str, user: str) -> str:
        content = [{"type": "video"}, {"type": "text", "text": user}]
        turns = [
            {"role": "system", "content": [{"type": "text", "text": system}]},
            {"role": "user", "content": content},
        ]
        template, tokens = self.processor.chat_template, self.processor.tokenizer.special_tokens_map
        template = template["default"] if isinstance(template, dict) else template
        variables = {name: str(token) for name, token in tokens.items()} | self.params.template
        text = chat_template.render(self.checkpoint.name, template, turns, variables)
        if text.count(self.processor.video_token) != 1 or text.count(system) != 1 or text.count(user) < 1:
            raise TrapsError(
                f"{self.checkpoint.name}: its chat template does not keep system prompt, clip and question as they are "
                f"({text[:200]!r}); give `params.template` the variables it wants, or the checkpoint another template"
            )
        return text

    def caching_clips(self) -> AbstractContextManager[None]:
        """Cache the vision tower's output per clip within the block."""
        return self.clips.remembering(self.network)

    # --- hidden states ------------------------------------------------------------------------------------------------

    def forward(self, prompt: Prompt) -> Any:
        """Return the library's output of a bare pass, without logits or gradients."""
        import torch

        with torch.inference_mode():
            return self.network.base_model(**self.placed(prompt.inputs), use_cache=False)

    def forward_states(
        self,
        prompt: Prompt,
        pooling: Pooling = "last",
        steering: Steers | None = None,
        chosen: np.ndarray | None = None,
    ) -> States:
        """Return the hidden states of one prompt at every layer.

        The batch size is 1, so that in 16 bits no other prompt matters. chosen: for poolings over a part of the prompt,
        its tokens (T,) bool. `answer` generates the first token of the greedy answer, and takes the state at it.
        """
        import torch

        mask = None if chosen is None else torch.from_numpy(chosen)
        if pooling == "answer":
            prompt = prompt.followed_by(self.generate([prompt], 1, steering=steering)[0].tokens)
        with steering_context(steering, self), capture_states(iter(self.blocks), self.norm, pooling, mask) as states:
            self.forward(prompt)
        assert states.normed is not None and len(states.raw) == self.n_layers + 1
        rows = torch.stack([row.float().cpu() for row in (*states.raw, states.normed)]).numpy()
        return States(rows[:-1], rows[-1])

    # --- answers ------------------------------------------------------------------------------------------------------

    def generate(
        self,
        prompts: Sequence[Prompt],
        max_new_tokens: int,
        sampling: Sampling | None = None,
        steering: Steers | None = None,
        *,
        stopped: Callable[[], bool] = lambda: False,
    ) -> list[GeneratedAnswer]:
        """Return an answer to each prompt, in order; greedy unless sampling is given.

        Batches are sized to memory, and halved after an out-of-memory error; answers depend on them only through
        rounding in 16 bits. sampling, steering: one row per prompt. stopped: called at every token, ends generation
        early. Raises TrapsError if a single prompt does not fit.
        """
        answers: dict[int, GeneratedAnswer] = {}
        row_bytes = [self._row_bytes(prompt, max_new_tokens) for prompt in prompts]
        for group in prompt_batches(prompts, row_bytes, MEMORY_SHARE * free_bytes(self.device)):
            pending = [group]
            while pending:
                rows = pending.pop()
                fitting_answers = self._generate_fitting(prompts, rows, max_new_tokens, sampling, steering, stopped)
                if fitting_answers is None:
                    middle = len(rows) // 2
                    pending += [rows[middle:], rows[:middle]]
                else:
                    answers.update(zip(rows, fitting_answers, strict=True))
        return [answers[i] for i in range(len(prompts))]

    def _generate_fitting(
        self,
        prompts: Sequence[Prompt],
        rows: Sequence[int],
        max_new_tokens: int,
        sampling: Sampling | None,
        steering: Steers | None,
        stopped: Callable[[], bool],
    ) -> list[GeneratedAnswer] | None:
        """Return the answers of a batch; None if it must be halved."""
        import torch

        batch = [prompts[i] for i in rows]
        sampling, steering = sampling and sampling.rows(rows), steering and steering.rows(rows)
        try:
            tokens, first = decode(self, batch, max_new_tokens, sampling, steering, stopped)
            return [self._answer(*row) for row in zip(batch, tokens, first, strict=True)]
        except torch.OutOfMemoryError:
            if len(rows) == 1:
                raise TrapsError(
                    f"{self.checkpoint.name}: too little memory on {self.device} for one prompt of "
                    f"{prompts[rows[0]].n_tokens} tokens and {max_new_tokens} new ones: free memory, show fewer frames "
                    "or use a larger device"
                ) from None
        torch.cuda.empty_cache()  # outside the handler, where the failed pass has been freed
        progress.current().note(
            f"{self.checkpoint.name}: {count_noun(len(rows), 'row')} need more than the memory, trying half of them"
        )
        return None

    def _answer(self, prompt: Prompt, tokens: list[int], first: Mapping[int, float]) -> GeneratedAnswer:
        eos = self.network.generation_config.eos_token_id
        ends = {eos} if isinstance(eos, int) else {*eos}
        end_index = next((i for i, token in enumerate(tokens) if token in ends), None)
        own_tokens = tokens if end_index is None else tokens[: end_index + 1]
        with self._processing:
            text = self.processor.tokenizer.decode(own_tokens, skip_special_tokens=True)
            logprob_of = dict[str, float]()
            for token, logprob in first.items():  # several may have one text
                name = self.processor.tokenizer.decode([token])
                logprob_of[name] = float(np.logaddexp(logprob_of.get(name, -np.inf), logprob))
        finish_reason = "length" if end_index is None else "stop"
        return GeneratedAnswer(text, prompt.n_tokens, len(own_tokens), finish_reason, tuple(own_tokens), logprob_of)

    def placed(self, inputs: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Return inputs on the model's device, with pictures in its precision."""
        dtype, device = self.network.dtype, self.inputs_device
        return {
            name: value.to(device, dtype) if value.is_floating_point() else value.to(device)
            for name, value in inputs.items()
        }

    def _row_bytes(self, prompt: Prompt, max_new_tokens: int) -> float:
        """Return an upper estimate of a row's memory, in bytes."""
        item, vocabulary = self.network.dtype.itemsize, self.network.config.get_text_config().vocab_size
        cache = self._cached_width * item * (prompt.n_tokens + max_new_tokens)
        passing = 28 * prompt.n_tokens * self.d_model * item  # a block's peak: residual, gate, up and down
        pictures = 8 * sum(value.numel() for value in prompt.inputs.values() if value.is_floating_point()) * item
        return cache + passing + pictures + 6 * vocabulary * 4

    @cached_property
    def _cached_width(self) -> int:
        """Cached numbers per token over all blocks that do not share another's cache."""
        names = ("k_proj", "v_proj")
        widths = [module.out_features for name, module in self.blocks.named_modules() if name.endswith(names)]
        return sum(widths) or 2 * self.n_layers * self.d_model


def shown_frames(marks: Sequence[int]) -> int:
    """Return the number of frames of a clip, from the indices of the N shown.

    Classes that take one number for the step compute it as this over N (Qwen2.5-VL).
    """
    step = (marks[-1] - marks[0]) / (len(marks) - 1) if len(marks) > 1 else marks[-1] + 1
    return max(1, round(len(marks) * step))


def _decoder_parts(network: Any, name: str) -> tuple[Any, Any]:
    """Return the language model's blocks and final norm, or raise TrapsError."""
    decoder = network.get_decoder() if hasattr(network, "get_decoder") else None
    blocks, norm = getattr(decoder, "layers", None), getattr(decoder, "norm", None)
    expected = getattr(network.config.get_text_config(), "num_hidden_layers", None)
    if blocks is None or norm is None or len(blocks) != expected:
        count = "none" if blocks is None else len(blocks)
        raise TrapsError(
            f"checkpoint {name}: {type(network).__name__} has not the expected layers (get_decoder().layers: {count}, "
            f"its configuration says {expected}; final norm: {'missing' if norm is None else 'there'}): the adapter "
            "cannot look inside it"
        )
    return blocks, norm
