"""The training data of the pocket model: scenes, the questions about their clips, and batches of them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Generic

import numpy as np

from tools.pocket.data import Question, Record, SceneRecord, read_shards
from tools.pocket.model import PATCH
from tools.pocket.recipe import Recipe, Split, Training
from tools.pocket.words import COLUMNS, PROMPTS, ROWS, place_question, prompt_text, say
from traps_pipeline.scenes.family_registry import get_family
from traps_pipeline.storage.media import pick

if TYPE_CHECKING:
    import torch

IGNORED = -100
NAMED = ("red", "green", "blue", "yellow", "orange", "cyan", "purple", "white", "black")
SEEN_PX = 5  # pixels of a colour, of a token's 256, from which on it is seen; the smallest ball has a dozen
_QUESTION = "{question}"  # placeholder for the questions in the chat


@dataclass(frozen=True)
class Look:
    """One clip and the questions about it. side: 0 control, 1 void, 2 decoy. pairs: the pairs of frames that are shown
    of it, None for all."""

    scene: int
    side: int
    questions: tuple[Question, ...]
    pairs: tuple[int, ...] | None = None


class Clips(Generic[Record]):
    """The records of a split's scenes, and their frames on disk."""

    words: ClassVar[tuple[str, ...]] = ()  # that name tokens beside those of `names_of`
    phrases: ClassVar[tuple[str, ...]] = ()  # that are single tokens beside those of `words.phrases`

    def __init__(self, recipe: Recipe, folder: Path, split: Split, read: Callable[[str], Record]) -> None:
        self.records: list[Record] = []
        self._frames: list[np.ndarray] = []
        self._place: list[tuple[int, int]] = []
        self._recipe = recipe
        self._names: dict[tuple[int, int], np.ndarray] = {}  # of what was looked at: a tenth of a step otherwise
        for shard, (job, records) in enumerate(read_shards(recipe, split, folder, read)):
            self._frames.append(np.load(job.pixels, mmap_mode="r", allow_pickle=False))
            self._place += [(shard, i) for i in range(len(records))]
            self.records += records

    def frames(self, scene: int, side: int, pairs: Sequence[int] | None = None) -> np.ndarray:
        """Return the frames of a clip, uint8 (N, H, W, 3); pairs: of these pairs of frames alone."""
        shard, place = self._place[scene]
        frames = self._frames[shard][place, side]
        return frames if pairs is None else frames[[2 * pair + i for pair in pairs for i in (0, 1)]]

    def names(self, scene: int, side: int, pairs: Sequence[int] | None = None) -> np.ndarray:
        """Return the words that name every token of a clip, or of these pairs of its frames, as in `names_of`."""
        known = (scene, side)
        if known not in self._names:
            self._names[known] = self._named(*known)
        every = self._names[known]
        if pairs is None:
            return every
        tokens = len(every) // (len(self.times(scene, side)) // 2)
        return every.reshape(-1, tokens, every.shape[1])[[*pairs]].reshape(-1, every.shape[1])

    def times(self, scene: int, side: int) -> list[float]:
        """Return the seconds into the clip of each frame."""
        raise NotImplementedError

    def _named(self, scene: int, side: int) -> np.ndarray:
        raise NotImplementedError

    def pairs(self, scene: int, side: int, count: int | None, rng: np.random.Generator) -> tuple[int, ...] | None:
        """Return so many pairs of a clip's frames, in their order; None for all."""
        raise NotImplementedError

    def label(self, look: Look, question: Question, prompt_name: str) -> str | None:
        """Return the answer to train under a prompt, None for an abstention."""
        raise NotImplementedError

    def look(self, rng: np.random.Generator, void_share: float) -> Look:
        """Return a random clip with its questions."""
        raise NotImplementedError


