"""The paper's results, from `assets/published`, in the frames of a study's."""

from __future__ import annotations

from functools import cached_property
from typing import Any

import numpy as np
import pandas as pd

from traps_pipeline.judging.tables import AGREEMENT, JUDGE_BIAS
from traps_pipeline.mechanism import effects
from traps_pipeline.mechanism.tables import STEERING_SHARES
from traps_pipeline.report.mechanism import (
    published_cosines,
    published_domains,
    published_effects,
    published_layers,
    published_probes,
    published_regimes,
)
from traps_pipeline.report.results import CELL_COLUMNS, RATE_COLUMNS, SUB_COLUMNS, Results, joined
from traps_pipeline.scoring import Frame, analyses
from traps_pipeline.scoring.metrics import joined_epochs
from traps_pipeline.scoring.published import published, published_cells
from traps_pipeline.scoring.tables import CONTRASTS, LEAVE_ONE_OUT, REGIME_TESTS
from traps_pipeline.storage.tables import Table

_AXES = ("hp", "ii", "hp_and_ii", "es", "doubt")


class PublishedResults(Results):
    """The paper's numbers, as shipped in `assets/published`."""

    source = "published"

    @cached_property
    def cells(self) -> Frame:
        """See `Results.cells`."""
        cells = joined([published_cells()])
        # A spread is printed where there were three runs, whatever the model has elsewhere.
        cells["n_runs"] = np.where(cells["acc_std"].isna(), 1, 3)
        return cells.assign(n_missing=np.nan, incomplete=False).reindex(columns=pd.Index(CELL_COLUMNS))

    @cached_property
    def overall(self) -> Frame:
        """See `Results.overall`; recomputed from the printed per-dataset cells."""
        cells = self.cells
        means = analyses.overall(cells).assign(j=lambda rows: rows["abs_rec"] - rows["false_abs"])
        counts = cells.groupby(["model", "regime"]).agg(
            n_pairs=("n_pairs", "sum"), n_runs=("n_runs", "min"), epoch=("epoch", joined_epochs)
        )
        return means.merge(counts.reset_index(), on=["model", "regime"]).assign(n_missing=np.nan, incomplete=False)

    @cached_property
    def rates(self) -> Frame:
        """See `Results.rates`; gaps as printed (of unrounded rates), the pooled ones of the printed rates."""
        rows = published("visual_vs_textual")
        parts = []
        for taxonomy in analyses.TAXONOMIES:
            names = {f"{taxonomy}_{kind}_pct": kind for kind in ("visual", "textual")} | {f"{taxonomy}_gap": "gap"}
            part = rows.loc[:, ["model", *names]].rename(columns=names).assign(taxonomy=taxonomy)
            part[["visual", "textual"]] /= 100
            parts.append(part)
        pooled = joined(parts).groupby("model", sort=False)[["visual", "textual"]].mean().reset_index()
        pooled["gap"] = analyses.ratio(pooled["textual"], pooled["visual"])
        table = joined([*parts, pooled.assign(taxonomy="pooled")])
        table["gap"] = table["gap"].astype(float)
        replication = table["model"].isin(analyses.models_of(group="replication"))
        table["epoch"] = np.where(replication, "verification", "original")
        return table.reindex(columns=pd.Index(RATE_COLUMNS))

    @cached_property
    def sub_cells(self) -> Frame:
        """See `Results.sub_cells`; the paper prints none."""
        return pd.DataFrame(columns=pd.Index(["model", "dataset", "regime", "scope", "abs_rec", "n_pairs"]))

    @cached_property
    def sub_scenarios(self) -> Frame:
        """See `Results.sub_scenarios`."""
        occlusion, chaotic = published("occlusion_subscenarios"), published("chaotic_subscenarios")
        table = joined([occlusion.assign(dataset="occlusion"), chaotic.assign(dataset="chaotic")])
        table = table.rename(columns={"n": "n_pairs"})
        for name in [name for name in table if str(name).endswith("_pct")]:
            table[str(name).removesuffix("_pct")] = table[name] / 100
        table["abs_rec_uplift"] = table["guided_abs_rec"] - table["abs_rec"]
        table["textual_over_visual"] = analyses.ratio(table["abs_rec_ill_posed"], table["abs_rec"])
        return table.assign(epoch="original").reindex(columns=pd.Index(SUB_COLUMNS))

    @cached_property
    def labels(self) -> Frame:
        """See `Results.labels`; from the text of the paper, some of them approximate."""
        rows = published("other")
        rows = rows.loc[rows["id"].str.match("acc-(seesaw|dice)-")]
        labels = rows["id"].str.rsplit("-", n=1).str[1]
        return pd.DataFrame({"dataset": "chaotic", "label": labels, "acc": rows["value"].astype(float) / 100})

    @cached_property
    def agreement(self) -> Frame:
        """See `Results.agreement`."""
        rows = published("judge_agreement")
        table = rows[["dataset", "task", "fleiss_kappa"]].assign(judges="panel", agreement=rows["unanimous_pct"] / 100)
        return table.reindex(columns=pd.Index(AGREEMENT.names)).assign(epoch="not stated")

    @cached_property
    def bias(self) -> Frame:
        """See `Results.bias`; the paper prints none."""
        return _empty(JUDGE_BIAS)

    @cached_property
    def leave_one_out(self) -> Frame:
        """See `Results.leave_one_out`; the paper prints none."""
        return _empty(LEAVE_ONE_OUT)

    @cached_property
    def contrasts(self) -> Frame:
        """See `Results.contrasts`; the paper prints none."""
        return _empty(CONTRASTS)

    @cached_property
    def regime_tests(self) -> Frame:
        """See `Results.regime_tests`; the paper prints none."""
        return _empty(REGIME_TESTS)

    @cached_property
    def confabulation(self) -> Frame:
        """See `Results.confabulation`."""
        rows = published("confabulation_taxonomy")
        shares: dict[str, Any] = {axis: rows[f"{axis}_pct"] / 100 for axis in _AXES}
        return rows[["model", "n"]].assign(**shares, epoch="original")

    @cached_property
    def validation(self) -> Frame:
        """See `Results.validation`; 100 failures, two annotators (docs/spec.md 6.3)."""
        rows = published("judge_validation").rename(columns={"category": "axis", "acc": "accuracy"})
        rows["human_agreement"] = rows["human_agree_pct"] / 100
        return rows.assign(n_failures=100, n_labels=200, epoch="original")

    @cached_property
    def composition(self) -> Frame:
        """See `Results.composition`; the ill-posed datasets reuse the same scenarios (`other.csv`)."""
        rows = published("composition").rename(columns={"void_source": "void"})
        return rows[["taxonomy", "category", "void", "n"]].assign(n_ill_posed=rows["n"])

    @cached_property
    def probes(self) -> Frame:
        """See `Results.probes`."""
        return published_probes()

    @cached_property
    def cosines(self) -> Frame:
        """See `Results.cosines`."""
        return published_cosines()

    @cached_property
    def effects(self) -> Frame:
        """See `Results.effects`; the dose-response tables."""
        return published_effects()

    @cached_property
    def shares(self) -> Frame:
        """See `Results.shares`: the paper has none, since it prints no answers."""
        return pd.DataFrame(columns=pd.Index(STEERING_SHARES.names))

    @cached_property
    def steering_regimes(self) -> Frame:
        """See `Results.steering_regimes`; the printed table."""
        rows = published_regimes()
        return rows.loc[rows["family"] == "all"].reset_index(drop=True)

    @cached_property
    def steering_families(self) -> Frame:
        """See `Results.steering_families`; the printed table."""
        rows = published_regimes()
        return rows.loc[rows["family"] != "all"].reset_index(drop=True)

    @cached_property
    def steering_domains(self) -> Frame:
        """See `Results.steering_domains`; two of its figures stand in the text alone."""
        return published_domains(effects.domains(self.effects))

    @cached_property
    def steering_layers(self) -> Frame:
        """See `Results.steering_layers`."""
        return published_layers()


def _empty(table: Table) -> Frame:
    return pd.DataFrame(columns=pd.Index([c.name for c in table.columns]))
