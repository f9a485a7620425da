"""What local models cost, worked out by hand."""

from __future__ import annotations

import pytest

from traps_pipeline.cli import main
from traps_pipeline.mechanism.cost import CARDS, RANDOM, Card, Cost, Work, cost_of, mechanism_passes, too_large
from traps_pipeline.models.registry.entries import ModelEntry
from traps_pipeline.protocol.datasets import DATASETS
from traps_pipeline.storage.media import MediaSpec
from traps_pipeline.storage.study import MechanismSettings

CARD = Card(operations=1e15, bandwidth=1e12, gigabytes=80)
CACHED_GB = 2 * 2**30 / 1e9  # features of clips


def entry(**other: object) -> ModelEntry:
    params = {"checkpoint": "a/b", "dtype": "bfloat16", "quantisation": "none", "do_sample": False}
    about = {"id": "m", "backend": "local", "device": "cuda", "media": {"profile": "frames", "uniform": 10}}
    size = {"parameters_b": 5.0, "layers": 10, "width": 1000}
    return ModelEntry.model_validate(
        about | {"params": params | {"max_new_tokens": 9}, "tokens_per_frame": 78, "size": size} | other
    )


def test_the_passes_of_the_papers_study_are_counted() -> None:
    settings = MechanismSettings.model_validate(
        {
            "models": {"m": {"steering": 1, "centroid": 1}},
            "patching": {"pairs": 50, "exact": 24},
        }
    )
    scenarios = {"occlusion": 202, "chaotic": 500}
    passes = {work.kind: work.passes for work in mechanism_passes(settings, DATASETS, scenarios)}
    assert passes["states"] == 2 * (4 * 202 + 4 * 500) + 202
    assert passes["sentences"] == 2 * (4 * 202 + 4 * 500)  # one pass an item under each of two regimes
    assert passes["states of random weights"] == 2 * (4 * 202 + 4 * 500 + 202)
    assert RANDOM not in {w.kind for w in mechanism_passes(settings, DATASETS, scenarios, random_weights=False)}
    # Two directions of 100 pairs: 2 records and a gradient (3); 1 + 4 records; 4 sources x (24 + 1) rows of half a pass
    assert passes["patching"] == 2 * 100 * (5 + 5 + 50)
    few = mechanism_passes(settings, ["chaotic"], {"chaotic": 3, "occlusion": 202})[0]
    assert few.passes == 2 * (2 * 3)


def test_hours_and_gigabytes_follow_from_parameters_tokens_and_the_card() -> None:
    media = MediaSpec(profile="frames", uniform=10)
    states = cost_of(entry(), media, Work("states", 720), CARD, quantised=False)
    assert states.tokens_in == 720 * 1000  # 10 frames of 78 tokens, and 220 of text
    assert states.hours == pytest.approx(2 * 5e9 * 720e3 / 0.25e15 / 3600)
    assert states.gigabytes == pytest.approx(10 + CACHED_GB + 28 * 1000 * 1000 * 2 / 1e9)
    answers = cost_of(entry(), media, Work("answers", 640, 100), CARD, quantised=False)
    steps = 640 * 100 / 64 * (0.010 + 10 * 64 * 1000 * 14e-9)  # reading 10 GB takes 10 ms, launching ten blocks 9 ms
    assert answers.hours == pytest.approx((2 * 5e9 * 640e3 / 0.25e15 + steps) / 3600)
    packed = cost_of(entry(), media, Work("patching", 720), CARD, quantised=True)
    assert packed.hours == pytest.approx(1.5 * states.hours)
    assert packed.gigabytes == pytest.approx(0.77 * 5 + CACHED_GB + (4 * 10 + 2 + 22 * 10) * 2e6 / 1e9)


def test_frames_are_those_that_a_clip_of_five_seconds_has() -> None:
    media = MediaSpec(profile="frames", fps=2, most=32)
    assert cost_of(entry(), media, Work("states", 1), CARD, quantised=False).tokens_in == 10 * 78 + 220


def test_without_a_size_tokens_are_known_and_hours_are_not() -> None:
    cost = cost_of(entry(size=None), MediaSpec(profile="frames", uniform=10), Work("states", 5), CARD, quantised=False)
    assert (cost.tokens_in, cost.hours, cost.gigabytes) == (5000, None, None)


def test_what_does_not_fit_a_card_is_told_with_what_would_help() -> None:
    def cost(model: str, kind: str, gigabytes: float | None) -> Cost:
        return Cost(model, kind, 1, 0.0, 0.0, 1.0, gigabytes)

    costs = [cost("a", "patching", 27.3), cost("a", "states", 23.9), cost("b", RANDOM, 30.0), cost("c", "states", None)]
    (patching, random) = too_large([*costs, cost("b", "states", 24.0)], CARDS["RTX4090"], {"a"})
    assert "27.3 GB" in patching and "24" in patching and "patching: null" in patching and "nf4" not in patching
    assert random.startswith("b, states of random weights") and "random_weights: false" in random
    (bf16,) = too_large([cost("b", "states", 25.0)], CARDS["RTX4090"], {"a"})
    assert "nf4" in bf16


def test_a_card_that_is_not_known_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["plan", "demo", "--card", "abacus"]) == 1
    said = capsys.readouterr().err
    assert all(name in said for name in ("--card abacus", *CARDS))
