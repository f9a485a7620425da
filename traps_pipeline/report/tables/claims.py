"""State what a study claims of a model, and in which of the model's controls the same holds."""

from __future__ import annotations

import csv
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from traps_pipeline.base.paths import ASSETS
from traps_pipeline.mechanism.control_rows import LOGITS, MODEL, RESIDUAL, STATES
from traps_pipeline.mechanism.effects import two_sided_effects
from traps_pipeline.mechanism.probes import auroc
from traps_pipeline.mechanism.transfer_paths import LOOK_ALIKES
from traps_pipeline.protocol.datasets import DATASETS, is_ill_posed
from traps_pipeline.protocol.regimes import GUIDED, RANDOM_WEIGHTS, STANDARD
from traps_pipeline.report.numbers import NONE
from traps_pipeline.report.result_frames import Results
from traps_pipeline.report.tables.control_reports import OTHER_GATES, leads, prompts
from traps_pipeline.report.tables.inside_columns import why_not
from traps_pipeline.report.tables.interaction_table import interaction_table
from traps_pipeline.report.tables.table_columns import MODEL as MODEL_COLUMN
from traps_pipeline.report.writing import Column, PrintedTable, fraction

if TYPE_CHECKING:
    import pandas as pd

PLACEBO, RIVAL, NO_GAP = "placebo", "rival", "no_gap"
RANDOM = (*RANDOM_WEIGHTS,)
SUBJECTS = (MODEL, *RANDOM, PLACEBO, RIVAL, NO_GAP)
SUBJECT_NAMES = dict(
    zip(SUBJECTS, ("model", "random 0", "random 1", "placebo", "best rival", "pocket, no gap"), strict=True)
)
NO_GAP_FILE = ASSETS / "pocket" / "no_gap" / "mechanism.csv"  # by `python -m tools.pocket card`
VISUAL = tuple(name for name in DATASETS if not is_ill_posed(name))
TEXTUAL = tuple(name for name in DATASETS if is_ill_posed(name))


class TwoModels(Exception):
    """Raised where a metric would join the states of one model with the answers of another."""


@dataclass(frozen=True)
class Claim:
    """A claim about a model's hidden states: the metric that decides it, and controls in which it must fail.

    metric: what is measured; it holds from `bound` on. of: the metric of a model and subject, None where the study has
    none, NaN where the subject's states do not vary; of RIVAL, in a claim of a lead, what is subtracted. fails_in: the
    controls in which the metric must stay below the bound. n_of: the frame, count columns and targets of its items.
    """

    name: str
    says: str
    metric: str
    bound: float
    of: Callable[[Results, str, str], float | None]
    fails_in: Sequence[str]
    n_of: tuple[str, Sequence[str], Sequence[str]] | None = None

    @property
    def holds_if(self) -> str:
        """The measure and its bound."""
        return f"{self.metric} ≥ {self.bound:g}"

    def n(self, results: Results, model: str) -> float | None:
        """Return of how many items of a model the metric is, over its targets; None if that is not known."""
        if self.n_of is None:
            return None
        frame, columns, targets = self.n_of
        rows = getattr(results, frame)
        rows = rows.loc[rows["model"] == model]
        key = rows[next((name for name in ("target", "dataset") if name in rows), "model")].astype(str)
        is_target = key.isin(targets) if targets else key.notna()
        return rows.loc[is_target, [*columns]].sum(axis=1).groupby(key[is_target]).max().sum() or None


# --- metrics ----------------------------------------------------------------------------------------------------------


def _mean(values: Any) -> float | None:
    """Return the mean of a column, without what is missing; None if nothing is left."""
    known = [float(value) for value in values if value == value and value is not None]
    return float(np.mean(known)) if known else None


def _of_model(rows: pd.DataFrame, model: str) -> pd.DataFrame:
    """Return a model's rows. Raises TwoModels if they join two."""
    rows = rows.loc[rows["model"] == model]
    joined = [*rows["joins"].dropna()] if "joins" in rows else []
    if joined:
        raise TwoModels(str(joined[0]))
    return rows