class Scenes(Clips[SceneRecord]):
    """All training scenes of pairs."""

    def __init__(self, recipe: Recipe, folder: Path) -> None:
        super().__init__(recipe, folder, "train", SceneRecord.read)

    def _named(self, scene: int, side: int) -> np.ndarray:
        closed = self._open_frames(scene, side)
        return names_of(self.frames(scene, side), closed // 2 if closed % 2 else None)

    def times(self, scene: int, side: int) -> list[float]:
        """Return the seconds into the clip of each frame."""
        record = self.records[scene]
        every = np.arange(record.length(side)) / get_family(record.family).physics.fps
        return every[pick(every, self._recipe.media)].tolist()

    def _open_frames(self, scene: int, side: int) -> int:
        """Return how many of the frames shown come before an occluder closes the clip; nothing closes a decoy. Those of
        a void that an occluder hides from its beginning are at the same times as its control's, which else would tell
        the side."""
        record, times = self.records[scene], self.times(scene, side)
        closes = None if side == 2 else record.closes_frame
        if closes is None:
            return len(times)
        closes_s = (closes - (record.control_from if side == 0 else 0)) / get_family(record.family).physics.fps
        return sum(time < closes_s - 1e-6 for time in times)

    def pairs(self, scene: int, side: int, count: int | None, rng: np.random.Generator) -> tuple[int, ...] | None:
        """So many pairs of a clip's frames, in their order: the last one that an occluder does not close, and others at
        random. Each keeps the time and the position that it has in the whole clip, so that a model which learns from
        few has only to learn of the others that they matter less. None for all."""
        every = len(self.times(scene, side)) // 2
        if count is None or count >= every:
            return None
        last = (self._open_frames(scene, side) - 1) // 2
        others = [pair for pair in range(every) if pair != last]
        return tuple(sorted([last, *(int(pair) for pair in rng.permutation(others)[: count - 1])]))

    def label(self, look: Look, question: Question, prompt_name: str) -> str | None:
        """Return the answer to train under a prompt, None for an abstention."""
        record = self.records[look.scene]
        answered = question in (record.asked, record.answerable)
        return question.label(self._recipe.share(prompt_name, record.ball, void=not answered))

    def look(self, rng: np.random.Generator, void_share: float) -> Look:
        """Return a random clip with its question, another one (answerable or ill-posed), and two for the place of its
        ball."""
        scene, side = int(rng.integers(len(self.records))), int(rng.random() < void_share)
        record = self.records[scene]
        if side:
            where = () if record.cut_frame is None else _where(record, "cut")
            return Look(scene, side, (record.visual, record.answerable, *where))
        other = record.ill_posed if rng.random() < 0.5 else record.answerable
        if record.decoy and rng.random() < self._recipe.decoys:
            return Look(scene, 2, (record.asked, other))  # another camera: the ball's place is not known
        return Look(scene, side, (record.asked, other, *_where(record, "last")))


def _where(record: SceneRecord, frame: str) -> tuple[Question, Question]:
    """Return the questions for the column and the row of the ball at the end of a clip."""
    place = record.places[frame]
    return Question(*place_question(record.ball, place, 0)), Question(*place_question(record.ball, place, 1))


@dataclass(frozen=True)
class Batch:
    """The input of one step. All rows share one system prompt, `head` (P,), which is computed once.

    A row is a clip followed by its questions with their answers; the attention mask hides the questions from each
    other. ids, labels (B, S), with IGNORED outside the answers; sees (B, 1, S, P + S) bool, the attention mask;
    positions (3, B, P + S). pixels: uint8, one row per patch; gains (B,): by how much each clip is made brighter; scale
    (2, values of a patch): mean and standard deviation. names: the words that name every token of the clips, as in
    `names_of`, float32.
    """

    head: torch.Tensor
    ids: torch.Tensor
    labels: torch.Tensor
    sees: torch.Tensor
    positions: torch.Tensor
    pixels: torch.Tensor
    grid: torch.Tensor
    names: torch.Tensor
    gains: torch.Tensor
    scale: torch.Tensor

    @property
    def values(self) -> torch.Tensor:
        """The pixels as the vision tower takes them: made brighter, then less the mean, by the standard deviation."""
        gains = self.gains.repeat_interleave(len(self.pixels) // len(self.gains))
        mean, std = self.scale
        return ((self.pixels * gains[:, None]).clamp(max=255) / 255 - mean) / std

    def to(self, device: torch.device) -> Batch:
        """Return the batch on a device."""
        return Batch(*(getattr(self, field.name).to(device, non_blocking=True) for field in fields(self)))


class Batches:
    """Batches by number; batch n depends only on the seed and n."""

    def __init__(self, scenes: Clips[Any], model: Any, processor: Any, training: Training, seed: int) -> None:
        import torch

        self._scenes, self._processor, self._training, self._seed = scenes, processor, training, seed
        self._rope_index = model.model.get_rope_index
        video = processor.video_processor
        scale = torch.tensor([video.image_mean, video.image_std])
        self._scale = scale.repeat_interleave(2 * PATCH * PATCH, dim=1)  # of every value of a patch
        # Caches, since many repeat: texts as tokens, chats by prompt, positions by lengths.
        self._known: dict[str, list[int]] = {}
        self._chats: dict[str, str] = {}
        self._places: dict[tuple[int, ...], torch.Tensor] = {}

    def __getitem__(self, step: int) -> Batch:
        rng = np.random.default_rng([self._seed, step])
        prompt_name = PROMPTS[int(rng.integers(len(PROMPTS)))]
        drawn = [self._scenes.look(rng, self._training.void_share) for _ in range(self._training.batch)]
        count = self._training.pairs_at(step)
        looks = [replace(look, pairs=self._scenes.pairs(look.scene, look.side, count, rng)) for look in drawn]
        frames = np.stack([self._scenes.frames(look.scene, look.side, look.pairs) for look in looks])
        gains = 1 + self._training.brightness * rng.uniform(-1, 1, len(looks)).astype(np.float32)
        return self.make(looks, prompt_name, frames, gains)

    def make(
        self, looks: Sequence[Look], prompt_name: str, frames: np.ndarray, gains: np.ndarray | None = None
    ) -> Batch:
        """Return the batch of some clips, as many pairs of each, frames (B, N, H, W, 3) uint8, under one of PROMPTS."""
        import torch

        grid = (frames.shape[1] // 2, frames.shape[2] // PATCH, frames.shape[3] // PATCH)
        pieces = [self._pieces(look, prompt_name, grid) for look in looks]
        head = self._ids(pieces[0][0])
        clips = [[self._ids(part) for part in clip] for _, clip, _ in pieces]
        talks = [[tuple(map(self._ids, texts)) for texts in questions] for _, _, questions in pieces]
        names = [self._scenes.names(look.scene, look.side, look.pairs) for look in looks]
        rows = self._rows(head, clips, [look.pairs for look in looks], talks, grid[1:])
        return Batch(
            torch.tensor(head),
            *rows,
            pixels=patches(torch.from_numpy(frames).permute(0, 1, 4, 2, 3)),
            grid=torch.tensor([grid] * len(looks)),
            names=torch.from_numpy(np.concatenate(names)).float(),
            gains=torch.ones(len(looks)) if gains is None else torch.from_numpy(gains),
            scale=self._scale,
        )

    def _pieces(
        self, look: Look, prompt_name: str, grid: tuple[int, int, int]
    ) -> tuple[str, list[str], list[tuple[str, str, str]]]:
        """Return the chat as the processor writes it, cut into pieces: the system's part; the whole clip, in which all
        but the first and the last piece are a pair of frames each, as a time stamp and placeholders for tokens; and for
        each question its text with the beginning of the answer, the answer, and its hint."""
        processor, token = self._processor, self._processor.video_token
        times = self._scenes.times(look.scene, look.side)
        pairs = [
            f"<{(first + last) / 2:.1f} seconds>{processor.vision_start_token}"
            f"{token * (grid[1] * grid[2] // 4)}{processor.vision_end_token}"
            for first, last in zip(times[::2], times[1::2], strict=True)
        ]
        chat = self._chat(prompt_name)
        head, user, rest = chat.partition(f"{processor.tokenizer.start_token}user")
        before, _, rest = rest.partition(token)
        between, after = rest.split(_QUESTION)
        end = processor.tokenizer.eos_token
        labels = [self._scenes.label(look, question, prompt_name) for question in look.questions]
        questions = [
            (question.question + after, say(label, prompt_name) + end, question.hint or "")
            for question, label in zip(look.questions, labels, strict=True)
        ]
        return head, [user + before, *pairs, between], questions

    def _chat(self, prompt_name: str) -> str:
        """Return the chat with placeholders for clip and question."""
        if prompt_name not in self._chats:
            messages = [
                {"role": "system", "content": [{"type": "text", "text": prompt_text(prompt_name)}]},
                {"role": "user", "content": [{"type": "video"}, {"type": "text", "text": _QUESTION}]},
            ]
            chat = self._processor.apply_chat_template(messages, tokenize=False, add_generation_prompt=True)
            self._chats[prompt_name] = chat
        return self._chats[prompt_name]

    def _ids(self, text: str) -> list[int]:
        if text not in self._known:
            self._known[text] = self._processor.tokenizer(text, add_special_tokens=False)["input_ids"]
        return self._known[text]

    def _rows(
        self,
        head: list[int],
        clips: list[list[list[int]]],
        shown: list[tuple[int, ...] | None],
        talks: Sequence[Sequence[Sequence[list[int]]]],
        grid: tuple[int, int],
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
        """ids, labels, sees and positions of `Batch`. clips: in pieces, as `_pieces` says; shown: the pairs of frames
        that are shown; grid: rows and columns of patches."""
        import torch

        rows = [self._placed(head, *clip, grid) for clip in zip(clips, shown, strict=True)]
        longest = max(
            len(clip) + sum(len(question) + len(answer) for question, answer, _ in talk)
            for (clip, _, _), talk in zip(rows, talks, strict=True)
        )
        ids = torch.full((len(clips), longest), self._processor.tokenizer.pad_token_id)
        labels, part = torch.full_like(ids, IGNORED), torch.full_like(ids, -1)
        positions = torch.zeros(3, len(clips), len(head) + longest, dtype=torch.long)
        for i, ((clip, placed, free), talk) in enumerate(zip(rows, talks, strict=True)):
            at = len(clip)
            ids[i, :at], part[i, :at] = clip, 0
            positions[:, i, : len(head) + at] = placed
            for number, (question, answer, hint) in enumerate(talk, start=1):
                end = at + len(question) + len(answer)
                ids[i, at:end], part[i, at:end] = torch.tensor(question + answer), number
                labels[i, at + len(question) : end] = torch.tensor(answer)
                labels[i, at + 2 : at + 2 + 2 * len(hint)] = torch.tensor(2 * hint)
                positions[:, i, len(head) + at : len(head) + end] = torch.arange(free, free + end - at)
                at = end
        own = (part[:, :, None] == part[:, None, :]) | (part == 0)[:, None, :]
        own = own & torch.ones(longest, longest, dtype=torch.bool).tril()
        sees = torch.cat([torch.ones(len(clips), longest, len(head), dtype=torch.bool), own], dim=2)
        return ids, labels, sees[:, None], positions

    def _placed(
        self, head: list[int], clip: list[list[int]], shown: tuple[int, ...] | None, grid: tuple[int, int]
    ) -> tuple[torch.Tensor, torch.Tensor, int]:
        """Return the ids (A,) of a clip's pieces without the pairs of frames that are not shown; the positions (3, P +
        A) that the system's part and they have in the whole clip; and the first position behind the whole clip."""
        import torch

        tokens = torch.tensor([head + [token for piece in clip for token in piece]])
        kinds = (tokens == self._processor.video_token_id).int() * 2  # 2: video, as the library counts modalities
        every = range(len(clip) - 2)
        # The pair of frames of each piece; the first two are the system's part and the clip's opening.
        pieces = [None, None, *every, None]
        lengths = [len(head), *map(len, clip)]
        if (key := (*grid, *lengths)) not in self._places:
            where, _ = self._rope_index(tokens, kinds, video_grid_thw=torch.tensor([[len(every), *grid]]))
            self._places[key] = where
        placed = self._places[key]
        kept = [pair is None or shown is None or pair in shown for pair in pieces]
        mask = torch.tensor(kept).repeat_interleave(torch.tensor(lengths))
        return tokens[0, mask][len(head) :], placed[:, 0, mask], int(placed.max()) + 1


def patches(frames: torch.Tensor) -> torch.Tensor:
    """Return frames (B, N, 3, H, W) in the input format of the class: one row per patch of two frames; patches that the
    model merges are adjacent."""
    batch, count, channels, height, width = frames.shape
    rows, columns = height // PATCH, width // PATCH
    split = frames.view(batch, count // 2, 2, channels, rows // 2, 2, PATCH, columns // 2, 2, PATCH)
    split = split.permute(0, 1, 4, 7, 5, 8, 3, 2, 6, 9)
    return split.reshape(batch * count // 2 * rows * columns, channels * 2 * PATCH * PATCH)


def names_of(frames: np.ndarray, across: int | slice | None = None) -> np.ndarray:
    """For every token of a clip (N, H, W, 3), in their order, the words that name its square in the later of its two
    frames: the colours that have a few pixels there, its column and its row. Shape (tokens, words), uint8, 0 or 1.

    across: the pair of frames (or several) between which an occluder comes. There the colours of both count: the
    earlier one may be the only one of all that shows the outcome.
    """
    from traps_pipeline.scenes.parts.vision import colour_mask

    earlier, later, square = frames[::2], frames[1::2], 2 * PATCH
    slots, rows, columns = len(later), frames.shape[1] // square, frames.shape[2] // square

    def colours_of(shown: np.ndarray) -> np.ndarray:
        tall = shown.reshape(-1, frames.shape[2], 3)
        cells = (len(shown) * rows, square, columns, square)
        seen = [colour_mask(tall, colour).reshape(cells).sum(axis=(1, 3)) >= SEEN_PX for colour in NAMED]
        return np.stack(seen, axis=-1).reshape(len(shown), rows, columns, len(NAMED))

    colours = colours_of(later)
    if across is not None:
        colours[across] |= colours_of(earlier)[across]
    column = np.eye(len(COLUMNS))[np.arange(columns) * len(COLUMNS) // columns]
    row = np.eye(len(ROWS))[np.arange(rows) * len(ROWS) // rows]
    places = [
        np.broadcast_to(column, (slots, rows, *column.shape)),
        np.broadcast_to(row[:, None], (slots, rows, columns, len(ROWS))),
    ]
    named = np.concatenate([colours, *places], axis=-1)
    return named.reshape(-1, named.shape[-1]).astype(np.uint8)


def name_tokens(tokenizer: Any, more: Sequence[str] = ()) -> torch.Tensor:
    """Return token ids of the words of `names_of` and more: colours as they stand in questions, the others as in
    answers. A word that is no single token, which happens only with few scenes, has the id of its first piece."""
    import torch

    words = [*(f" {colour}" for colour in NAMED), *COLUMNS, *ROWS, *more]
    return torch.tensor([tokenizer.encode(word, add_special_tokens=False)[0] for word in words])
