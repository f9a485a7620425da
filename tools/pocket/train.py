"""Training of the pocket model: a plain loop that can be stopped at any step and then continues bit for bit."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

from tools.pocket.batches import IGNORED, Batch, Batches, Scenes, name_tokens
from tools.pocket.data import data_digest
from tools.pocket.lanes import LaneScenes
from tools.pocket.model import make_model, save, start_from, train_tokenizer
from tools.pocket.recipe import SHIPPED, Recipe, Training
from traps_pipeline.base.digests import digest
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.base.files import replace_file
from traps_pipeline.models.local.library import load_transformers

if TYPE_CHECKING:
    import torch

PROGRESS_S = 30.0
CHECKPOINT_S = 120.0
LOADERS = 2  # processes that make batches for a GPU, which else would wait for them
EVENLY = "flash_evenly"  # name of `_attend_evenly` in transformers
RARE = 2.0  # offset of the initial logits: most tokens lack most colours


def look_at(model: Any, batch: Batch) -> Any:
    """Return the output of the vision tower for a batch's clips."""
    return model.model.get_video_features(batch.values, batch.grid, return_dict=True)


def attend_at_once(model: Any) -> None:
    """Let the vision tower attend within all pairs of frames of a batch in one call.

    The library calls the kernel for each pair of each clip, which takes most of a GPU's time; to an implementation with
    "flash" in its name it hands all of them over.
    """
    load_transformers().AttentionInterface.register(EVENLY, _attend_evenly)
    model.model.visual.config._attn_implementation = EVENLY


def _attend_evenly(
    module: Any, query: Any, key: Any, value: Any, attention_mask: Any, *, scaling: float, cu_seq_lens_q: Any, **_: Any
) -> tuple[Any, None]:
    """Return the attention within sequences of one length, (1, tokens, heads, size)."""
    from torch.nn.functional import scaled_dot_product_attention

    _, heads, tokens, size = query.shape
    split = (heads, len(cu_seq_lens_q) - 1, -1, size)
    q, k, v = (each.view(split).transpose(0, 1) for each in (query, key, value))
    attended = scaled_dot_product_attention(q, k, v, scale=scaling)
    return attended.transpose(1, 2).reshape(1, tokens, heads, size), None


def name_loss(model: Any, seen: Any, batch: Batch, words: torch.Tensor) -> torch.Tensor:
    """Return the naming loss: the clips' tokens, as they enter the language model, should align with the embeddings of
    the words for the contents of their square of the picture, and of no other words (binary cross-entropies, nats).

    Every word that names anything in a clip has the same weight, even if it applies to few squares. Otherwise a ball,
    which has one square, would have little weight beside boards and bins. words: from `name_tokens`.
    """
    import torch
    from torch.nn.functional import binary_cross_entropy_with_logits

    along = torch.cat(tuple(seen.pooler_output)) @ model.get_input_embeddings().weight[words].T - RARE
    loss = binary_cross_entropy_with_logits(along, batch.names, reduction="none")
    wrongly = (loss * (1 - batch.names)).sum() / len(loss)
    clips = (len(batch.ids), -1, len(words))
    rightly, squares = (loss * batch.names).view(clips).sum(1), batch.names.view(clips).sum(1)
    return wrongly + (rightly / squares.clamp(min=1)).sum() / (squares > 0).sum()


def answer_loss(model: Any, seen: Any, batch: Batch) -> torch.Tensor:
    """Return negative log-likelihood of a row's answers (nats, summed over their tokens), mean over the rows."""
    from torch.nn.functional import cross_entropy

    length, rows = len(batch.head), len(batch.ids)
    cache = model.model.language_model(
        input_ids=batch.head[None], position_ids=batch.positions[:, :1, :length], use_cache=True
    ).past_key_values
    cache.batch_repeat_interleave(rows)
    hidden = model.model(
        input_ids=batch.ids,
        attention_mask=batch.sees,
        position_ids=batch.positions[:, :, length:],
        past_key_values=cache,
        mm_encoder_outputs={"video": seen},
        video_grid_thw=batch.grid,
    ).last_hidden_state
    labels = batch.labels[:, 1:]
    in_answers = labels != IGNORED
    logits = model.lm_head(hidden[:, :-1][in_answers])  # at answers alone: the vocabulary is as wide as the model
    return cross_entropy(logits, labels[in_answers], reduction="sum") / rows


