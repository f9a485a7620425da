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
from traps_pipeline.protocol.datasets import DATASETS, is_ill_posed
from traps_pipeline.protocol.regimes import GUIDED, RANDOM_WEIGHTS, STANDARD
from traps_pipeline.report.result_frames import Results
from traps_pipeline.report.tables.control_reports import prompts
from traps_pipeline.report.tables.inside_columns import short_names, why_not
from traps_pipeline.report.tables.interaction_table import interaction_table
from traps_pipeline.report.tables.table_columns import MODEL as MODEL_COLUMN
from traps_pipeline.report.writing import Column, PrintedTable, fraction

if TYPE_CHECKING:
    import pandas as pd

PLACEBO, NO_GAP = "placebo", "no_gap"
RANDOM = (*RANDOM_WEIGHTS,)
SUBJECTS = (MODEL, *RANDOM, PLACEBO, NO_GAP)
SUBJECT_NAMES = dict(zip(SUBJECTS, ("model", "random 0", "random 1", "placebo", "pocket, no gap"), strict=True))
NO_GAP_FILE = ASSETS / "pocket" / "no_gap" / "mechanism.csv"  # by `python -m tools.pocket card`
OTHER_GATES = ("question words", "first frame", "all frames", "length", "time stamps", "output margin", LOGITS)
VISUAL = tuple(name for name in DATASETS if not is_ill_posed(name))
TEXTUAL = tuple(name for name in DATASETS if is_ill_posed(name))


class TwoModels(Exception):
    """A figure joins the states of one model with the answers of another."""


@dataclass(frozen=True)
class Claim:
    """A claim about a model's inside.

    figure: what is measured; it holds from `bound` on. of: the figure of a model and subject, None where the study has
    none. fails_in: the controls in which the figure must stay below the bound.
    """

    name: str
    says: str
    figure: str
    bound: float
    of: Callable[[Results, str, str], float | None]
    fails_in: Sequence[str]


# --- figures ----------------------------------------------------------------------------------------------------------


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


def _by_features(figure: Callable[[Results, str, dict[str, float]], float], targets: Sequence[str]) -> Any:
    """Return the figure of a subject's AUROC by features, mean over targets; of a placebo, the largest."""

    def of(results: Results, model: str, subject: str) -> float | None:
        parts = subject_leads(results, model, subject, targets)
        values = [
            figure(results, str(part["target"].iloc[0]), dict(zip(part["features"], part["auroc"], strict=True)))
            for part in parts
        ]
        return max(values, default=None) if subject == PLACEBO else _mean(values)

    return of


def _lead(results: Results, target: str, areas: dict[str, float]) -> float:
    return areas[STATES] - max(value for name, value in areas.items() if name not in (STATES, RESIDUAL))


def _beyond_output(results: Results, target: str, areas: dict[str, float]) -> float:
    return areas[STATES] - max(areas.get(name, 0.5) for name in ("output margin", LOGITS))


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
    if subject != MODEL or not len(read):
        return None
    read = read.loc[read["prompt"] == STANDARD]
    read = read.assign(sentence=read["abstention"].astype(float) - read["own"].astype(float))
    rows = rows.merge(read[["item_id", "sentence"]], on="item_id").dropna(subset=["others", "sentence"])
    areas = []
    for _, part in rows.groupby("dataset", observed=True):
        void = (part["side"] == "void").to_numpy()
        states, sentence = (float(auroc(void, part[name].to_numpy(float))) for name in ("others", "sentence"))
        areas.append(states - sentence)
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
    return _above_others(pecs, subject)


def _above_others(figures: dict[Any, float], subject: str) -> float | None:
    own = figures.get({MODEL: STATES}.get(subject, subject))
    others = [figures[name] for name in OTHER_GATES if name in figures]
    return None if own is None or not others else own - max(others)


def _of_own(figure: Callable[[Results, str], float | None]) -> Callable[[Results, str, str], float | None]:
    """Return a figure that only the model itself has: its controls are nulls, and the model without the gap."""
    return lambda results, model, subject: figure(results, model) if subject == MODEL else None


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
    rows = rows.loc[(rows["model"] == model) & (rows["prompt"] == {MODEL: GUIDED}.get(subject, subject))]
    rows = rows.loc[(rows["features"] == STATES) & (rows["held_out"] == "families") & rows["chosen"].eq(True)]
    return _mean(rows[["auroc", "within"]].min(axis=1))