def subject_leads(results: Results, model: str, subject: str, targets: Sequence[str]) -> list[pd.DataFrame]:
    """Return LEADS rows of a subject, a frame for each target, and for each placebo of one."""
    rows = _of_model(results.leads, model)
    own = rows["subject"].isin((MODEL, *RANDOM))
    rows = rows.loc[~own] if subject == PLACEBO else rows.loc[rows["subject"] == subject]
    rows = rows.loc[rows["target"].isin(targets)]
    return [part for _, part in rows.groupby(["target", "subject"], observed=True, sort=False)]


def _by_features(features: str, rival: Callable[[dict[str, float]], float] | None, targets: Sequence[str]) -> Any:
    """Return the AUROC of a subject's features, less that of its best rival if there is one.

    It is the mean over targets; of a placebo the largest; of RIVAL the mean of what is subtracted in the model.
    """

    def of(results: Results, model: str, subject: str) -> float | None:
        values = []
        for part in subject_leads(results, model, MODEL if subject == RIVAL else subject, targets):
            areas = dict(zip(part["features"], part["auroc"], strict=True))
            subtracted = rival(areas) if rival else 0.0
            values.append(subtracted if subject == RIVAL else areas[features] - subtracted)
        if subject == RIVAL and rival is None:
            return None
        return max(values, default=None) if subject == PLACEBO else _mean(values)

    return of


def _best_rival(areas: dict[str, float]) -> float:
    return max(value for name, value in areas.items() if name not in (STATES, RESIDUAL))


def _output(areas: dict[str, float]) -> float:
    return max(areas.get(name, 0.5) for name in ("output margin", LOGITS))


def _unexpressed(results: Results, model: str, subject: str) -> float | None:
    """Return by how much more voids than controls are answered with states above 0 and a margin below it."""
    rows = _of_model(results.item_scores, model)
    rows = rows.loc[rows["abstained_standard"].notna()]
    if subject != MODEL or not len(rows):
        return None
    hidden = (rows["others"].astype(float) > 0) & (rows["margin"] < 0) & rows["abstained_standard"].eq(False)
    shares = hidden.groupby(rows["side"].astype(str)).mean()
    return float(shares["void"] - shares["control"]) if {"void", "control"} <= {*shares.index} else None


def _sentences(results: Results, model: str, subject: str) -> float | None:
    """Return how much better states order the sides than an abstention against the own answer, in AUROC."""
    rows = _of_model(results.item_scores, model)
    read = _of_model(results.sentences, model)
    if subject not in (MODEL, RIVAL) or not len(read):
        return None
    read = read.loc[read["prompt"] == STANDARD]
    read = read.assign(sentence=read["abstention"].astype(float) - read["own"].astype(float))
    rows = rows.merge(read[["item_id", "sentence"]], on="item_id").dropna(subset=["others", "sentence"])
    areas = []
    for _, part in rows.groupby("dataset", observed=True):
        void = (part["side"] == "void").to_numpy()
        states, sentence = (float(auroc(void, part[name].to_numpy(float))) for name in ("others", "sentence"))
        areas.append(sentence if subject == RIVAL else states - sentence)
    return _mean(areas)


def _transfer(targets: Sequence[str]) -> Callable[[Results, str, str], float | None]:
    def of(results: Results, model: str, subject: str) -> float | None:
        rows = _probes(results, model, subject, "transfer")
        return _mean(rows.loc[rows["target"].isin(targets), "value"])

    return of


def _probes(results: Results, model: str, subject: str, analysis: str) -> pd.DataFrame:
    prompt = {MODEL: STANDARD}.get(subject, subject)
    rows = results.prompted_probes
    rows = rows.loc[(rows["model"] == model) & (rows["prompt"] == prompt) & (rows["analysis"] == analysis)]
    return rows.loc[rows["chosen"].eq(True)]


def _look_alikes(results: Results, model: str, subject: str) -> float | None:
    """Return the AUROC of voids against the look-alike from which they are told worst."""
    rows = _probes(results, model, subject, "answerable_void")
    own = {"occlusion": rows["target"] != "length_matched", "chaotic": rows["target"] == "length_matched"}
    parts = [rows.loc[(rows["source"] == source) & is_own] for source, is_own in own.items()]
    return min((float(value) for part in parts for value in part["value"].dropna()), default=None)