def loss_at(step: int, model: Any, batch: Batch, words: torch.Tensor, training: Training) -> torch.Tensor:
    """Return the loss at a step: at first the naming loss alone, since a model that cannot see cannot learn to
    answer.
    """
    seen = look_at(model, batch)
    names = training.naming * name_loss(model, seen, batch, words)
    return names if step < training.naming_steps else names + answer_loss(model, seen, batch)


def learning_rate(step: int, training: Training) -> float:
    """Return half a cosine down to zero over all steps, with a linear warm-up for the naming loss and again for
    answers."""
    since = step - training.naming_steps if step >= training.naming_steps else step
    warm = min(1.0, (since + 1) / max(1, training.warmup_steps))
    return training.learning_rate * warm * 0.5 * (1 + math.cos(math.pi * step / training.steps))


class _State:
    """A file of model, optimizer and number of steps, with digests of recipe and data, so that no other training
    continues from it."""

    def __init__(self, path: Path, model: Any, optimizer: Any, identity: str) -> None:
        self._path, self._identity = path, identity
        self._parts = {"model": model, "optimizer": optimizer}

    def save(self, step: int) -> None:
        """Replace the file."""
        import torch

        parts = {name: part.state_dict() for name, part in self._parts.items()}
        with replace_file(self._path) as file:
            torch.save({"step": step, "identity": self._identity, **parts}, file)

    def load(self) -> int:
        """Load the file into model and optimizer; returns its number of steps, 0 without a file."""
        import torch

        if not self._path.is_file():
            return 0
        state = torch.load(self._path, map_location="cpu", weights_only=True)
        if state["identity"] != self._identity:
            raise TrapsError(
                f"{self._path}: belongs to another recipe, data or seed; give another folder, or delete it"
            )
        for name, part in self._parts.items():
            part.load_state_dict(state[name])
        return state["step"]


def train(
    recipe: Recipe,
    data: Path,
    folder: Path,
    seed: int,
    *,
    device: str = "cpu",
    stop_after: int | None = None,
    report: Callable[[str], None] = lambda _: None,
) -> Path:
    """Train the model of a seed on a device and save it to `folder`/weights; returns that folder.

    The state is saved in `folder`/state.pt every two minutes and on Ctrl-C, and the same call continues from
    it. If training was stopped inside a step, with weights half updated, it continues from the state saved before.
    stop_after: number of the last step to do.
    """
    import torch
    from torch.utils.data import DataLoader

    scenes = LaneScenes(recipe, data) if recipe.two_events else Scenes(recipe, data)
    training, weights = recipe.training, folder / "weights"
    model, processor = make_model(train_tokenizer(scenes.records, scenes.phrases), seed)
    if recipe.start:
        start_from(model, processor.tokenizer, SHIPPED[recipe.start] / "weights")
    batches = Batches(scenes, model, processor, training, seed)
    attend_at_once(model)
    model.to(device)
    groups = [
        {"params": [p for p in model.parameters() if p.ndim >= 2], "weight_decay": training.weight_decay},
        {"params": [p for p in model.parameters() if p.ndim < 2], "weight_decay": 0.0},
    ]
    optimizer = torch.optim.AdamW(groups, lr=training.learning_rate, betas=(0.9, 0.98))
    identity = digest([recipe.content(), data_digest(recipe, "train", data), seed])
    words = name_tokens(processor.tokenizer, scenes.words).to(device)
    state = _State(folder / "state.pt", model, optimizer, identity)
    step = state.load()
    last = training.last if stop_after is None else min(stop_after, training.last)
    made = DataLoader(
        cast(Any, batches), None, sampler=range(step, last), num_workers=0 if device == "cpu" else LOADERS
    )
    reported = kept = began = time.monotonic()
    first, lately, whole = step, [], True
    model.train()
    try:
        for batch in made:
            for group in optimizer.param_groups:
                group["lr"] = learning_rate(step, training)
            loss = loss_at(step, model, batch.to(model.device), words, training)
            optimizer.zero_grad()
            loss.backward()
            torch.nn.utils.clip_grad_norm_(model.parameters(), 1.0)
            whole = False
            optimizer.step()
            step += 1
            whole = True
            lately.append(loss.detach())
            now = time.monotonic()
            if now - reported > PROGRESS_S or step == last:
                loss, left = torch.stack(lately).mean(), (now - began) / (step - first) * (training.last - step) / 60
                report(f"step {step} of {training.last}, loss {loss:.3f}, {left:.0f} min left")
                reported, lately = now, []
            if now - kept > CHECKPOINT_S:
                state.save(step)
                kept = now
    finally:
        if whole:
            state.save(step)
    if step == training.last:
        save(model.eval(), processor, weights)
    return weights
