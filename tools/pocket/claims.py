"""What each stage can claim of a model, measured in two models that were trained alike but for one thing: the gap.

Both see the same scenes in the same order. One abstains on voids under the guided prompts alone, the other under every
prompt. A claim about the gap should hold in the first and fail in the second; the card has the table.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from traps_pipeline.mechanism.effects import two_sided_effects
from traps_pipeline.mechanism.probes import auroc
from traps_pipeline.protocol.datasets import DATASETS
from traps_pipeline.protocol.regimes import GUIDED, STANDARD
from traps_pipeline.report.figures.expression_figures import orders, scored_items
from traps_pipeline.report.study_results import StudyResults
from traps_pipeline.report.tables.control_reports import prompts

if TYPE_CHECKING:
    from tools.pocket.seeds import Figure
    from traps_pipeline.report.result_frames import Results
    from traps_pipeline.storage.workspace import Workspace

P = 0.05 + 1e-9


@dataclass(frozen=True)
class Claim:
    """A claim about a model. figure: what is measured, in words; it holds from `bound` on. of: the figure of a study,
    None where the study has none."""

    name: str
    stage: str
    says: str
    figure: str
    bound: float
    of: Callable[[Results], float | None]


def _mean(values: Any) -> float | None:
    """Return the mean of a column, without what is missing; None if nothing is left."""
    known = values.dropna().astype(float)
    return float(known.mean()) if len(known) else None


def _said(results: Results) -> float | None:
    return _mean(prompts(results)["change"])


def _unsaid(results: Results) -> float | None:
    rows = scored_items(results)
    voids = rows.loc[rows["side"] == "void"]
    hidden = (voids["own"] > 0) & (voids["margin"] < 0) & voids["abstained_standard"].eq(False)
    return float(hidden.mean()) if len(voids) else None


def _above(other: str) -> Callable[[Results], float | None]:
    """Return how much better states order the sides than something else, in AUROC, mean over datasets."""

    def of(results: Results) -> float | None:
        areas = [orders(rows) for _, rows in scored_items(results).groupby("dataset", observed=True)]
        if not areas or not all({"states", other} <= area.keys() for area in areas):
            return None
        return float(np.mean([area["states"] - area[other] for area in areas]))

    return of


def _sentence_alone(results: Results) -> float | None:
    """As `_above`, of the log-probability of the likeliest abstention, whatever the model's own answer has."""
    read = results.sentences
    read = read.loc[read["prompt"] == STANDARD, ["model", "item_id", "abstention"]]
    rows = scored_items(results).merge(read, on=["model", "item_id"])
    above = [
        orders(of)["states"] - float(auroc((of["side"] == "void").to_numpy(), of["abstention"].to_numpy(float)))
        for _, of in rows.groupby("dataset", observed=True)
    ]
    return float(np.mean(above)) if above else None


def _moved(results: Results) -> float | None:
    """Return by how much more the guided prompt moves the log-odds of voids than of controls, at the last layer."""
    rows = results.lens
    rows = rows.loc[rows["layer"] == rows["layer"].max()]
    apart = (rows["voids"] - rows["controls"]).groupby(rows["prompt"].astype(str)).mean()
    return float(apart[GUIDED] - apart[STANDARD]) if {STANDARD, GUIDED} <= {*apart.index} else None


def _prompt_alone(results: Results) -> float | None:
    """Return by how much the guided prompt changes the order of the output margin, beyond that of the probe."""
    rows = prompts(results)
    margin, probe = (rows[f"{name}_guided"] - rows[f"{name}_standard"] for name in ("margin", "probe"))
    return _mean(margin - probe.abs())


def _gated(results: Results, features: str = "states") -> float | None:
    rows = results.gate
    rows = rows.loc[(rows["regime"] == STANDARD) & (rows["source"] == "other datasets") & (rows["threshold"] == "mid")]
    rows = rows.loc[(rows["target"] == "all") & rows["features"].isin(["states", features])].set_index("features")
    if features not in rows.index:
        return None
    before = rows["plain_pecs"] if features == "states" else rows.loc[[features], "pecs"]
    return float(rows["pecs"]["states"] - before.iloc[0])


def _risk(results: Results) -> float | None:
    rows = results.risk_coverage
    rows = rows.loc[(rows["regime"] == STANDARD) & np.isclose(rows["coverage"].astype(float), 0.5)]
    risk = rows.groupby(rows["features"].astype(str))["risk"].mean()
    return float(risk["output margin"] - risk["states"]) if {"output margin", "states"} <= {*risk.index} else None


def _confabulated(results: Results) -> float | None:
    rows = results.probes
    pairs = rows.loc[(rows["analysis"] == "confabulated") & rows["value"].notna()]
    return float(len(pairs[["source", "target"]].drop_duplicates())) if len(rows) else None


def _transfer(results: Results) -> float | None:
    rows = results.probes
    return _mean(rows.loc[(rows["analysis"] == "transfer") & rows["chosen"].eq(True), "value"])


def _same_direction(results: Results) -> float | None:
    rows = results.cosines
    same = (rows["dataset"] == rows["other_dataset"]) & (rows["prompt"] != rows["other_prompt"])
    return _mean(rows.loc[same, "cosine"])


