"""Test how abstention changes as one property of the pairs changes step by step.

See docs/hypotheses.md. Each hypothesis has doses; the first is the reference for the others, on the scenarios that both
have. Beside every metric of a model stands the score of shortcut rules, which read one cue and understand nothing, and
the score of a guess.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any, Literal, cast

import numpy as np
import pandas as pd

from traps_pipeline.protocol.datasets import datasets_of_category
from traps_pipeline.scoring.bootstrap import (
    RESAMPLED_METRICS,
    RESAMPLES,
    SEED,
    Resampling,
    difference,
    draw_scenarios,
    limits_of,
    metrics_of,
    run_sums,
    shares_of,
    with_interval,
)
from traps_pipeline.scoring.metrics import COUNTS, decision_counts, joined_epochs, joined_versions
from traps_pipeline.scoring.score_rows import HYPOTHESES as TABLE

VISUAL = ("occlusion", "chaotic")
RULES = ("occluder-rule", "length-rule", "wording-rule")  # each abstains by a single cue
SHARES = ("acc", "false_abs", "abs_rec", "j")
_SUMS = (*COUNTS, *(f"{name}_unseen" for name in COUNTS[::2]))  # columns of `with_unseen`
_CHANGE = (-2.0, 2.0)  # the limits of a change of J
_ITEM_COLUMNS = [
    "model",
    "regime",
    "dataset",
    "run",
    "item_id",
    "scenario_id",
    "side",
    "epoch",
    "panel",
    "benchmark_version",
]


@dataclass(frozen=True)
class Dose:
    """One step of a hypothesis: a setting of a scene whose effect is measured.

    datasets: where it is asked. side: None for both. counts_as: the sides that its items count as.
    """

    name: str
    datasets: tuple[str, ...]
    side: str | None = None
    counts_as: str = "control and void"


@dataclass(frozen=True)
class Hypothesis:
    """A hypothesis on J or the share of abstentions; its first dose is the reference."""

    name: str
    metric: Literal["j", "abstains"]
    doses: tuple[Dose, ...]


def _void(name: str, dataset: str) -> Dose:
    return Dose(name, (dataset,), "void", "void")


def _no_void(name: str, dataset: str) -> Dose:
    return Dose(name, (dataset,), "control", "no void: the outcome shows through")


HYPOTHESES = (
    Hypothesis(
        "answer space",
        "j",
        (Dose("2 answers", ("labels_two",)), Dose("3 answers", ("labels_three",)), Dose("6 answers", ("labels_six",))),
    ),
    Hypothesis(
        "occluder",
        "abstains",
        (
            _void("as in the pairs", "occlusion"),
            _void("grey", "occluder_grey"),
            _void("magenta", "occluder_magenta"),
            _void("large", "occluder_large"),
            _no_void("alpha 0.5", "occluder_alpha_50"),
        ),
    ),
    Hypothesis(
        "schema",
        "j",
        (
            Dose("as in the pairs", VISUAL),
            Dose("final_answer", ("schema_answer",)),
            Dose("reason, final_answer", ("schema_reason",)),
            Dose("reason, abstain, final_answer", ("schema_abstain",)),
        ),
    ),
    Hypothesis(
        "frames",
        "j",
        (
            Dose("as in the pairs", VISUAL),
            Dose("0.1 s later", ("frames_later",)),
            Dose("2 a second", ("frames_few",)),
            Dose("10 a second", ("frames_all",)),
        ),
    ),
    Hypothesis(
        "cut",
        "abstains",
        (
            Dose("whole clip", ("chaotic",), "control", "control"),
            Dose("predictable cut", ("predictable_cut",), "control", "control"),
            _void("the void's cut", "chaotic"),
        ),
    ),
)
DATASETS_READ = tuple(dict.fromkeys(name for one in HYPOTHESES for dose in one.doses for name in dose.datasets))


def hypotheses(
    verdicts: pd.DataFrame, offered: Mapping[str, int], resamples: int = RESAMPLES, seed: int = SEED
) -> pd.DataFrame:
    """Return HYPOTHESES rows from the VERDICTS rows of DATASETS_READ.

    There is one row per model, regime, hypothesis and dose, if a dose other than the reference was run. offered: the
    number of answers to choose from in each item's question, by item id. Metrics are computed per run, then averaged;
    their intervals resample scenarios, each with all its doses.
    """
    items = pd.concat([verdicts[_ITEM_COLUMNS], decision_counts(verdicts)], axis=1)
    items["taxonomy"] = [datasets_of_category(category)[0] for category in verdicts["category"]]
    items["offered"] = [offered[id_] for id_ in items["item_id"]]
    resampling = draw_scenarios(items, resamples, seed)
    rows: list[dict[str, Any]] = []
    for (model, regime), group in cast(Any, items.groupby(["model", "regime"], sort=True)):
        datasets = {*group["dataset"]}
        for hypothesis in [one for one in HYPOTHESES if any(datasets & {*dose.datasets} for dose in _variations(one))]:
            dose_items = [(dose, _items_of(group, dose)) for dose in hypothesis.doses]
            with_items = [(dose, its) for dose, its in dose_items if len(its)]
            if {dose for dose, _ in with_items} & _variations(hypothesis):
                reference = dose_items[0][1]
                dose_rows = [_row(hypothesis, dose, its, reference, resampling) for dose, its in with_items]
                rows += [{"model": model, "regime": regime, "hypothesis": hypothesis.name, **row} for row in dose_rows]
    return _with_rule_scores(pd.DataFrame(rows, columns=pd.Index(TABLE.names)))


def _variations(hypothesis: Hypothesis) -> set[Dose]:
    """Return the doses other than the reference and the sides of the pairs, which every study has."""
    return {dose for dose in hypothesis.doses[1:] if not {*dose.datasets} <= {*VISUAL}}


def _items_of(group: pd.DataFrame, dose: Dose) -> pd.DataFrame:
    is_in_dose = group["dataset"].isin(dose.datasets)
    return group.loc[is_in_dose if dose.side is None else is_in_dose & (group["side"] == dose.side)]


def _row(
    hypothesis: Hypothesis, dose: Dose, items: pd.DataFrame, reference: pd.DataFrame, resampling: Resampling
) -> dict[str, Any]:
    """Return the columns of a dose's row, except those of rules."""
    model, regime = (items[name].iloc[0] for name in ("model", "regime"))
    row_name = f"{model}|{regime}|{hypothesis.name}"
    metrics = _metrics(items, resampling, f"{row_name}|{dose.name}")
    control = items["side"].eq("control").to_numpy()
    is_decided = np.where(control, items["correct_of"] & items["false_abs_of"], items["abs_rec_of"])
    row: dict[str, Any] = {
        "dose": dose.name,
        "counts_as": dose.counts_as,
        "n_runs": items["run"].nunique(),
        "n_scenarios": items["scenario_id"].nunique(),
        "n_items": items["item_id"].nunique(),
        "n_missing": int(len(items) - is_decided.sum()),
        "compared": hypothesis.metric,
        "chance": float((1 / items.loc[control, "offered"]).mean()) if control.any() else None,
        "panel": joined_epochs(items["panel"]),
        "epoch": joined_epochs(items["epoch"]),
        "benchmark_version": joined_versions(items["benchmark_version"]),
        "refused": None,
        "n_compared": None,
        "at_reference": None,
        **dict.fromkeys(_ends("change")),
    }
    for name in SHARES:
        row |= with_interval(name, metrics[:, RESAMPLED_METRICS.index(name)], limits_of(name))
    row["value"] = _compared_metric(hypothesis, metrics)[1, 0]
    if dose is hypothesis.doses[0] or reference.empty:
        return row
    shared_items = reference.loc[reference["scenario_id"].isin(items["scenario_id"])]
    own_items = items.loc[items["scenario_id"].isin(shared_items["scenario_id"])]
    if shared_items.empty:
        return row
    row["refused"] = _refusal(own_items, shared_items)
    if row["refused"] is None:
        names = (hypothesis.doses[0].name, dose.name)
        end_before, end_after = (
            _compared_metric(hypothesis, _metrics(rows, resampling, f"{row_name}|{name}"))
            for rows, name in zip((shared_items, own_items), names, strict=True)
        )
        row |= {"n_compared": own_items["scenario_id"].nunique(), "at_reference": end_before[1, 0]}
        row |= with_interval("change", difference(end_after, end_before), _CHANGE)
    return row