def _gate(results: Results, model: str, subject: str) -> float | None:
    rows = _of_model(results.gate, model)
    rows = rows.loc[(rows["regime"] == STANDARD) & (rows["source"] == "other datasets") & (rows["threshold"] == "mid")]
    pecs = rows.loc[rows["target"] == "all"].set_index("features")["pecs"].astype(float).to_dict()
    own = pecs.get({MODEL: STATES}.get(subject, subject))
    others = max((pecs[name] for name in OTHER_GATES if name in pecs), default=None)
    if subject == RIVAL or own is None or others is None:
        return others if subject == RIVAL else None
    return own - others


def _of_own(metric: Callable[[Results, str], float | None]) -> Callable[[Results, str, str], float | None]:
    """Return a metric that only the model itself has: its controls are nulls, and the model without the gap."""
    return lambda results, model, subject: metric(results, model) if subject == MODEL else None


def _prompt(column: Callable[[pd.DataFrame], Any], joins: bool = True) -> Callable[[Results, str, str], float | None]:
    def of(results: Results, model: str) -> float | None:
        if joins:
            _of_model(results.gate, model)
        rows = prompts(results)
        return _mean(column(rows.loc[rows["model"] == model]))

    return _of_own(of)


def _moved(results: Results, model: str) -> float | None:
    """Return by how much more the guided prompt moves the log-odds of voids than of controls, at the last layer."""
    rows = _of_model(results.lens, model)
    rows = rows.loc[rows["layer"] == rows["layer"].max()]
    apart = (rows["voids"] - rows["controls"]).groupby(rows["prompt"].astype(str)).mean()
    return float(apart[GUIDED] - apart[STANDARD]) if {STANDARD, GUIDED} <= {*apart.index} else None


def _followed(results: Results, model: str) -> float | None:
    """Return by how many more controls abstain at the largest alpha along guided than along standard directions."""
    rows = two_sided_effects(_of_model(results.effects, model))
    rows = rows.loc[(rows["source"] == rows["target"]) & (rows["side"] == "control")]
    rows = rows.loc[rows["alpha"] == rows["alpha"].max()]
    share = rows["abstention"].astype(float).groupby(rows["directions"].astype(str)).mean()
    return float(share[GUIDED] - share[STANDARD]) if {STANDARD, GUIDED} <= {*share.index} else None


def _ahead(results: Results, model: str) -> float | None:
    """Return how much more controls abstain at the largest alpha along guided directions than along any null."""
    rows = _of_model(results.nulls, model)
    rows = rows.loc[(rows["target"] == "all") & (rows["side"] == "control") & (rows["unit"] == "alpha")]
    rows = rows.loc[(rows["dose"] == rows["dose"].max()) & (rows["directions"] == GUIDED)]
    return min((float(value) for value in rows["effect"] - rows["null_highest"]), default=None)


def _differ(results: Results, model: str) -> float | None:
    rows = _of_model(results.patching, model)
    rows = rows.loc[rows["source"] == "pair"]
    return _mean(rows["n_flippable"] / rows["n"])


def _same_direction(results: Results, model: str) -> float | None:
    rows = _of_model(results.cosines, model)
    return _mean(
        rows.loc[(rows["dataset"] == rows["other_dataset"]) & (rows["prompt"] != rows["other_prompt"]), "cosine"]
    )


def _interaction(results: Results, model: str, subject: str) -> float | None:
    """Return the lower of AUROC and share within a clip, at the chosen layer with families held out."""
    rows = results.interaction
    rows = rows.loc[(rows["model"] == model) & (rows["prompt"] == (subject if subject in RANDOM else GUIDED))]
    rows = rows.loc[(rows["held_out"] == "families") & rows["chosen"].eq(True)]
    rows = rows.loc[rows["features"].ne(STATES) if subject == RIVAL else rows["features"].eq(STATES)]
    metrics = rows[["auroc", "within"]].min(axis=1).where(rows["same"].ne(1) | rows["features"].ne(STATES))
    return None if subject == PLACEBO or rows.empty else float(metrics.max())


