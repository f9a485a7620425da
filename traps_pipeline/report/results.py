"""What tables and figures are made from: a study's results or the paper's, in the same tidy frames.

A frame without rows means that this was not run. Shares are fractions; every frame with figures has a column `epoch`.
"""

from __future__ import annotations

from collections.abc import Iterable
from functools import cached_property
from typing import Any

import numpy as np
import pandas as pd

from traps_pipeline.digests import digest
from traps_pipeline.mechanism import effects
from traps_pipeline.partitions import DATASETS, taxonomy_of
from traps_pipeline.report.mechanism import (
    published_cosines,
    published_domains,
    published_effects,
    published_layers,
    published_probes,
    published_regimes,
)
from traps_pipeline.scoring import Frame, analyses
from traps_pipeline.scoring.epochs import EpochMismatch
from traps_pipeline.scoring.metrics import joined_epochs
from traps_pipeline.scoring.published import PUBLISHED, published, published_cells
from traps_pipeline.storage.workspace import Workspace
from traps_pipeline.tables import (
    AGREEMENT,
    CONFABULATION_PREVALENCE,
    CONTRASTS,
    COSINES,
    ITEMS,
    JUDGE_BIAS,
    JUDGE_VALIDATION,
    LEADERBOARD,
    LEAVE_ONE_OUT,
    METRICS,
    PROBES,
    REGIME_TESTS,
    STEERING_EFFECTS,
    STEERING_SHARES,
    Table,
)

CELL_COLUMNS = (
    *("model", "dataset", "regime", "epoch", "n_pairs", "n_runs", "n_missing", "incomplete"),
    *("acc", "acc_std", "abs_rec", "abs_rec_std", "false_abs", "false_abs_std", "pecs", "pecs_std"),
)
RATE_COLUMNS = (
    *("model", "taxonomy", "visual", "textual", "gap", "epoch", "n_pairs", "n_runs", "n_missing", "incomplete"),
)
SUB_COLUMNS = (
    *("dataset", "sub_scenario", "n_pairs", "n_missing", "n_models", "guided_n_models", "uplift_n_models"),
    *("ill_posed_n_models", "acc", "false_abs", "abs_rec", "pecs", "guided_abs_rec"),
    *("guided_false_abs", "guided_pecs", "abs_rec_uplift", "false_abs_uplift", "abs_rec_ill_posed"),
    *("textual_over_visual", "answer_type", "epoch"),
)
_AXES = ("hp", "ii", "hp_and_ii", "es", "doubt")