def _metrics(items: pd.DataFrame, resampling: Resampling, named: str) -> np.ndarray:
    """Return ends of RESAMPLED_METRICS and of abstentions, (2, RESAMPLED_METRICS + 1, draws).

    They are computed over all items of a run, then averaged over runs.
    """
    sums = run_sums(items.assign(dataset="all"), resampling, named)
    run_metrics = []
    for sums_of_run in sums.values():
        rows = dict(zip(_SUMS, sums_of_run, strict=True))
        abstention_sums = [rows[f"false_abs{kind}"] + rows[f"abs_rec{kind}"] for kind in ("", "_of", "_unseen")]
        run_metrics.append(np.concatenate([metrics_of(sums_of_run), shares_of(np.stack(abstention_sums))], axis=1))
    return np.mean(run_metrics, axis=0)


def _compared_metric(hypothesis: Hypothesis, metrics: np.ndarray) -> np.ndarray:
    return metrics[:, -1] if hypothesis.metric == "abstains" else metrics[:, RESAMPLED_METRICS.index("j")]


def _ends(name: str) -> list[str]:
    return [name, f"{name}_ci_low", f"{name}_ci_high"]


def _refusal(dose: pd.DataFrame, reference: pd.DataFrame) -> str | None:
    """Return why a dose and its reference are not comparable: epoch, panel or runs."""
    for word, column in (("epoch", "epoch"), ("panel", "panel")):
        dose_epochs, reference_epochs = (joined_epochs(items[column]) for items in (dose, reference))
        if dose_epochs != reference_epochs or "+" in dose_epochs:
            return f"the dose is of {word} {dose_epochs}, its reference of {word} {reference_epochs}"
    runs = [sorted(set(items["run"])) for items in (dose, reference)]
    return None if runs[0] == runs[1] else f"the dose has runs {runs[0]}, its reference has runs {runs[1]}"