_ALL, _GAP = (*RANDOM, PLACEBO, NO_GAP), (*RANDOM, PLACEBO)
CLAIMS = (
    Claim("interaction", "states tell that the asked event is hidden", "AUROC and share in a clip, the lower", 0.65,
          _interaction, RANDOM),
    Claim("lead_visual", "states tell visual voids better than all rivals", "AUROC, states − best rival", 0.1,
          _by_features(_lead, VISUAL), _GAP),
    Claim("lead_textual", "states tell ill-posed voids better than all rivals", "AUROC, states − best rival", 0.1,
          _by_features(_lead, TEXTUAL), _GAP),
    Claim("residual", "states without words, pixels, length tell visual voids", "AUROC of residual states", 0.65,
          _by_features(lambda results, target, areas: areas[RESIDUAL], VISUAL), _GAP),
    Claim("output", "states tell visual voids better than the output", "AUROC, states − best of the output", 0.1,
          _by_features(_beyond_output, VISUAL), _ALL),
    Claim("sentence", "states tell voids better than a whole abstention", "AUROC, states − sentence", 0.1, _sentences,
          (NO_GAP,)),
    Claim("unexpressed", "voids are encoded and answered", "share of voids − of controls", 0.3, _unexpressed,
          (NO_GAP,)),
    Claim("transfer_visual", "one probe carries over to visual voids", "AUROC at the chosen layer", 0.65,
          _transfer(VISUAL), RANDOM),
    Claim("transfer_textual", "one probe carries over to ill-posed questions", "AUROC at the chosen layer", 0.65,
          _transfer(TEXTUAL), RANDOM),
    Claim("look_alikes", "voids differ from all that looks like them", "lowest AUROC", 0.65, _look_alikes, RANDOM),
    Claim("gate", "a gate on states beats all other gates", "PECS, states − best other", 0.05, _gate,
          (*RANDOM, NO_GAP)),
    Claim("answers", "abstains on voids when told that it may", "AbsRec, guided − standard", 0.3,
          _prompt(lambda rows: rows["change"]), (NO_GAP,)),
    Claim("lens", "the prompt decides what is said of voids", "guided moves voids, nats", 1.0, _of_own(_moved),
          (NO_GAP,)),
    Claim("prompt", "the prompt changes the output’s order alone", "change of AUROC, margin − probe", 0.1,
          _prompt(lambda rows: rows["margin_guided"] - rows["margin_standard"]
                  - (rows["probe_guided"] - rows["probe_standard"]).abs(), joins=False), (NO_GAP,)),
    Claim("differ", "output depends on the side (patching)", "share of pairs that differ in sign", 0.5,
          _of_own(_differ), (NO_GAP,)),
    Claim("direction", "one direction of the void under both prompts", "cosine standard, guided", 0.65,
          _of_own(_same_direction), (NO_GAP,)),
    Claim("followed", "answers follow what guided states hold alone", "controls, guided − standard directions", 0.3,
          _of_own(_followed), (NO_GAP,)),
    Claim("ahead", "guided directions do more than nulls", "controls, direction − highest null draw, largest α", 0.1,
          _of_own(_ahead), ()),
)  # fmt: skip

# --- verdicts ---------------------------------------------------------------------------------------------------------


def claim_frame(results: Results) -> pd.DataFrame:
    """Return a row for each model and claim: its figure `in_` each of SUBJECTS (NaN without one), and a verdict."""
    import pandas as pd

    rows, without_gap = [], no_gap_figures()
    tables = (results.interaction, results.leads, results.prompted_probes, results.patching)
    for model in dict.fromkeys(str(model) for table in tables for model in table["model"]):
        for claim in CLAIMS:
            values, note = {NO_GAP: without_gap.get(claim.name)}, ""
            for subject in (MODEL, *RANDOM, PLACEBO):
                try:
                    values[subject] = claim.of(results, model, subject)
                except TwoModels as joined:
                    values[subject], note = None, f"two models ({joined})"
            figures = {f"in_{subject}": value for subject, value in values.items()}
            rows.append({"model": model, "claim": claim.name, **figures, "verdict": note or verdict(claim, values)})
    columns = ["model", "claim", *(f"in_{subject}" for subject in SUBJECTS), "verdict"]
    return pd.DataFrame(rows, columns=pd.Index(columns))


def verdict(claim: Claim, values: Mapping[str, float | None]) -> str:
    """Return whether a claim is held, and if not, why."""
    own = values.get(MODEL)
    if own is None or own < claim.bound:
        return "not measured" if own is None else "does not hold"
    controls = {name: value for name in claim.fails_in if (value := values.get(name)) is not None}
    failing = [SUBJECT_NAMES[name] for name, value in controls.items() if value >= claim.bound]
    if failing:
        return f"holds in {', '.join(failing)} too"
    return "holds" if controls or not claim.fails_in else "no control"