def _followed(results: Results) -> float | None:
    """Return by how many more controls abstain along a dataset's own direction if it comes from guided states and not
    from standard ones, at one dose for both. An answer that says nothing is no abstention."""
    rows = two_sided_effects(results.effects)
    rows = rows.loc[(rows["source"] == rows["target"]) & (rows["side"] == "control")]
    rows = rows.loc[rows["alpha"] == rows["alpha"].max()]
    share = (rows["abstained"] / (rows["n"] + rows["n_missing"])).groupby(rows["directions"].astype(str)).mean()
    return float(share[GUIDED] - share[STANDARD]) if {STANDARD, GUIDED} <= {*share.index} else None


def _ahead(results: Results) -> float | None:
    rows = results.nulls
    rows = rows.loc[rows["target"].isin(DATASETS) & (rows["directions"] == GUIDED)]
    cells = rows.groupby(["regime", "target", "layer", "unit", "dose", "side"], observed=True)["p"].max()
    return float((cells <= P).sum()) if len(cells) else None


def _differ(results: Results) -> float | None:
    rows = results.patching
    rows = rows.loc[rows["source"] == "pair"]
    return _mean(rows["n_flippable"] / rows["n"]) if len(rows) else None


CLAIMS = (
    Claim("said", "answers", "abstains on voids when told that it may",
          "AbsRec guided − standard", 0.3, _said),
    Claim("unsaid", "`item_scores`", "encodes voids that it answers",
          "share of voids with states above 0, a margin below 0, an answer", 0.3, _unsaid),
    Claim("order", "`states_and_output`", "states order the sides better than the first token",
          "AUROC of states − margin", 0.1, _above("margin")),
    Claim("sentence", "`sentences`", "better than a whole abstention",
          "AUROC of states − log-probability", 0.1, _sentence_alone),
    Claim("answer", "`sentences`", "better than an abstention against its own answer",
          "AUROC of states − difference", 0.1, _above("sentences")),
    Claim("lens", "`lens`", "the prompt decides what is said of voids",
          "guided moves voids above controls, nats", 1.0, _moved),
    Claim("prompt", "`prompt_gate`", "the prompt changes the output’s order alone",
          "change of AUROC, margin − probe", 0.1, _prompt_alone),
    Claim("gate", "`gate`", "a gate makes a better model",
          "PECS gated − plain, standard", 0.1, _gated),
    Claim("margin_gate", "`gate_controls`", "states gate better than the margin",
          "PECS, states − margin, standard", 0.1, lambda results: _gated(results, "output margin")),
    Claim("risk", "`risk_coverage`", "states know wrong answers better than the margin",
          "risk at half coverage, margin − states", 0.05, _risk),
    Claim("confabulated", "`probe_confabulated`", "states know confabulated voids",
          "pairs with a Cf→Cf probe", 1.0, _confabulated),
    Claim("differ", "`patching`", "output under guided depends on the side",
          "share of pairs whose sides differ in the margin’s sign", 0.5, _differ),
    Claim("transfer", "`probe_transfer`", "states carry the void over datasets",
          "AUROC at the chosen layer", 0.65, _transfer),
    Claim("direction", "`cosines`", "one direction of the void under both prompts",
          "cosine standard, guided", 0.65, _same_direction),
    Claim("followed", "`steering_effects`", "answers follow what guided states encode alone",
          "controls that abstain at the largest alpha, guided − standard directions", 0.3, _followed),
    Claim("ahead", "`steering_nulls`", "guided directions do more than their nulls",
          "cells ahead of 19 of 20 draws of every null", 1.0, _ahead),
)  # fmt: skip


def claimed(workspace: Workspace) -> dict[str, float]:
    """Return the figures of a finished study of one model by the names of CLAIMS, without those that it has not."""
    results = StudyResults(workspace)
    values = {claim.name: claim.of(results) for claim in CLAIMS}
    return {name: value for name, value in values.items() if value is not None}


def markdown(gap: Sequence[Figure], no_gap: Sequence[Figure]) -> str:
    """Return the table of the card: each claim in both models, by training seed, and whether its stage tells them
    apart: whether it holds for every seed of one, and for none of the other."""
    seeds = [", ".join(str(seed) for seed in sorted({f.seed for f in of})) for of in (gap, no_gap)]
    heads = ["claim", "holds if", f"gap, seed {seeds[0]}", f"no gap, seed {seeds[1]}", "told apart"]
    lines = [f"| {' | '.join(heads)} |", "|" + " --- |" * len(heads)]
    for claim in CLAIMS:
        values = [[f.value for f in sorted(of, key=lambda f: f.seed) if f.claim == claim.name] for of in (gap, no_gap)]
        if not all(values):
            continue
        every, some = ([pick(of) >= claim.bound for of in values] for pick in (min, max))  # of the seeds of a model
        told = "yes" if every[0] and not some[1] else "the other way" if every[1] and not some[0] else "no"
        cells = [", ".join(f"{value:.2f}" for value in of) for of in values]
        columns = [f"{claim.stage}: {claim.says}", f"{claim.figure} ≥ {claim.bound:g}", *cells, told]
        lines.append(f"| {' | '.join(columns)} |")
    return "\n".join(lines)