def _with_rule_scores(rows: pd.DataFrame) -> pd.DataFrame:
    """Return rows beside the shortcut rules' highest value and largest change.

    Each comes with its rule's name, for the same hypothesis and dose. A rule does not read the regime, so rows of
    another regime serve if there are none.
    """
    of_rules = rows.loc[rows["model"].isin(RULES)].to_dict("records")
    remarks = []
    for row in rows.to_dict("records"):
        rule_scores = [
            rule_row for rule_row in of_rules if all(rule_row[name] == row[name] for name in ("hypothesis", "dose"))
        ]
        rule_rows = {
            rule_row["model"]: rule_row
            for rule_row in sorted(rule_scores, key=lambda rule_row: rule_row["regime"] == row["regime"])
        }
        best, changing = (
            _best(rule_rows.values(), *fields) for fields in (("value", "rule"), ("change", "rule_changing"))
        )
        remarks.append({**best, **changing})
    return rows.assign(**{name: [rule_row[name] for rule_row in remarks] for name in remarks[0]}) if remarks else rows


def _best(rows: Iterable[Mapping[str, Any]], field: str, named: str) -> dict[str, Any]:
    """Return the rule with the highest value, or with the largest absolute change."""
    known_rows = [row for row in rows if row[field] is not None and row[field] == row[field]]
    best = max(known_rows, key=lambda row: abs(row[field]) if field == "change" else row[field], default=None)
    return {named: best and best["model"], f"rule_{field}": best and best[field]}


def wrong_rows(table: pd.DataFrame) -> int:
    """Return the number of HYPOTHESES rows that break their definition; null is not wrong.

    A row is wrong if a share lies outside [0, 1], an interval is out of order, J is not AbsRec minus FalseAbs, or a
    change over all scenarios is not the difference of the two values.
    """
    is_wrong = np.zeros(len(table), bool)
    for name in (*SHARES, "change"):
        metric, low, high = (table[column].to_numpy(float) for column in _ends(name))
        minimum, maximum = _CHANGE if name == "change" else limits_of(name)
        is_wrong |= (metric < minimum) | (metric > maximum) | (low > high) | (low < minimum) | (high > maximum)
    columns = ("j", "abs_rec", "false_abs", "change", "value", "at_reference")
    j, abs_rec, false_abs, change, value, reference_value = (table[name].to_numpy(float) for name in columns)
    are_complete = (table["n_compared"] == table["n_scenarios"]).fillna(False).to_numpy(bool)
    is_wrong |= np.abs(j - (abs_rec - false_abs)) > 1e-12
    is_wrong |= are_complete & (np.abs(change - (value - reference_value)) > 1e-12)
    return int(is_wrong.sum())