_GAP = (NO_GAP,)
_SIDES = ("n_voids", "n_controls")
_VISUAL, _TEXTUAL, _ITEMS = ("leads", _SIDES, VISUAL), ("leads", _SIDES, TEXTUAL), ("lens", _SIDES, DATASETS)
CLAIMS = (
    Claim("interaction", "states alone tell whether the asked event is hidden",
          "AUROC, or share of clips if lower,", 0.65, _interaction, (*RANDOM, RIVAL),
          ("interaction", ("n_clips",), ())),
    Claim("lead_visual", "states tell visual voids better than all rivals", "AUROC, states − best rival", 0.1,
          _by_features(STATES, _best_rival, VISUAL), (*RANDOM, PLACEBO), _VISUAL),
    Claim("lead_textual", "states tell ill-posed voids better than all rivals", "AUROC, states − best rival", 0.1,
          _by_features(STATES, _best_rival, TEXTUAL), RANDOM, _TEXTUAL),
    Claim("residual", "states without words, pixels, length tell visual voids", "AUROC of what is left of states",
          0.65, _by_features(RESIDUAL, None, VISUAL), (*RANDOM, PLACEBO), _VISUAL),
    Claim("output", "states tell visual voids better than the output does", "AUROC, states − output", 0.1,
          _by_features(STATES, _output, VISUAL), (*RANDOM, PLACEBO, NO_GAP), _VISUAL),
    Claim("sentence", "states tell voids better than an abstention’s likelihood", "AUROC, states − likelihood", 0.1,
          _sentences, _GAP, _ITEMS),
    Claim("unexpressed", "states tell a void, and the model answers all the same",
          "share of voids − share of controls", 0.3, _unexpressed, _GAP, _ITEMS),
    Claim("transfer_visual", "a probe of other datasets tells visual voids", "AUROC", 0.65, _transfer(VISUAL), RANDOM,
          ("prompted_probes", _SIDES, VISUAL)),
    Claim("transfer_textual", "a probe of other datasets tells ill-posed voids", "AUROC", 0.65, _transfer(TEXTUAL),
          RANDOM, ("prompted_probes", _SIDES, TEXTUAL)),
    Claim("look_alikes", "states tell voids from all answerable look-alikes", "AUROC, the lowest", 0.65, _look_alikes,
          RANDOM, ("prompted_probes", _SIDES, (*LOOK_ALIKES,))),
    Claim("gate", "abstaining by states scores higher than by any rival", "benchmark score (PECS), states − best rival",
          0.05, _gate, (*RANDOM, NO_GAP), ("gate", _SIDES, ("all",))),
    Claim("answers", "the model abstains on voids when told that it may",
          "share of voids abstained on, guided − standard", 0.3,
          _prompt(lambda rows: rows["change"]), _GAP, ("gate", ("n_voids",), ("all",))),
    Claim("lens", "the guided prompt raises abstention on voids alone",
          "log-odds (nats), voids − controls, guided − standard", 1.0,
          _of_own(_moved), _GAP, _ITEMS),
    Claim("prompt", "the prompt changes what the output tells, not states",
          "change of AUROC, output − states", 0.1,
          _prompt(lambda rows: rows["margin_guided"] - rows["margin_standard"]
                  - (rows["probe_guided"] - rows["probe_standard"]).abs(), joins=False), _GAP, _ITEMS),
    Claim("differ", "the output leans to abstention on one side of a pair alone", "share of pairs", 0.5,
          _of_own(_differ), _GAP, ("patching", ("n",), ())),
    Claim("direction", "states tell voids along one direction under both prompts", "cosine, standard and guided", 0.65,
          _of_own(_same_direction), _GAP),
    Claim("followed", "steered along guided states, not standard, it abstains",
          "share of controls abstained on, guided − standard", 0.3, _of_own(_followed), _GAP),
    Claim("ahead", "steering along guided states beats random directions",
          "share of controls abstained on, guided − highest random", 0.1, _of_own(_ahead), (),
          ("nulls", ("n",), ("all",))),
)  # fmt: skip

# --- verdicts ---------------------------------------------------------------------------------------------------------


