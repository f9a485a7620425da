"""The human row and scores corrected for the panel's errors: by hand, in another way, and where the truth is known."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from datetime import UTC, datetime
from typing import Any

import numpy as np
import pandas as pd
import pytest
from sklearn.metrics import confusion_matrix

from traps_pipeline.people.corrected_scores import NO_BETTER, corrected, panel_errors, rogan_gladen
from traps_pipeline.people.human_label_rows import HUMAN_LABELS
from traps_pipeline.people.human_scores import human_row
from traps_pipeline.protocol.datasets import DATASETS, taxonomy_of
from traps_pipeline.scoring.bootstrap import RESAMPLED_METRICS, intervals, resample

Rows = Callable[..., pd.DataFrame]


def label(task: str, unit: str, dataset: str, scenario: str, side: str, **own: Any) -> dict[str, Any]:
    given = {"annotator": "jd", "stratum": f"{dataset} {side}", "stratum_size": 1, "seconds": 8.0}
    about = {"task": task, "unit": unit, "dataset": dataset, "scenario_id": scenario, "side": side}
    return {"item_id": f"{dataset}:{scenario}:{side}", "benchmark_version": "v1", **given, **about, **own}


def frame(rows: Sequence[dict[str, Any]]) -> pd.DataFrame:
    made = pd.DataFrame(rows).assign(created_at=datetime(2026, 11, 22, tzinfo=UTC))
    return made.reindex(columns=pd.Index(HUMAN_LABELS.names)).astype(object)


def clips(dataset: str) -> list[dict[str, Any]]:
    """Ten controls, of which two split the judges; four voids. What was chosen is labelled more densely."""
    labels = []
    for k, (split, correct, abstained) in enumerate([("", True, False), ("", False, True), (", split", True, False)]):
        stratum = {"stratum": f"{dataset} control{split}", "stratum_size": 2 if split else 8}
        own = stratum | {"correct": correct, "abstained": abstained, "seconds": 4.0 + k}
        labels.append(label("answerability", f"c{k}{dataset}", dataset, f"s-{k}", "control", **own))
    for k, abstained in enumerate([True, True, True, False]):
        own = {"abstained": abstained, "stratum_size": 4, "seconds": 9.0}
        labels.append(label("answerability", f"v{k}{dataset}", dataset, f"s-{k + 3}", "void", **own))
    return labels


def test_the_human_row_counts_each_stratum_as_the_study_has_it() -> None:
    labels = [row for dataset in DATASETS for row in clips(dataset)]
    twice = [row | {"annotator": "ab", "abstained": k != 1} for k, row in enumerate(labels[3:5])]
    table = human_row(frame([*labels, *twice]), resamples=300).set_index("dataset")
    assert list(table.index) == [*DATASETS, "overall"]
    row = table.loc["chaotic"]
    # Eight controls as the first two, of which one is right; two as the third, which is right. Three of four voids.
    assert (row["acc"], row["false_abs"], row["abs_rec"]) == pytest.approx((0.6, 0.4, 0.75))
    assert row["pecs"] == pytest.approx(0.6 * 0.35)
    assert (row["n_people"], row["n_clips"], row["n_labels"], row["seconds"]) == (1, 7, 7, 9.0)
    assert 0 <= row["pecs_ci_low"] < row["pecs"] < row["pecs_ci_high"] <= 1
    # Both people labelled two voids, and agree about one of them.
    assert (table.loc["occlusion", "agreement"], table.loc["overall", "n_people"]) == (0.5, 2)
    assert human_row(frame(labels[:7])).set_index("dataset").index.tolist() == ["occlusion", "overall"]
    assert np.isnan(human_row(frame(labels[:7])).set_index("dataset").loc["overall", "pecs"])
    assert human_row(pd.DataFrame(columns=pd.Index(HUMAN_LABELS.names))).empty


# --- correction -------------------------------------------------------------------------------------------------------


def judged_study(
    rows: Rows, scenarios: int, seed: int, sensitivity: float = 0.85, specificity: float = 0.9
) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Verdicts of a panel with these errors about answers whose truth is known, and that truth as `right` and `shy`:
    Acc 0.7, FalseAbs 0.1, AbsRec 0.6."""
    rng = np.random.default_rng(seed)

    def drawn(share: float) -> tuple[np.ndarray, np.ndarray]:
        truth = rng.random(scenarios) < share
        return truth, rng.random(scenarios) < np.where(truth, sensitivity, 1 - specificity)

    parts, truths = [], []
    for dataset in DATASETS:
        right, shy, void = drawn(0.7), drawn(0.1), drawn(0.6)
        parts.append(rows([tuple(map(bool, each)) for each in zip(right[1], shy[1], void[1], strict=True)], dataset))
        both = np.stack([shy[0], void[0]], axis=1).ravel()
        truths.append(pd.DataFrame({"shy": both, "right": np.repeat(right[0], 2)}))
    return pd.concat(parts, ignore_index=True), pd.concat(truths, ignore_index=True)