class Results:
    """One set of results; every property is a frame, without rows where that was not run."""

    source = ""  # in words, for titles
    is_study = False

    @cached_property
    def cells(self) -> Frame:
        """CELL_COLUMNS, one row a (model, dataset, regime), averaged over runs."""
        raise NotImplementedError

    @cached_property
    def overall(self) -> Frame:
        """One row a (model, regime) that has all four datasets: the columns of cells but dataset, and j; a study's also
        have j_std, the intervals and ranks of LEADERBOARD. epoch joins those of the datasets by +."""
        raise NotImplementedError

    @cached_property
    def rates(self) -> Frame:
        """RATE_COLUMNS: visual and textual AbsRec under standard, a row a model and taxonomy (or pooled)."""
        raise NotImplementedError

    @cached_property
    def sub_scenarios(self) -> Frame:
        """SUB_COLUMNS: means over models, a row a sub-scenario."""
        raise NotImplementedError

    @cached_property
    def sub_cells(self) -> Frame:
        """A row a (model, dataset, regime) and sub-scenario (column scope)."""
        raise NotImplementedError

    @cached_property
    def labels(self) -> Frame:
        """Mean Acc over models by the control's answer: dataset, label, acc, n_pairs, n_models."""
        raise NotImplementedError

    @cached_property
    def agreement(self) -> Frame:
        """AGREEMENT rows."""
        raise NotImplementedError

    @cached_property
    def bias(self) -> Frame:
        """JUDGE_BIAS rows."""
        raise NotImplementedError

    @cached_property
    def leave_one_out(self) -> Frame:
        """LEAVE_ONE_OUT rows."""
        raise NotImplementedError

    @cached_property
    def contrasts(self) -> Frame:
        """CONTRASTS rows."""
        raise NotImplementedError

    @cached_property
    def regime_tests(self) -> Frame:
        """REGIME_TESTS rows."""
        raise NotImplementedError

    @cached_property
    def confabulation(self) -> Frame:
        """CONFABULATION_PREVALENCE rows."""
        raise NotImplementedError

    @cached_property
    def validation(self) -> Frame:
        """JUDGE_VALIDATION rows."""
        raise NotImplementedError

    @cached_property
    def composition(self) -> Frame:
        """taxonomy, category, void, n (well-posed pairs), n_ill_posed."""
        raise NotImplementedError

    @cached_property
    def probes(self) -> Frame:
        """PROBES rows; the paper's have transfer, confabulated, shuffled and centroid_void alone."""
        raise NotImplementedError

    @cached_property
    def cosines(self) -> Frame:
        """COSINES rows at the steered layer of each model."""
        raise NotImplementedError

    @cached_property
    def effects(self) -> Frame:
        """STEERING_EFFECTS rows."""
        raise NotImplementedError

    @cached_property
    def shares(self) -> Frame:
        """STEERING_SHARES rows."""
        raise NotImplementedError

    @cached_property
    def steering_regimes(self) -> Frame:
        """Rows of `mechanism.effects.regime_matrix`."""
        return effects.regime_matrix(self.effects)

    @cached_property
    def steering_families(self) -> Frame:
        """Rows of `mechanism.effects.family_asymmetry`."""
        return effects.family_asymmetry(self.effects)

    @cached_property
    def steering_domains(self) -> Frame:
        """Rows of `mechanism.effects.domains`, and `mark` for those judged in another way."""
        return effects.domains(self.effects).assign(mark="")

    @cached_property
    def steering_layers(self) -> Frame:
        """Rows of `mechanism.effects.sweep`."""
        return effects.sweep(self.effects)

    def refusal(self, dataset: str, left: tuple[str, str], right: tuple[str, str]) -> str | None:
        """Why two (model, regime) may not be compared on a dataset or `overall`, as the contrasts found item by item;
        None where they may."""
        return self._refusals.get((dataset, frozenset((left, right))))

    @cached_property
    def _refusals(self) -> dict[tuple[str, frozenset[tuple[str, str]]], str]:
        rows = self.contrasts.dropna(subset=["refused"]).to_dict("records")
        sides = [frozenset((r[f"{side}_model"], r[f"{side}_regime"]) for side in ("left", "right")) for r in rows]
        return {(row["dataset"], pair): row["refused"] for row, pair in zip(rows, sides, strict=True)}

    @cached_property
    def refused(self) -> dict[str, list[str]]:
        """What was not computed because its sides are of different epochs: reasons by analysis."""
        return {}

    def why(self, what: str) -> str:
        """Why a frame has no rows, in words."""
        return "; ".join(self.refused.get(what, [])) or (
            "this study has no such results yet" if self.is_study else "the paper prints no such table"
        )


