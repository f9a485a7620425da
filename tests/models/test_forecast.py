"""What calls take, worked out by hand and from the rules by which providers say that they count a clip."""

from __future__ import annotations

import datetime
import math
from pathlib import Path
from typing import Any

import pytest

from traps_pipeline.ledger.rows import Totals
from traps_pipeline.models.money import forecast as forecasts
from traps_pipeline.models.money.forecast import Experience, experience, forecast
from traps_pipeline.models.money.media_tokens import anthropic_frame, clip_tokens, gemini_frame, openai_frame
from traps_pipeline.models.registry.accounts import Account
from traps_pipeline.models.registry.entries import NETWORK, ModelEntry, get_model, load_models


def model(**changes: Any) -> ModelEntry:
    """gemini-2.5-pro at $1 and $10 a million tokens, 100 tokens a frame."""
    prices = {"input": 1.0, "output": 10.0, "as_of": datetime.date(2026, 11, 1)}
    record = get_model("gemini-2.5-pro").model_dump() | {"prices": prices, "tokens_per_frame": 100} | changes
    return ModelEntry.model_validate(record, context={"accounts": {"gemini": None}})


def test_without_experience_the_registrys_estimates_stand() -> None:
    seen = forecast(model(expected_completion_tokens=1000), 240, Experience())
    # 25 frames x 100 and 1,500 bytes at 4 a token: 2,875 in; low takes 0.4 of 1,000 out, high 8,000
    assert (seen.prompt_tokens, seen.completion_tokens) == (240 * 2875, 240 * 1000)
    assert seen.dollars is not None
    low, expected, high = (dollars / 240 for dollars in seen.dollars)
    assert low == pytest.approx((2875 + 4000) / 1e6)
    assert expected == pytest.approx((2875 + 10_000) / 1e6)
    assert high == pytest.approx((2500 + 1500 + 200 + 80_000) / 1e6)
    assert seen.minutes == pytest.approx(240 * (4 + 1000 / 60) / 24 / 60)  # at 60 tokens a second after 4 s


def test_experience_comes_before_estimates() -> None:
    rows = [
        {"outcome": "answer", "prompt_tokens": 1000, "completion_tokens": 100, "latency_s": 2.0},
        {"outcome": "empty", "prompt_tokens": 3000, "completion_tokens": 300, "latency_s": 4.0},
        {"outcome": "answer", "prompt_tokens": None, "completion_tokens": None, "latency_s": 6.0},
        {"outcome": "error", "prompt_tokens": None, "completion_tokens": None, "latency_s": 600.0},
    ]
    one, other = Totals(), Totals()
    for row in rows[:2]:
        one.add(row)
    for row in rows[2:]:
        other.add(row)
    known = experience([one, other])
    assert known == Experience(2000, 200, 4.0)
    seen = forecast(model(), 60, known)
    assert (seen.prompt_tokens, seen.completion_tokens) == (60 * 2000, 60 * 200)
    assert seen.minutes == pytest.approx(60 * 4 / 24 / 60)


def test_calls_take_no_less_than_one_of_them_and_as_long_as_an_entry_says() -> None:
    assert forecast(model(), 1, Experience(latency_s=90.0)).minutes == pytest.approx(1.5)
    assert forecast(model(expected_latency_s=30.0), 48, Experience()).minutes == pytest.approx(1.0)  # two waves of 24
    assert forecast(model(), 0, Experience()).minutes == 0


def test_calls_take_what_the_live_check_measured_until_the_ledger_knows_better(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    here = Account(base_url="http://127.0.0.1:9/v1")
    monkeypatch.setattr(forecasts, "load_accounts", lambda: {"gemini": here})
    forecasts.remember_latencies(model(), here.base_url, [10.0, 20.0])  # sent at once
    seen = forecast(model(), 48, Experience())
    assert seen.minutes == pytest.approx(2 * 15 / 60)  # two waves of 24 calls of 15 s
    assert seen.queued_minutes == pytest.approx(48 * 10 / 60)  # the answers came 10 s apart
    known = forecast(model(), 48, Experience(latency_s=30.0))
    assert (known.minutes, known.queued_minutes) == (pytest.approx(1.0), 0.0)
    monkeypatch.setattr(forecasts, "load_accounts", lambda: {"gemini": here.model_copy(update={"base_url": None})})
    assert forecast(model(), 48, Experience()).minutes != seen.minutes  # of that name at another address


def test_participants_of_an_account_share_its_pace(monkeypatch: pytest.MonkeyPatch) -> None:
    slow = {"gemini": Account(requests_per_minute=10)}
    monkeypatch.setattr(forecasts, "load_accounts", lambda: slow)
    rows = [forecast(model(), calls, Experience(latency_s=1.0)) for calls in (50, 30)]
    assert [row.minutes for row in rows] == [pytest.approx(5), pytest.approx(3)]
    assert forecasts.minutes_of(rows) == pytest.approx(8)
    assert forecasts.minutes_of([]) == 0


def test_an_unknown_price_stays_unknown() -> None:
    assert forecast(model(prices=None), 10, Experience()).dollars is None


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
    assert entry.prices is not None and clip_tokens(entry)[0] == pytest.approx(25 * a_frame)
    planned = forecast(entry, 1, Experience())
    assert planned.dollars is not None and planned.prompt_tokens == pytest.approx(25 * a_frame + 375)
    most = entry.prices.cost(25 * entry.tokens_per_frame + 1500 + 200, 8000)
    assert planned.dollars[2] == pytest.approx(most)


def test_no_count_is_above_the_bound_that_a_budget_reserves() -> None:
    for entry in load_models().values():
        if entry.backend == NETWORK:
            for dataset in ("occlusion", "two_events"):
                expected, most = clip_tokens(entry, dataset)
                assert expected <= most, (entry.id, dataset)


def test_a_wide_clip_of_two_events_is_expected_and_reserved_at_its_own_size() -> None:
    entry = get_model("gpt-5-high")  # 640 pixels are two tiles of 512, 480 are one: 70 + 2 x 140, not 70 + 140
    assert [clip_tokens(entry, name)[0] for name in ("occlusion", "two_events")] == [25 * 210, 25 * 350]
    assert clip_tokens(entry, "two_events")[1] == 25 * math.ceil(entry.tokens_per_frame * 350 / 210)
    gemini = get_model("gemini-2.5-pro")  # a frame of a video is 258 tokens, whatever its size
    assert clip_tokens(gemini, "two_events")[0] == 25 * 258
    half = forecast(entry, 4, Experience(), {"occlusion": 2, "two_events": 2})
    assert half.prompt_tokens == 4 * (25 * (210 + 350) / 2 + 375)
