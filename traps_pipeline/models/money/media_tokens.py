"""Estimate a clip's prompt tokens by provider, as documented or measured.

`traps plan` uses them; a budget reserves an entry's `tokens_per_frame`, an upper bound.
"""

from collections.abc import Callable
from math import ceil

from traps_pipeline.models.framing import clip_size, media_for_dataset
from traps_pipeline.models.registry.entries import ModelEntry
from traps_pipeline.scenes.picture.camera import HEIGHT, WIDTH
from traps_pipeline.storage.media import Profile

Size = tuple[int, int]  # width and height in pixels
# OpenAI's tokens of an image and of each tile in it, by the beginning of a model's name.
TILE_PRICES = {"gpt-5": (70, 140), "gpt-4.1": (85, 170), "gpt-4o": (85, 170), "o1": (75, 150), "o3": (75, 150)}
# OpenAI's tokens of a patch. These names are looked at first.
PATCH_PRICES = {"gpt-5-mini": 1.2, "gpt-5-nano": 2.46, "gpt-4.1-mini": 1.62, "gpt-4.1-nano": 2.46, "o4-mini": 1.72}
STAMP = 8  # Qwen3-VL: the time before two frames, and the marks around them


def openai_frame(model: str, size: Size) -> float | None:
    """Return an image's tokens at detail auto or high; None for other vendors' models.

    OpenAI's models count tiles of 512 pixels, or patches of 32. Frames are small enough not to be scaled down, and are
    not enlarged.

    https://platform.openai.com/docs/guides/images-vision (calculating costs). It says 1.62 tokens a patch of
    gpt-5-mini; 1.20 were measured at the API with six sizes (OpenAI Developer Community, "GPT-5-mini image input token
    calculation discrepancy", 2026-06-17).
    """
    width, height = size
    for name, patch_rule in PATCH_PRICES.items():
        if model.startswith(name):
            return patch_rule * ceil(width / 32) * ceil(height / 32)
    for name, (base, tile) in TILE_PRICES.items():
        if model.startswith(name):
            return base + tile * ceil(width / 512) * ceil(height / 512)
    return None


def gemini_frame(model: str, size: Size, profile: Profile) -> float:
    """Return the tokens of an image or a video frame at Gemini's default resolution.

    Up to Gemini 2.5: 258 tokens a frame (that is 258 a second at one frame a second), and 258 an image of at most 384
    pixels, or each tile of 768 (https://ai.google.dev/gemini-api/docs/tokens). Gemini 3: 70 a frame and 1,120 an image
    (https://ai.google.dev/gemini-api/docs/media-resolution). Clips have no sound, which would count 32 a second.
    """
    is_old = model.startswith(("gemini-1", "gemini-2"))
    if profile == "video":
        return 258 if is_old else 70
    return 258 * ceil(size[0] / 768) * ceil(size[1] / 768) if is_old else 1120


def anthropic_frame(size: Size) -> float:
    """Return the tokens of an image of at most 1,568 pixels a side: area / 750.

    https://docs.anthropic.com/en/docs/build-with-claude/vision
    """
    return size[0] * size[1] / 750


def qwen3_vl_frame(size: Size, profile: Profile) -> float:
    """Return the tokens of a frame: cells of 32 pixels, rounded up in each direction.

    Two frames of a video share their cells and have a time before them (the model's own processor in transformers).
    """
    cells = round(size[0] / 32) * round(size[1] / 32)
    return (cells + STAMP) / 2 if profile == "video" else cells + 2


def clip_tokens(entry: ModelEntry, dataset: str = "") -> tuple[float, float]:
    """Return the prompt tokens of a dataset's clip: expected (of an unknown model the maximum), and maximum."""
    if entry.media is None:
        return 0.0, 0.0
    media = media_for_dataset(entry.media, dataset)
    frames, bound = media.uniform or media.most, frame_bound(entry, dataset)
    count = _frame_tokens(entry, media.size or clip_size(dataset), media.profile)
    return frames * (bound if count is None else count), float(frames * bound)


def frame_bound(entry: ModelEntry, dataset: str) -> int:
    """Return the maximum tokens of a frame: `tokens_per_frame`, of a wide clip as many more as it may count for."""
    size = clip_size(dataset)
    if entry.media is None or entry.media.size is not None or size == (WIDTH, HEIGHT):
        return entry.tokens_per_frame
    counts = [_frame_tokens(entry, each, entry.media.profile) for each in (size, (WIDTH, HEIGHT))]
    by_count = counts[0] / counts[1] if counts[0] and counts[1] else 1.0
    return ceil(entry.tokens_per_frame * max(by_count, size[0] / WIDTH))


def _frame_tokens(entry: ModelEntry, size: Size, profile: Profile) -> float | None:
    """Return a frame's prompt tokens; None for unknown models."""
    route, _, model_name = str(entry.provider_id).partition("/")
    model = model_name.removeprefix("responses/")
    counts: dict[str, Callable[[], float | None]] = {
        "openai": lambda: openai_frame(model, size),
        "gemini": lambda: gemini_frame(model, size, profile),
        "vertex_ai": lambda: gemini_frame(model, size, profile),
        "anthropic": lambda: anthropic_frame(size),
    }
    return qwen3_vl_frame(size, profile) if "qwen3-vl" in model.lower() else counts.get(route, lambda: None)()
