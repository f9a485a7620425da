"""What is earned by abstaining for reasons of the clip alone or of the question alone (docs/scoring.md, "Beyond PECS").

Two learned classifiers never meet: boosted trees read numbers of a clip (its length, where a board stands and from
when, how much moves and when it rests), a regression reads the words of a question. The numbers come from the records,
so that no picture is drawn: a reader of pixels knows them less well. Where a rule does not abstain it answers like an
oracle, so that each figure bounds what it can earn. `or` and `and` join the two decisions, `sum` adds their evidence;
`joint` is no such rule: one classifier that reads both. Each is fitted on other scenarios, or on other families, than
it is asked about. The first four are the cues of `models.baselines.shortcut_rules`, one line each, with nothing to
fit. All figures are the project's own (`scoring`).
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pandas as pd
from sklearn.ensemble import HistGradientBoostingClassifier
from sklearn.feature_extraction.text import CountVectorizer
from sklearn.linear_model import LogisticRegression
from sklearn.model_selection import GroupKFold

from bench.quick import parse
from bench.shortcuts import first_of_each
from traps_pipeline.base.paths import RELEASED
from traps_pipeline.benchmark.filmed_arms import arm_of
from traps_pipeline.benchmark.records import load_released
from traps_pipeline.models.baselines.shortcut_rules import CUT_FRAMES, has_no_choices
from traps_pipeline.protocol.datasets import CROSSED, DATASETS, INFERENCE_ARMS, TWIN
from traps_pipeline.scenes.picture.camera import Camera, Occluder
from traps_pipeline.scenes.variants.arms import SHOWN_AGAIN_S
from traps_pipeline.scenes.worlds.outcome import Rejected
from traps_pipeline.scenes.worlds.spec import SceneSpec, load_trajectory
from traps_pipeline.scenes.worlds.world import closing_of
from traps_pipeline.scoring.metrics import pecs_of
from traps_pipeline.scoring.robust import robust

BEHIND_M = 1.0  # a decoy's distance behind the board's place, about what arms choose
FOLDS = {"scenario_id": 5, "family": 12}
WORDS = 300  # the commonest words and pairs of words
RULES = ("clip", "text", "or", "and", "sum", "joint")
Decisions = dict[str, np.ndarray]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--per-family", type=int, help="the first so many records of each family; default: all")
    arguments = parse(parser, per_family=3)
    chosen = first_of_each(load_released(), arguments.per_family)
    items = pd.DataFrame([row for spec in chosen for row in rows_of(spec)])
    print(f"{len(items)} items of {len(chosen)} scenarios, {items['family'].nunique()} families")
    for held_out, folds in FOLDS.items():
        print(f"\n{held_out} held out: PECS, robust, conjunction, inference; J of {', '.join((*DATASETS, CROSSED))}")
        for rule, abstains in (one_line(items) | decisions(items, held_out, folds)).items():
            print_figures(rule, items.assign(abstained=abstains))


# --- items ------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Clip:
    """What a clip shows. qpos: (F, nq). board: where one stands in frames start to stop."""

    camera: Camera
    qpos: np.ndarray
    board: Occluder | None = None
    start: int = 0
    stop: int = 0

    def numbers(self) -> dict[str, float]:
        """Return what can be said of the clip in cheap numbers."""
        n = len(self.qpos)
        steps = np.linalg.norm(np.diff(self.qpos, axis=0, prepend=self.qpos[:1]), axis=1)
        covered = np.zeros(n, bool)
        place = np.full(4, -1.0)
        if self.board is not None:
            covered[self.start : self.stop] = True
            corners = self.camera.project(self.board.corners())
            place = np.concatenate([corners.mean(axis=0), np.ptp(corners, axis=0)])
        still = steps < 1e-3
        rest = n - 1 - int(np.flatnonzero(~still).max(initial=0))
        in_view = np.append(steps[~covered], 0.0)
        values = [
            *(n, covered[0], covered[n // 2], covered[-1], covered.mean(), covered.argmax(), *place),
            *(still.mean(), rest, rest / n, still[-1], in_view.sum(), (in_view < 1e-3).mean()),
            *(steps[covered.argmax() - 1] if covered.any() else -1.0, steps.argmax(), steps.argmax() / n),
            *steps[-5:],
            *np.quantile(steps, (0.1, 0.25, 0.5, 0.75, 0.9, 1.0)),
        ]
        return {f"f{i}": float(value) for i, value in enumerate(values)}


def rows_of(spec: SceneSpec) -> Iterator[dict[str, Any]]:
    """Yield the items of a scenario: dataset, side, question and the numbers of the clip (columns f0, f1, ..)."""
    about = {"scenario_id": spec.scenario_id, "family": spec.family, "category": spec.category}
    for dataset, side, question, clip in asked_of(spec):
        yield {**about, "dataset": dataset, "side": side, "question": question, **clip.numbers()}


def asked_of(spec: SceneSpec) -> Iterator[tuple[str, str, str, Clip]]:
    """Yield the pairs and the arms, as far as records tell which scenarios admit these."""
    trajectory = RELEASED / "trajectories" / f"{spec.scenario_id}.npz"
    camera, closing = Camera.from_record(spec.camera), closing_of(spec)
    shown = Clip(camera, load_trajectory(trajectory, spec.trajectory_sha256))
    n, end = len(shown.qpos), len(shown.qpos) if closing is None else closing.frame
    control = shown if closing is None else replace(shown, board=closing.occluder, start=end, stop=n)
    occluder = spec.void_kind == "occluder"
    board = Occluder.from_record(spec.void["panel"]) if occluder else None
    cut = n if occluder else int(spec.void["cut_frame"])
    void = Clip(camera, shown.qpos[:cut], board, 0, n)
    twin = Clip(camera, load_trajectory(trajectory, spec.twin.trajectory_sha256, "twin"))
    ill_posed = f"{spec.taxonomy}_ill_posed"
    yield spec.taxonomy, "control", spec.question, control
    yield spec.taxonomy, "void", spec.question, void
    yield ill_posed, "control", spec.question, control
    yield ill_posed, "void", spec.ill_posed_question, control
    yield TWIN, "control", spec.question, twin
    settled = round(spec.evidence["commit_s"] * spec.physics["fps"])
    if board is None:
        yield "predictable_cut", "control", spec.question, replace(shown, qpos=shown.qpos[: settled - 1])
        yield "length_matched", "control", spec.question, replace(shown, qpos=shown.qpos[end - cut : end])
    else:
        yield "late_occluder", "control", spec.question, replace(shown, board=board, start=settled - 1, stop=n)
        forward = camera.axes()[2]
        x, y, z = (float(value) for value in np.array(board.centre) + BEHIND_M * forward)
        yield "decoy", "control", spec.question, replace(shown, board=replace(board, centre=(x, y, z)), stop=n)
        fps = spec.physics["fps"]
        until = n - round(SHOWN_AGAIN_S * fps)
        if spec.void["hidden_from_frame"] < until and spec.evidence["commit_s"] * fps <= n - 2:
            yield "removed", "control", spec.question, replace(shown, board=board, stop=until)
    try:
        for asked in arm_of(spec, CROSSED).ask(spec):
            yield CROSSED, asked.side, asked.text, {"control": control, "void": void}[str(asked.clip)]
    except Rejected:
        return


# --- rules ------------------------------------------------------------------------------------------------------------


def one_line(items: pd.DataFrame) -> Decisions:
    """Return whether each cue alone, and any of them, makes a rule abstain on each item."""
    cues = {
        "occluder": items["f1"].to_numpy(float) > 0,  # one stands in the first frame
        "length": items["f0"].to_numpy(float) < CUT_FRAMES,
        "wording": items["question"].map(has_no_choices).to_numpy(bool),
    }
    return cues | {"any": np.logical_or.reduce([*cues.values()])}


def decisions(items: pd.DataFrame, held_out: str, folds: int) -> Decisions:
    """Return whether each rule abstains on each item, fitted on items of other groups (`held_out`).

    None is fitted on arms that ask for inference.
    """
    inferred = items["dataset"].isin(INFERENCE_ARMS).to_numpy()
    void, crossed = (items["side"] == "void").to_numpy(), (items["dataset"] == CROSSED).to_numpy()
    ill_posed = void & items["dataset"].str.endswith("_ill_posed").to_numpy()
    clip, groups = items.filter(regex=r"^f\d+$").to_numpy(float), items[held_out].to_numpy()
    words = CountVectorizer(ngram_range=(1, 2), binary=True, max_features=WORDS)
    text = words.fit_transform(items["question"]).toarray().astype(float)
    abstains = {rule: np.zeros(len(items), bool) for rule in RULES}
    for train, test in GroupKFold(min(folds, len(set(groups)))).split(clip, groups=groups):
        train = train[~inferred[train]]
        # Crossed items contradict either classifier alone; each learns its own reason to abstain.
        of_clip, of_text = train[~(ill_posed | crossed)[train]], train[~((void & ~ill_posed) | crossed)[train]]
        by_clip = trees(clip[of_clip], void[of_clip]).predict(clip[test])
        by_text = words_alone(text[of_text], void[of_text]).predict(text[test])
        abstains["clip"][test], abstains["text"][test] = by_clip, by_text
        abstains["or"][test], abstains["and"][test] = by_clip | by_text, by_clip & by_text
        abstains["sum"][test] = summed(clip, text, void, groups, train, test)
        both = np.hstack([clip, text])
        abstains["joint"][test] = trees(both[train], void[train]).predict(both[test])
    return abstains


def trees(features: np.ndarray, void: np.ndarray) -> HistGradientBoostingClassifier:
    return HistGradientBoostingClassifier(max_iter=60, learning_rate=0.2, random_state=0).fit(features, void)


def words_alone(features: np.ndarray, void: np.ndarray) -> LogisticRegression:
    return LogisticRegression(C=10, max_iter=300).fit(features, void)


def summed(
    clip: np.ndarray, text: np.ndarray, void: np.ndarray, groups: np.ndarray, train: np.ndarray, test: np.ndarray
) -> np.ndarray:
    """Return decisions by a weighted sum of the evidence of the clip and of the question, each fitted alone to all."""
    readers = ((trees, clip), (words_alone, text))
    evidence = np.zeros((len(train), 2))
    for fit, held in GroupKFold(2).split(train, groups=groups[train]):
        for k, (fitted, seen) in enumerate(readers):
            evidence[held, k] = fitted(seen[train[fit]], void[train[fit]]).decision_function(seen[train[held]])
    of_test = [fitted(seen[train], void[train]).decision_function(seen[test]) for fitted, seen in readers]
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
    shares = items.pivot_table(values="abstained", index="dataset", columns="side", aggfunc="mean")
    control, j = shares["control"], shares["void"] - shares["control"]
    pecs = pecs_of((1 - control).to_numpy(float), j.to_numpy(float))[j.index.isin(DATASETS)].mean()
    figures = " ".join(f"{value:6.3f}" for value in (pecs, row["robust"], row["conjunction"], row["inference_acc"]))
    print(f"  {rule:7} {figures}  ", *(f"{j[dataset]:5.2f}" for dataset in (*DATASETS, CROSSED)))


if __name__ == "__main__":
    main()