def labels_of(verdicts: pd.DataFrame, truth: pd.DataFrame, every: int = 1) -> pd.DataFrame:
    """Labels of every k-th answer of each stratum (side, or what the panel decided): the truth."""
    labels = []
    for task, decision, known in (("abstention", "abstained", "shy"), ("correctness", "correct", "right")):
        about = verdicts.assign(truth=truth[known]).loc[verdicts[decision].notna()]
        about["stratum"] = about["side"] + about[decision].astype(str)
        for stratum, group in about.groupby("stratum"):
            for row in group.iloc[::every].to_dict("records"):
                own = {"stratum": stratum, "stratum_size": len(group), "panel": row[decision], decision: row["truth"]}
                labels.append(
                    label(task, f"{task}{row['item_id']}", row["dataset"], row["scenario_id"], row["side"], **own)
                )
    return frame(labels)


def test_the_formula_solves_for_the_true_share() -> None:
    truth = np.array([0.0, 0.25, 1.0])
    judged = 0.8 * truth + (1 - 0.9) * (1 - truth)
    assert rogan_gladen(judged, np.full(3, 0.8), np.full(3, 0.9)) == pytest.approx(truth)
    assert rogan_gladen(np.array([0.02, 0.99]), np.full(2, 0.8), np.full(2, 0.9)).tolist() == [0.0, 1.0]
    assert np.isnan(rogan_gladen(np.array([0.5]), np.array([0.4]), np.array([0.6]))).all()


def test_judged_and_corrected_equal_another_implementation(rows: Rows) -> None:
    """Scikit-learn's weighted confusion matrix, and a system of
    linear equations for each share."""
    verdicts, truth = judged_study(rows, 25, seed=5)
    labels, resamples, seed = labels_of(verdicts, truth, every=2), 20, 11
    table = corrected(labels, verdicts, resamples, seed).set_index("dataset").loc["overall"]
    items = verdicts.assign(taxonomy=verdicts["dataset"].map(taxonomy_of))
    labels = labels.assign(
        weight=labels["stratum_size"].astype(float) / labels.groupby(["task", "stratum"])["unit"].transform("count")
    )

    def metrics(times: dict[str, float]) -> dict[str, float]:
        def inverse(task: str, share: float) -> float:
            own = labels.loc[labels["task"] == task]
            truth_of = own["abstained" if task == "abstention" else "correct"].astype(bool)
            weight = own["weight"] * own["scenario_id"].map(times)
            counts = confusion_matrix(truth_of, own["panel"].astype(bool), sample_weight=weight, normalize="true")
            no, yes = np.linalg.solve(counts.T, [1 - share, share])
            assert no + yes == pytest.approx(1)
            return float(min(1.0, max(0.0, yes)))

        by_dataset = []
        for dataset in DATASETS:
            own = items.loc[items["dataset"] == dataset]
            repeated = own.loc[own.index.repeat(own["scenario_id"].map(times).astype(int))]
            control = repeated.loc[repeated["side"] == "control"]
            acc = inverse("correctness", control["correct"].astype(float).mean())
            false_abs = inverse("abstention", control["abstained"].astype(float).mean())
            void = repeated.loc[repeated["side"] == "void", "abstained"].astype(float).mean()
            abs_rec = inverse("abstention", void)
            j = abs_rec - false_abs
            by_dataset.append((acc, abs_rec, false_abs, j, acc * max(0.0, j)))
        return dict(zip(("acc", "abs_rec", "false_abs", "j", "pecs"), np.mean(by_dataset, axis=0), strict=True))

    observed = metrics(dict.fromkeys(items["scenario_id"], 1))
    for name in RESAMPLED_METRICS:
        assert table[f"{name}_corrected"] == pytest.approx(observed[name], abs=1e-9)
        low, high = table[f"{name}_corrected_ci_low"], table[f"{name}_corrected_ci_high"]
        assert low <= observed[name] <= high and low < high