class StudyResults(Results):
    """A workspace's own tables."""

    source = "this study"
    is_study = True

    def __init__(self, workspace: Workspace) -> None:
        self.tables, self.inside = workspace.tables, workspace.study.mechanism

    @cached_property
    def board(self) -> Frame:
        """LEADERBOARD rows."""
        return self.tables.read_all(LEADERBOARD)

    @cached_property
    def cells(self) -> Frame:
        """See `Results.cells`."""
        return analyses.study_cells(self.board).reindex(columns=pd.Index(CELL_COLUMNS))

    @cached_property
    def overall(self) -> Frame:
        """See `Results.overall`."""
        intervals = [
            f"{name}_ci_{end}" for name in ("acc", "abs_rec", "false_abs", "j", "pecs") for end in ("low", "high")
        ]
        more = ["j", "j_std", *intervals, "rank", "rank_low", "rank_high"]
        wanted = [name for name in (*CELL_COLUMNS, *more) if name != "dataset"]
        rows = self.board.loc[self.board["dataset"] == "overall", wanted]
        return analyses.of_several_runs(rows.reset_index(drop=True))

    @cached_property
    def rates(self) -> Frame:
        """See `Results.rates`."""
        standard = self.cells.loc[self.cells["regime"] == "standard"]
        found = []
        for _, rows in standard.groupby("model", sort=False):
            for part in [rows[rows["dataset"].map(taxonomy_of) == t] for t in analyses.TAXONOMIES] + [rows]:
                found.append(self._gap(part))
        table = _joined(found)
        return table.reindex(columns=pd.Index(RATE_COLUMNS)).drop_duplicates(["model", "taxonomy"])

    def _gap(self, rows: Frame) -> Frame:
        try:
            gaps = analyses.visual_textual_gap(rows)
        except EpochMismatch as error:
            self.refused.setdefault("rates", []).append(str(error))
            return pd.DataFrame()
        counts = {name: rows[name].sum() for name in ("n_pairs", "n_missing")}
        counts |= {"n_runs": rows["n_runs"].min(), "incomplete": bool(rows["incomplete"].any())}
        return gaps.assign(epoch=joined_epochs(rows["epoch"]), **counts)

    @cached_property
    def _metrics(self) -> Frame:
        return self.tables.read_all(METRICS)

    @cached_property
    def sub_cells(self) -> Frame:
        """See `Results.sub_cells`."""
        return self._scoped("sub_scenario")

    def _scoped(self, scope: str) -> Frame:
        metrics = _without_references(self._metrics)
        if not len(metrics):
            return pd.DataFrame(columns=pd.Index([*CELL_COLUMNS, "scope"]))
        return analyses.scoped_cells(metrics, scope)

    @cached_property
    def sub_scenarios(self) -> Frame:
        """See `Results.sub_scenarios`."""
        items = _joined([self.tables.read_all(ITEMS, ["sub_scenario", "answer_type"])])
        known = items.drop_duplicates("sub_scenario")
        types = known.set_index("sub_scenario")["answer_type"]
        found = []
        for _, cells in self.sub_cells.groupby("scope", sort=True):
            try:
                found.append(analyses.sub_scenarios(cells).assign(epoch=joined_epochs(cells["epoch"])))
            except EpochMismatch as error:
                self.refused.setdefault("sub_scenarios", []).append(str(error))
        table = _joined(found).reindex(columns=pd.Index(SUB_COLUMNS))
        table["answer_type"] = table["sub_scenario"].map(types)
        return table.reindex(columns=pd.Index(SUB_COLUMNS))

    @cached_property
    def labels(self) -> Frame:
        """See `Results.labels`."""
        return analyses.accuracy_by_label(self._scoped("label"))

    @cached_property
    def agreement(self) -> Frame:
        """See `Results.agreement`."""
        return self.tables.read_all(AGREEMENT)

    @cached_property
    def bias(self) -> Frame:
        """See `Results.bias`."""
        return self.tables.read_all(JUDGE_BIAS)

    @cached_property
    def leave_one_out(self) -> Frame:
        """See `Results.leave_one_out`."""
        return self.tables.read_all(LEAVE_ONE_OUT)

    @cached_property
    def contrasts(self) -> Frame:
        """See `Results.contrasts`."""
        return self.tables.read_all(CONTRASTS)

    @cached_property
    def regime_tests(self) -> Frame:
        """See `Results.regime_tests`."""
        return self.tables.read_all(REGIME_TESTS)

    @cached_property
    def confabulation(self) -> Frame:
        """See `Results.confabulation`."""
        return self.tables.read_all(CONFABULATION_PREVALENCE)

    @cached_property
    def validation(self) -> Frame:
        """See `Results.validation`."""
        return self.tables.read_all(JUDGE_VALIDATION)

    @cached_property
    def composition(self) -> Frame:
        """See `Results.composition`."""
        items = self.tables.read_all(ITEMS, ["dataset", "taxonomy", "category", "pair_id"])
        pairs = items.drop_duplicates("pair_id").assign(kind=lambda f: np.where(_ill_posed(f), "n_ill_posed", "n"))
        counts = pairs.pivot_table(index=["taxonomy", "category"], columns="kind", values="pair_id", aggfunc="count")
        table = _joined([counts.reindex(columns=["n", "n_ill_posed"]).reset_index()])
        table["void"] = table["taxonomy"].map({"occlusion": "occluder", "chaotic": "truncation"})
        return table.sort_values("taxonomy", ascending=False, ignore_index=True)

    @cached_property
    def probes(self) -> Frame:
        """See `Results.probes`."""
        return self.tables.read_all(PROBES)

    @cached_property
    def cosines(self) -> Frame:
        """See `Results.cosines`."""
        rows = self.tables.read_all(COSINES)
        steered = {model: layers.steering for model, layers in self.inside.models.items()} if self.inside else {}
        wanted = [layer == steered.get(model) for layer, model in zip(rows["layer"], rows["model"], strict=True)]
        return rows.loc[wanted].reset_index(drop=True)

    @cached_property
    def effects(self) -> Frame:
        """See `Results.effects`."""
        return self.tables.read_all(STEERING_EFFECTS)

    @cached_property
    def shares(self) -> Frame:
        """See `Results.shares`."""
        return self.tables.read_all(STEERING_SHARES)


