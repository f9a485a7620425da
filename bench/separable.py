"""What is earned by abstaining for reasons of the clip alone or of the question alone (docs/scoring.md, "Conjunction").

Two learned classifiers never meet: one reads cheap numbers of a clip (length, boards, motion at 5 frames a second of
160 x 120 pixels), the other the words of a question. Where they do not abstain they answer like an oracle, so that each
figure bounds what such a rule can earn. `or` and `and` combine their decisions, `sum` adds their evidence; `joint` is
no such rule: one classifier that reads both. Each is fitted on other scenarios, or on other families, than it is asked
about, and knows all datasets and arms. The figures are the project's own (`scoring`).

Drawing all records takes about 40 minutes of CPU, kept by --features; fitting takes two.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from itertools import pairwise
from multiprocessing import get_context
from pathlib import Path
from typing import Any

os.environ.setdefault("MUJOCO_GL", "osmesa")

import cv2
import numpy as np
import pandas as pd
from sklearn.ensemble import HistGradientBoostingClassifier
from sklearn.feature_extraction.text import CountVectorizer
from sklearn.linear_model import LogisticRegression
from sklearn.model_selection import GroupKFold

from bench.quick import parse
from bench.shortcuts import first_of_each
from traps_pipeline.base.paths import RELEASED
from traps_pipeline.benchmark.filmed_arms import KNOWN
from traps_pipeline.benchmark.records import load_released
from traps_pipeline.protocol.datasets import DATASETS, arms_of
from traps_pipeline.scenes.parts.vision import largest_board
from traps_pipeline.scenes.picture import render
from traps_pipeline.scenes.variants.arms import Question, Scenario
from traps_pipeline.scenes.worlds.outcome import Rejected
from traps_pipeline.scenes.worlds.spec import SceneSpec, load_trajectory
from traps_pipeline.scoring.robust import robust

SIZE = (160, 120)
BOARD_PX = 100  # of a board in one piece: those of voids have 850 and more at this size
STILL = 0.05  # mean change of a pixel, of 255 levels, below which nothing moves
FOLDS = {"scenario_id": 5, "family": 12}
RULES = ("clip", "text", "or", "and", "sum", "joint")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--per-family", type=int, help="the first so many records of each family; default: all")
    parser.add_argument("--features", type=Path, help="Parquet file of drawn items: read if it exists, else written")
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1)
    arguments = parse(parser, per_family=2, workers=1)
    items = items_of(arguments.per_family, arguments.workers, arguments.features)
    print(f"{len(items)} items of {items['scenario_id'].nunique()} scenarios, {items['family'].nunique()} families")
    for held_out, folds in FOLDS.items():
        print(f"\n{held_out} held out: PECS, PECS-R, J of its datasets")
        for rule, abstains in decisions(items, held_out, folds).items():
            print_figures(rule, items.assign(abstained=abstains))


# --- items ------------------------------------------------------------------------------------------------------------


def items_of(per_family: int | None, workers: int, kept: Path | None) -> pd.DataFrame:
    """Return an item a row: its dataset, side and question, and what is measured of its clip (columns f0, f1, ..)."""
    if kept is not None and kept.exists():
        return pd.read_parquet(kept)
    chosen = first_of_each(load_released(), per_family)
    with ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool:
        items = pd.DataFrame([row for rows in pool.map(rows_of, chosen) for row in rows])
    if kept is not None:
        items.to_parquet(kept)
    return items


def rows_of(spec: SceneSpec) -> list[dict[str, Any]]:
    render.SUPERSAMPLE = 1  # a clip is made smaller anyway
    trajectory = RELEASED / "trajectories" / f"{spec.scenario_id}.npz"
    qpos = load_trajectory(trajectory, spec.trajectory_sha256)
    scenario = Scenario.of_record(spec, qpos, load_trajectory(trajectory, spec.twin.trajectory_sha256, "twin"))
    about = {"scenario_id": spec.scenario_id, "family": spec.family, "category": spec.category}
    return [
        {**about, "dataset": dataset, "side": asked.side, "question": asked.text, **numbers}
        for dataset, asked, numbers in asked_of(scenario)
    ]


def asked_of(scenario: Scenario) -> Iterator[tuple[str, Question, dict[str, float]]]:
    spec, open_frames = scenario.spec, scenario.control.open_frames
    closed = scenario.control.behind_panel(range(open_frames, len(scenario.control.qpos)))
    clips = {
        "control": measured([*scenario.control_frames[:open_frames], *closed][scenario.sampled]),
        "void": measured(scenario.void_frames[scenario.sampled]),
        "twin": measured(scenario.twin_frames[scenario.sampled]),
    }
    ill_posed = f"{spec.taxonomy}_ill_posed"
    for dataset in (spec.taxonomy, ill_posed):
        yield dataset, Question("control", spec.question, None), clips["control"]
    yield spec.taxonomy, Question("void", spec.question, None), clips["void"]
    yield ill_posed, Question("void", spec.ill_posed_question, None), clips["control"]
    yield "aside", Question("control", spec.answerable_question.question, None), clips["void"]
    for arm in arms_of(spec.taxonomy):
        try:
            questions, frames = KNOWN[arm].ask(spec), KNOWN[arm].film(scenario).frames
        except Rejected:
            continue
        for asked in questions:
            yield arm, asked, clips[asked.clip] if asked.clip else measured(frames[scenario.sampled])


def measured(frames: Sequence[np.ndarray]) -> dict[str, float]:
    """Return the cheap numbers of a clip; nothing in them depends on the question."""
    small = [cv2.resize(frame, SIZE, interpolation=cv2.INTER_AREA) for frame in frames]
    boards = np.array([board_in(frame) for frame in small])
    steps = np.array([np.abs(a.astype(np.int16) - b).mean() for a, b in pairwise(small)] or [0.0])
    still = steps < STILL
    until_end = len(steps) - (np.flatnonzero(~still)[-1] + 1 if not still.all() else 0)
    last = np.resize(steps[::-1], 5)
    values = [
        *(len(small), *boards[0], *boards[len(boards) // 2], *boards[-1]),
        *((boards[:, 0] > 0).mean(), boards[:, 0].min(), boards[:, 0].max(), boards[:, 2].max(), boards[:, 2].min()),
        *(np.diff(boards[:, 0], prepend=boards[0, 0]).max(), np.diff(boards[:, 0], prepend=boards[0, 0]).argmax()),
        *(steps.sum(), steps.mean(), steps.max(), steps.argmax(), steps.argmax() / len(steps), still.mean()),
        *(until_end, until_end / len(steps), *last, *np.quantile(steps, (0.1, 0.25, 0.5, 0.75, 0.9))),
        *(np.mean(small[0]), np.mean(small[-1]), np.abs(small[-1].astype(np.int16) - small[0]).mean()),
    ]
    return {f"f{i}": float(value) for i, value in enumerate(values)}


def board_in(frame: np.ndarray) -> tuple[float, float, float]:
    """Return area and centre (x, y) of the largest region that looks like a board; 0, -1, -1 where there is none."""
    board = largest_board(frame, BOARD_PX)
    return (0.0, -1.0, -1.0) if board is None else (float(board.area), float(board.x), float(board.y))


# --- rules ------------------------------------------------------------------------------------------------------------


def decisions(items: pd.DataFrame, held_out: str, folds: int) -> dict[str, np.ndarray]:
    """Return whether each rule abstains on each item, fitted on items of other groups (`held_out`)."""
    void = (items["side"] == "void").to_numpy()
    asked_in_vain = void & ~items["dataset"].isin(VISUAL_VOIDS).to_numpy()  # its question is the reason to abstain
    clip = items.filter(regex=r"^f\d+$").to_numpy(float)
    words = CountVectorizer(ngram_range=(1, 2), binary=True, max_features=400).fit_transform(items["question"])
    text = np.asarray(words.todense(), float)
    both = np.hstack([clip, text])
    abstains = {rule: np.zeros(len(items), bool) for rule in RULES}
    groups = items[held_out].to_numpy()
    for train, test in GroupKFold(min(folds, len(set(groups)))).split(clip, groups=groups):
        of_clip = train[~asked_in_vain[train]]
        by_clip = fitted(clip[of_clip], void[of_clip]).predict(clip[test])
        of_text = train[~(void & ~asked_in_vain)[train]]
        by_text = fitted(text[of_text], asked_in_vain[of_text]).predict(text[test])
        abstains["clip"][test], abstains["text"][test] = by_clip, by_text
        abstains["or"][test], abstains["and"][test] = by_clip | by_text, by_clip & by_text
        abstains["sum"][test] = summed(clip, text, void, groups, train, test)
        abstains["joint"][test] = fitted(both[train], void[train]).predict(both[test])
    return abstains


VISUAL_VOIDS = ("occlusion", "chaotic", "frame_out", "held_void")


def fitted(features: np.ndarray, void: np.ndarray) -> HistGradientBoostingClassifier:
    return HistGradientBoostingClassifier(max_iter=150, learning_rate=0.1, random_state=0).fit(features, void)


def summed(
    clip: np.ndarray, text: np.ndarray, void: np.ndarray, groups: np.ndarray, train: np.ndarray, test: np.ndarray
) -> np.ndarray:
    """Return decisions by a weighted sum of the evidence of the clip and of the question, each fitted alone."""
    inner = GroupKFold(3)
    evidence = np.zeros((len(train), 2))
    for fit, held in inner.split(train, groups=groups[train]):
        for k, features in enumerate((clip, text)):
            model = fitted(features[train[fit]], void[train[fit]])
            evidence[held, k] = model.decision_function(features[train[held]])
    of_test = [fitted(x[train], void[train]).decision_function(x[test]) for x in (clip, text)]
    return LogisticRegression().fit(evidence, void[train]).predict(np.stack(of_test, axis=1))


# --- figures ----------------------------------------------------------------------------------------------------------


def print_figures(rule: str, items: pd.DataFrame) -> None:
    verdicts = items.assign(
        **{"model": rule, "regime": "standard", "run": 1, "epoch": "bench", "panel": "bench"},
        item_id=items["dataset"] + ":" + items["scenario_id"] + ":" + items["side"],
        benchmark_version="",
        correct=(~items["abstained"]).where(items["side"] == "control"),
    )
    row = robust(verdicts, resamples=1).iloc[0]
    shares = items.groupby(["dataset", "side"])["abstained"].mean()
    j = [f"{shares.get((d, 'void'), np.nan) - shares.get((d, 'control'), np.nan):5.2f}" for d in DATASETS]
    print(f"  {rule:6} {row['pecs']:6.3f} {row['pecs_r']:6.3f}   {' '.join(j)}")
    print("         abstains:", " ".join(f"{d}/{s[0]} {v:.2f}" for (d, s), v in shares.items() if d not in DATASETS))


if __name__ == "__main__":
    main()
