"""Verdict rows made by hand: one call per cell, one pair per scenario."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import pandas as pd
import pytest

from traps_pipeline.judging.judging_rows import VERDICTS

Flag = bool | None
Pair = tuple[Flag, Flag, Flag]  # correct on control, abstained on control, abstained on void


def verdict_rows(
    pairs: Sequence[Pair],
    dataset: str = "occlusion",
    model: str = "m",
    regime: str = "standard",
    run: int = 1,
    epoch: str = "e1",
    labels: Sequence[str] = ("yes",),
    categories: Sequence[str] = ("hidden",),
    outcomes: Sequence[str] = ("answer",),
    panel: str = "three@1",
) -> pd.DataFrame:
    """VERDICTS rows of one cell. Labels, categories and (per item) outcomes are repeated cyclically."""
    rows = []
    for k, (correct, control_abstained, void_abstained) in enumerate(pairs):
        sides = (("control", correct, control_abstained), ("void", None, void_abstained))
        for side, is_correct, abstained in sides:
            known = abstained is not None and (side == "void" or is_correct is not None)
            rows.append(
                {
                    "item_id": f"{dataset}:s{k}:{side}",
                    "pair_id": f"{dataset}:s{k}",
                    "scenario_id": f"{dataset.removesuffix('_ill_posed')}-{k:04d}",
                    "side": side,
                    "category": categories[k % len(categories)],
                    "sub_scenario": categories[k % len(categories)] + "_sub",
                    "control_answer": labels[k % len(labels)],
                    "dataset": dataset,
                    "model": model,
                    "regime": regime,
                    "run": run,
                    "outcome": outcomes[len(rows) % len(outcomes)],
                    "abstained": abstained,
                    "correct": is_correct,
                    "n_valid": 3 if known else 0,
                    "n_valid_correctness": 3 if known and side == "control" else 0,
                    "unanimous": known,
                    "undecided": not known,
                    "panel": panel,
                    "epoch": epoch,
                    "benchmark_version": "v1",
                }
            )
    return pd.DataFrame(rows, columns=pd.Index(VERDICTS.names))


def strategy_pairs(name: str, n: int, seed: int = 0) -> list[Pair]:
    """How the reference strategies (docs/spec.md 5.3) answer n pairs; an abstention is not a correct answer."""
    rng = np.random.default_rng(seed)
    draws = rng.random((n, 2)) < {"random-50": 0.5, "confidence-noise": 0.3}.get(name, 0.0)
    answers: dict[str, Callable[[int], Pair]] = {
        "oracle": lambda k: (True, False, True),
        "always-abstain": lambda k: (False, True, True),
        "never-abstain": lambda k: (k % 2 == 0, False, False),
        "perfect-answerer": lambda k: (True, False, False),
        "inverse-oracle": lambda k: (False, True, False),
        "random-50": lambda k: (not draws[k, 0], bool(draws[k, 0]), bool(draws[k, 1])),
        "confidence-noise": lambda k: (not draws[k, 0], bool(draws[k, 0]), bool(draws[k, 1])),
    }
    return [answers[name](k) for k in range(n)]


@pytest.fixture
def rows() -> Callable[..., pd.DataFrame]:
    """`verdict_rows`."""
    return verdict_rows


@pytest.fixture
def strategy() -> Callable[..., list[Pair]]:
    """`strategy_pairs`."""
    return strategy_pairs