class PublishedResults(Results):
    """The paper's numbers, as shipped in `assets/published`."""

    source = "published"

    @cached_property
    def cells(self) -> Frame:
        """See `Results.cells`."""
        cells = _joined([published_cells()])
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
        rows = _printed("visual_vs_textual")
        parts = []
        for taxonomy in analyses.TAXONOMIES:
            names = {f"{taxonomy}_{kind}_pct": kind for kind in ("visual", "textual")} | {f"{taxonomy}_gap": "gap"}
            part = rows[["model", *names]].rename(columns=names).assign(taxonomy=taxonomy)
            part[["visual", "textual"]] /= 100
            parts.append(part)
        pooled = _joined(parts).groupby("model", sort=False)[["visual", "textual"]].mean().reset_index()
        pooled["gap"] = analyses.ratio(pooled["textual"], pooled["visual"])
        table = _joined([*parts, pooled.assign(taxonomy="pooled")])
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
        occlusion, chaotic = _printed("occlusion_subscenarios"), _printed("chaotic_subscenarios")
        table = _joined([occlusion.assign(dataset="occlusion"), chaotic.assign(dataset="chaotic")])
        table = table.rename(columns={"n": "n_pairs"})
        for name in [name for name in table if str(name).endswith("_pct")]:
            table[str(name).removesuffix("_pct")] = table[name] / 100
        table["abs_rec_uplift"] = table["guided_abs_rec"] - table["abs_rec"]
        table["textual_over_visual"] = analyses.ratio(table["abs_rec_ill_posed"], table["abs_rec"])
        return table.assign(epoch="original").reindex(columns=pd.Index(SUB_COLUMNS))

    @cached_property
    def labels(self) -> Frame:
        """See `Results.labels`; from the text of the paper, some of them approximate."""
        rows = _printed("other")
        rows = rows.loc[rows["id"].str.match("acc-(seesaw|dice)-")]
        labels = rows["id"].str.rsplit("-", n=1).str[1]
        return pd.DataFrame({"dataset": "chaotic", "label": labels, "acc": rows["value"].astype(float) / 100})

    @cached_property
    def agreement(self) -> Frame:
        """See `Results.agreement`."""
        rows = _printed("judge_agreement")
        table = rows[["dataset", "task", "fleiss_kappa"]].assign(judges="panel", agreement=rows["unanimous_pct"] / 100)
        return table.reindex(columns=pd.Index([c.name for c in AGREEMENT.columns])).assign(epoch="not stated")

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
        rows = _printed("confabulation_taxonomy")
        shares: dict[str, Any] = {axis: rows[f"{axis}_pct"] / 100 for axis in _AXES}
        return rows[["model", "n"]].assign(**shares, epoch="original")

    @cached_property
    def validation(self) -> Frame:
        """See `Results.validation`; 100 failures, two annotators (benchmark.md section 6)."""
        rows = _printed("judge_validation").rename(columns={"category": "axis", "acc": "accuracy"})
        rows["human_agreement"] = rows["human_agree_pct"] / 100
        return rows.assign(n_failures=100, n_labels=200, epoch="original")

    @cached_property
    def composition(self) -> Frame:
        """See `Results.composition`; the ill-posed datasets reuse the same scenarios (`other.csv`)."""
        rows = _printed("composition").rename(columns={"void_source": "void"})
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
        return pd.DataFrame(columns=pd.Index([c.name for c in STEERING_SHARES.columns]))

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


def published_digest() -> str:
    """Digest of `assets/published`: everything that the paper's tables and figures are made from."""
    files = {file.name: file.read_text(encoding="utf-8") for file in sorted(PUBLISHED.glob("*.csv"))}
    return digest(files)[:16]


def _joined(parts: Iterable[Frame]) -> Frame:
    """One below the other; a frame without rows or columns where there are none."""
    return pd.concat([pd.DataFrame(), *parts], ignore_index=True)


def _empty(table: Table) -> Frame:
    return pd.DataFrame(columns=pd.Index([c.name for c in table.columns]))


def _printed(name: str) -> Frame:
    """A published file."""
    return published(name)


def _ill_posed(frame: Frame) -> Frame:
    return frame["dataset"].str.endswith("_ill_posed")


def _without_references(rows: Frame) -> Frame:
    """Means over models are over those that look: without reference strategies, where anybody else was asked."""
    looking = rows.loc[~rows["model"].isin(analyses.models_of(group="reference"))]
    return looking if len(looking) else rows


def datasets_of(cells: Frame) -> list[str]:
    """The datasets that cells are of, in the benchmark's order."""
    there = set(cells["dataset"])
    return [name for name in DATASETS if name in there]