def no_gap_figures() -> dict[str, float]:
    """Return the largest figure of each claim in the pocket model without the gap, over its training seeds."""
    largest: dict[str, float] = {}
    with NO_GAP_FILE.open(encoding="utf-8", newline="") as stream:
        for row in (row for row in csv.DictReader(stream) if row["subject"] == MODEL):
            largest[row["claim"]] = max(float(row["value"]), largest.get(row["claim"], -np.inf))
    return largest


# --- tables -----------------------------------------------------------------------------------------------------------


def claims(results: Results) -> list[PrintedTable]:
    """Return each claim in the model and in its controls, then what states and rivals tell."""
    return [_claims(results), interaction_table(results), _leads(results)]


def _claims(results: Results) -> PrintedTable:
    rows = claim_frame(results)
    by_name = {claim.name: claim for claim in CLAIMS}
    rows = rows.assign(
        says=[by_name[name].says for name in rows["claim"]],
        figure=[f"{by_name[name].figure} ≥ {by_name[name].bound:g}" for name in rows["claim"]],
    )
    columns = [
        MODEL_COLUMN, Column("says", "Claim"), Column("figure", "Holds if"),
        *(Column(f"in_{name}", SUBJECT_NAMES[name], "fraction") for name in SUBJECTS), Column("verdict", "Verdict"),
    ]  # fmt: skip
    notes = [
        "a claim holds if its figure reaches the bound in the model and in none of the controls that it must fail in; "
        "others are shown and do not count",
        "random: the same network with random weights, two seeds; placebo: answerable items in the place of voids, the "
        "largest figure; pocket, no gap: a model that says all that it encodes, the largest figure of its seeds",
        "probes are fitted on other datasets; rivals: words, pixels, length, time stamps, the output margin, and a "
        "probe on the logits of the first token",
    ]
    reason = why_not(results, "the paper has no such controls")
    return PrintedTable("claims", "What is claimed, and in which controls it holds too", rows, columns, notes, reason)


def lead_rows(results: Results) -> pd.DataFrame:
    """Return a row by model, subject and target, with the AUROC of each kind of features."""
    rows, keys = results.leads, ["model", "subject", "target"]
    rows = rows.astype(dict.fromkeys((*keys, "features"), object))
    own = rows.loc[rows["features"] == STATES, [*keys, "layer", "low", "high", "rival", "lead", "lead_low", "lead_high",
                                                "n_voids", "n_controls"]]  # fmt: skip
    areas = rows.pivot_table(index=keys, columns="features", values="auroc", observed=True).reset_index()
    return own.merge(areas, on=keys, how="left")


def _leads(results: Results) -> PrintedTable:
    rows = lead_rows(results)
    rows = rows.assign(dataset=short_names(rows["target"]))
    rivals = [name for name in OTHER_GATES if name in rows]
    columns = [
        MODEL_COLUMN, Column("subject", "Subject"), Column("dataset", "Target"), Column("layer", "Layer", "count"),
        Column(STATES, "States", "fraction"), Column("low", "from", "fraction"), Column("high", "to", "fraction"),
        *(Column(name, name.capitalize(), "fraction") for name in (RESIDUAL, *rivals) if name in rows),
        Column("rival", "Best rival"), Column("lead", "Lead", "fraction"), Column("lead_low", "from", "fraction"),
        Column("lead_high", "to", "fraction"), Column("n_voids", "Voids", "count"),
        Column("n_controls", "Controls", "count"),
    ]  # fmt: skip
    gates = results.gate
    gates = gates.loc[
        (gates["source"] == "other datasets") & (gates["threshold"] == "mid") & (gates["target"] == "all")
    ]
    notes = ["AUROC of voids against controls, by probes of the other datasets that have not seen the scenario"]
    for (model, regime), part in gates.groupby(["model", "regime"], observed=True, sort=False):
        figures = ", ".join(
            f"{name} {fraction(value)}" for name, value in zip(part["features"], part["pecs"], strict=True)
        )
        notes.append(
            f"{model} under {regime}, PECS {fraction(part['plain_pecs'].iloc[0])} without a gate; gated on {figures}"
        )
    reason = why_not(results, "the paper has no such rivals")
    return PrintedTable(
        "leads", "States and their rivals, in the model and in its controls", rows, columns, notes, reason
    )