def test_corrected_intervals_hold_the_truth_that_judged_ones_miss_and_judged_ones_are_the_leaderboards(
    rows: Rows,
) -> None:
    verdicts, truth = judged_study(rows, 120, seed=8)
    labels = labels_of(verdicts, truth, every=3)
    table = corrected(labels, verdicts, resamples=400)
    row = table.set_index("dataset").loc["overall"]
    known = {"acc": 0.7, "abs_rec": 0.6, "false_abs": 0.1, "j": 0.5, "pecs": 0.35}
    for name, value in known.items():
        assert row[f"{name}_corrected_ci_low"] < value < row[f"{name}_corrected_ci_high"]
    missed = {name for name in known if not row[f"{name}_ci_low"] < known[name] < row[f"{name}_ci_high"]}
    assert missed >= {"abs_rec", "j", "pecs"}
    own = intervals(resample(verdicts, resamples=400)).set_index("dataset").loc["overall"]
    ends = [name for name in own.index if "_ci_" in name]
    assert [row[name] for name in ends] == pytest.approx([own[name] for name in ends], abs=1e-6)
    errors = panel_errors(labels, verdicts, resamples=400).set_index("task")
    for task in ("abstention", "correctness"):
        found = errors.loc[task]
        assert found["sensitivity_ci_low"] < 0.85 < found["sensitivity_ci_high"]
        assert found["specificity_ci_low"] < 0.9 < found["specificity_ci_high"]


def test_what_cannot_be_corrected_is_null_with_its_reason(rows: Rows) -> None:
    verdicts, truth = judged_study(rows, 20, seed=2)
    nobody = pd.DataFrame(columns=pd.Index(HUMAN_LABELS.names))
    assert corrected(nobody, verdicts).empty and panel_errors(nobody, verdicts).empty
    half = labels_of(verdicts, truth)
    half = half.loc[half["task"] == "abstention"]
    assert corrected(half, verdicts, resamples=20).empty  # PECS needs both tasks
    assert list(panel_errors(half, verdicts, resamples=20)["task"]) == ["abstention"]
    turned = labels_of(verdicts, ~truth)
    assert set(panel_errors(turned, verdicts, resamples=20)["undefined"]) == {NO_BETTER}
    assert corrected(turned, verdicts, resamples=20)["pecs_corrected"].isna().all()
    never = labels_of(verdicts, truth.assign(shy=False))
    none = panel_errors(never, verdicts, resamples=20).set_index("task").loc["abstention"]
    always = panel_errors(labels_of(verdicts, truth.assign(shy=True)), verdicts, resamples=20)
    found = always.set_index("task").loc["abstention"]
    assert (none["n_yes"], found["n_yes"], found["panel"]) == (0, found["n_answers"], verdicts["panel"].iloc[0])
    assert len({None, NO_BETTER, none["undefined"], found["undefined"]}) == 4  # each has a reason of its own
    tied = pd.concat([half.head(1), half.head(1).assign(annotator="ab", abstained=not half.iloc[0]["abstained"])])
    (row,) = panel_errors(pd.concat([half.iloc[1:], tied]), verdicts, resamples=20).to_dict("records")
    assert (row["n_tied"], row["n_answers"], row["n_people"]) == (1, len(half) - 1, 2)