def claim_frame(results: Results) -> pd.DataFrame:
    """Return a row for each model and claim: its metric `in_` each of SUBJECTS (NaN without one), and a verdict."""
    import pandas as pd

    rows, without_gap = [], no_gap_metrics()
    tables = (results.interaction, results.leads, results.prompted_probes, results.patching)
    for model in dict.fromkeys(str(model) for table in tables for model in table["model"]):
        for claim in CLAIMS:
            values, note = {NO_GAP: without_gap.get(claim.name)}, ""
            for subject in (MODEL, *RANDOM, PLACEBO, RIVAL):
                try:
                    values[subject] = claim.of(results, model, subject)
                except TwoModels as joined:
                    values[subject], note = None, f"two models ({joined})"
            metrics = {f"in_{subject}": value for subject, value in values.items()}
            words = {f"why_{subject}": _absence(claim, subject, value) for subject, value in values.items()}
            row = {"model": model, "claim": claim.name, "n": claim.n(results, model), **metrics, **words}
            rows.append(row | {"verdict": note or verdict(claim, values)})
    fields = (f"{kind}_{subject}" for kind in ("in", "why") for subject in SUBJECTS)
    return pd.DataFrame(rows, columns=pd.Index(["model", "claim", "n", *fields, "verdict"]))


def _absence(claim: Claim, subject: str, value: float | None) -> str:
    """Return why a subject has no metric of a claim, in words for a cell; empty if it has one."""
    if value is None:
        return "not run" if subject == MODEL or subject in claim.fails_in else NONE
    return "" if value == value else "constant"


def verdict(claim: Claim, values: Mapping[str, float | None]) -> str:
    """Return whether a claim is held, and if not, why."""
    known = {name: value for name, value in values.items() if value is not None and value == value}
    own = known.get(MODEL)
    if own is None or own < claim.bound:
        return "not measured" if own is None else "model below bound"
    controls = {name: known[name] for name in claim.fails_in if name in known}
    failing = [SUBJECT_NAMES[name] for name, value in controls.items() if value >= claim.bound]
    if failing:
        return f"holds in {', '.join(failing)} too"
    return "holds" if {*controls} - {RIVAL} or not claim.fails_in else "no control"


def no_gap_metrics() -> dict[str, float]:
    """Return the largest metric of each claim in the pocket model without the gap, over its training seeds."""
    largest: dict[str, float] = {}
    with NO_GAP_FILE.open(encoding="utf-8", newline="") as stream:
        for row in (row for row in csv.DictReader(stream) if row["subject"] == MODEL):
            largest[row["claim"]] = max(float(row["value"]), largest.get(row["claim"], -np.inf))
    return largest


# --- tables -----------------------------------------------------------------------------------------------------------


def claims(results: Results) -> list[PrintedTable]:
    """Return each claim in the model and in its controls, then what states and rivals tell."""
    return [_claims(results), interaction_table(results), leads(results)]


def _claims(results: Results) -> PrintedTable:
    rows = claim_frame(results)
    by_name = {claim.name: claim for claim in CLAIMS}
    rows = rows.assign(
        says=[by_name[name].says for name in rows["claim"]],
        metric=[by_name[name].holds_if for name in rows["claim"]],
        **{f"cell_{name}": claim_cells(rows, name) for name in SUBJECTS},
    ).drop(columns=[f"why_{name}" for name in SUBJECTS])
    columns = [
        MODEL_COLUMN, Column("says", "Claim"), Column("metric", "Holds if"), Column("n", "n", "count"),
        *(Column(f"cell_{name}", SUBJECT_NAMES[name], "range") for name in SUBJECTS), Column("verdict", "Verdict"),
    ]  # fmt: skip
    notes = [
        "a claim holds if its metric reaches the bound in the model and in none of the controls that it must fail in; "
        "others are shown and do not count",
        "random: the same network with random weights, two seeds, under the same prompt; placebo: answerable items in "
        "the place of voids, the largest metric; pocket, no gap: a model that says all that it encodes, the largest "
        "metric of its seeds",
        f"{NONE}: the claim has no such control; constant: its states are one for all items; n: items, of patching "
        "pairs, of two events clips; best rival: what the lead of the model is over",
        "probes are fitted on other datasets; rivals: words, pixels, length, time stamps, the output margin, and a "
        "probe on the logits of the first token",
    ]
    reason = why_not(results, "the paper has no such controls")
    return PrintedTable("claims", "What is claimed, and in which controls it holds too", rows, columns, notes, reason)


def claim_cells(rows: pd.DataFrame, subject: str) -> list[str]:
    """Return a subject's printed metrics, one text a row, or the words that stand in their place."""
    metrics = zip(rows[f"in_{subject}"], rows[f"why_{subject}"], strict=True)
    return [why or fraction(value) for value, why in metrics]
