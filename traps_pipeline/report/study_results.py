"""A study's own results, from the tables of its workspace."""

from __future__ import annotations

from functools import cached_property

import numpy as np
import pandas as pd

from traps_pipeline.benchmark.tables import ITEMS
from traps_pipeline.judging.tables import AGREEMENT, JUDGE_BIAS, JUDGE_VALIDATION
from traps_pipeline.mechanism.tables import COSINES, PROBES, STEERING_EFFECTS, STEERING_SHARES
from traps_pipeline.partitions import taxonomy_of
from traps_pipeline.report.results import CELL_COLUMNS, RATE_COLUMNS, SUB_COLUMNS, Results, joined
from traps_pipeline.scoring import Frame, analyses
from traps_pipeline.scoring.epochs import EpochMismatch
from traps_pipeline.scoring.metrics import joined_epochs
from traps_pipeline.scoring.tables import (
    CONFABULATION_PREVALENCE,
    CONTRASTS,
    LEADERBOARD,
    LEAVE_ONE_OUT,
    METRICS,
    REGIME_TESTS,
)
from traps_pipeline.storage.workspace import Workspace


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
        table = joined(found)
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
        items = joined([self.tables.read_all(ITEMS, ["sub_scenario", "answer_type"])])
        known = items.drop_duplicates("sub_scenario")
        types = known.set_index("sub_scenario")["answer_type"]
        found = []
        for _, cells in self.sub_cells.groupby("scope", sort=True):
            try:
                found.append(analyses.sub_scenarios(cells).assign(epoch=joined_epochs(cells["epoch"])))
            except EpochMismatch as error:
                self.refused.setdefault("sub_scenarios", []).append(str(error))
        table = joined(found).reindex(columns=pd.Index(SUB_COLUMNS))
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
        table = joined([counts.reindex(columns=["n", "n_ill_posed"]).reset_index()])
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


def _ill_posed(frame: Frame) -> Frame:
    return frame["dataset"].str.endswith("_ill_posed")


def _without_references(rows: Frame) -> Frame:
    """Means over models are over those that look: without reference strategies, where anybody else was asked."""
    looking = rows.loc[~rows["model"].isin(analyses.models_of(group="reference"))]
    return looking if len(looking) else rows
