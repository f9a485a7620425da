"""Tokens of a clip as providers count them; each number is worked out from the rule that the provider publishes."""

from __future__ import annotations

import pytest

from traps_pipeline.models.forecast import Experience, forecast
from traps_pipeline.models.media_tokens import anthropic_frame, expected_clip_tokens, gemini_frame, openai_frame
from traps_pipeline.models.registry import NETWORK, get_model, load_models


@pytest.mark.parametrize(
    ("model", "size", "tokens"),
    [
        ("gpt-4o", (512, 512), 85 + 170),  # a tile
        ("gpt-4o", (768, 768), 85 + 4 * 170),  # the guide's example of a square image, once scaled down
        ("gpt-5", (480, 360), 70 + 140),
        ("gpt-5-mini", (1024, 1024), 1.2 * 1024),  # 1,229 measured
        ("gpt-5-mini", (480, 360), 1.2 * 15 * 12),  # 11.25 rows of patches are 12
        ("gpt-4.1-mini", (1024, 1024), 1.62 * 1024),
        ("llama-9", (480, 360), None),
    ],
)
def test_openai_counts_tiles_or_patches(model: str, size: tuple[int, int], tokens: float | None) -> None:
    found = openai_frame(model, size)
    assert found == (tokens if tokens is None else pytest.approx(tokens))


def test_gemini_counts_frames_of_a_video_and_tiles_of_an_image() -> None:
    assert gemini_frame("gemini-2.5-pro", (480, 360), "video") == 258
    assert gemini_frame("gemini-3.1-pro-preview", (480, 360), "video") == 70
    assert gemini_frame("gemini-2.5-pro", (384, 384), "images") == 258
    assert gemini_frame("gemini-2.5-pro", (1536, 768), "images") == 2 * 258


def test_anthropic_counts_area() -> None:
    assert anthropic_frame((1000, 1000)) == pytest.approx(1334, abs=1)  # its own example
    assert anthropic_frame((200, 200)) == pytest.approx(54, abs=1)


@pytest.mark.parametrize(
    ("name", "a_frame"), [("gemini-2.5-pro", 258), ("gemini-3.1-pro", 70), ("gpt-5-high", 210), ("gpt-5-mini", 216)]
)
def test_a_plan_expects_what_the_provider_counts_and_reserves_the_upper_bound(name: str, a_frame: float) -> None:
    entry = get_model(name)
    assert entry.prices is not None and expected_clip_tokens(entry) == pytest.approx(25 * a_frame)
    planned = forecast(entry, 1, Experience())
    assert planned.dollars is not None and planned.prompt_tokens == pytest.approx(25 * a_frame + 375)
    most = entry.prices.cost(25 * entry.tokens_per_frame + 1500 + 200, 8000)
    assert planned.dollars[2] == pytest.approx(most)


def test_no_count_is_above_the_bound_that_a_budget_reserves() -> None:
    for entry in load_models().values():
        if entry.backend == NETWORK:
            assert expected_clip_tokens(entry) <= 25 * entry.tokens_per_frame, entry.id
