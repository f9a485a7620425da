"""Read a study's own results from the tables of its workspace."""

from __future__ import annotations

from functools import cached_property

import numpy as np
import pandas as pd
from typing_extensions import override

from traps_pipeline.base.wording import count_noun
from traps_pipeline.mechanism.mechanism_rows import COSINES, STEERING_EFFECTS
from traps_pipeline.models.registry.entries import reference_rows
from traps_pipeline.models.registry.judges import panel_id
from traps_pipeline.people.recorded_certificates import certification_note
from traps_pipeline.protocol.datasets import DATASETS, taxonomy_of
from traps_pipeline.report.leaderboard_page import judged_by
from traps_pipeline.report.result_frames import CELL_COLUMNS, RATE_COLUMNS, SUB_COLUMNS, Results, concat_frames
from traps_pipeline.scoring import analyses
from traps_pipeline.scoring.epochs import EpochMismatch
from traps_pipeline.scoring.metrics import joined_epochs
from traps_pipeline.scoring.score_rows import METRICS
from traps_pipeline.storage.benchmark_tables import ITEMS
from traps_pipeline.storage.tables import Table
from traps_pipeline.storage.workspace import Workspace


def _panel_rows(results: StudyResults, rows: pd.DataFrame) -> pd.DataFrame:
    """Return rows that the tables' panel decided; panels are never shown together."""
    return rows.loc[rows["panel"] == results.panel].reset_index(drop=True)


def _cells(results: StudyResults) -> pd.DataFrame:
    return analyses.study_cells(_panel_rows(results, results.board)).reindex(columns=pd.Index(CELL_COLUMNS))


def _overall(results: StudyResults) -> pd.DataFrame:
    intervals = [f"{name}_ci_{end}" for name in ("acc", "abs_rec", "false_abs", "j", "pecs") for end in ("low", "high")]
    extra_columns = ["j", "j_std", *intervals, "rank", "rank_low", "rank_high"]
    columns = [name for name in (*CELL_COLUMNS, *extra_columns) if name != "dataset"]
    board = _panel_rows(results, results.board)
    rows = board.loc[board["dataset"] == "overall", columns]
    return analyses.null_single_deviations(rows.reset_index(drop=True))


def _rates(results: StudyResults) -> pd.DataFrame:
    standard = results.cells.loc[results.cells["regime"] == "standard"]
    parts = [standard[standard["dataset"].map(taxonomy_of) == t] for t in analyses.TAXONOMIES] + [standard]
    gaps = concat_frames([gap for part in parts for gap in _gaps(results, part)]).reindex(
        columns=pd.Index(RATE_COLUMNS)
    )
    place = {model: number for number, model in enumerate(standard["model"].unique())}
    gaps = gaps.drop_duplicates(["model", "taxonomy"])
    return gaps.sort_values("model", key=lambda models: models.map(place), kind="stable", ignore_index=True)


def _gaps(results: StudyResults, rows: pd.DataFrame) -> list[pd.DataFrame]:
    """Return the gaps of all models; if epochs are mixed, of each model that has one."""
    try:
        gaps = analyses.visual_textual_gap(rows)
    except EpochMismatch as error:
        models = [part for _, part in rows.groupby("model", sort=False)]
        if len(models) > 1:
            return [gap for part in models for gap in _gaps(results, part)]
        results.refused.setdefault("rates", []).append(str(error))
        return []
    model_means = rows.groupby("model").agg(
        n_pairs=("n_pairs", "sum"),
        n_missing=("n_missing", "sum"),
        n_runs=("n_runs", "min"),
        incomplete=("incomplete", "any"),
        epoch=("epoch", joined_epochs),
    )
    return [gaps.merge(model_means, left_on="model", right_index=True, how="left", sort=False)]


def _scoped_metrics(results: StudyResults, scope: str) -> pd.DataFrame:
    metrics = _without_references(results.metrics)
    if not len(metrics):
        return pd.DataFrame(columns=pd.Index([*CELL_COLUMNS, "scope"]))
    return analyses.scoped_cells(metrics, scope)


def _sub_scenarios(results: StudyResults) -> pd.DataFrame:
    items = concat_frames([results.tables.read_all(ITEMS, ["sub_scenario", "answer_type"], dataset=DATASETS)])
    types = items.drop_duplicates("sub_scenario").set_index("sub_scenario").loc[:, "answer_type"]
    rows = []
    for _, cells in results.sub_cells.groupby("scope", sort=True):
        try:
            rows.append(analyses.sub_scenarios(cells).assign(epoch=joined_epochs(cells["epoch"])))
        except EpochMismatch as error:
            results.refused.setdefault("sub_scenarios", []).append(str(error))
    table = concat_frames(rows).reindex(columns=pd.Index(SUB_COLUMNS))
    return table.assign(answer_type=table.loc[:, "sub_scenario"].map(types))


def _composition(results: StudyResults) -> pd.DataFrame:
    items = results.tables.read_all(ITEMS, ["dataset", "taxonomy", "category", "pair_id"], dataset=DATASETS)
    pairs = items.drop_duplicates("pair_id").assign(kind=lambda f: np.where(_ill_posed(f), "n_ill_posed", "n"))
    counts = pairs.pivot_table(index=["taxonomy", "category"], columns="kind", values="pair_id", aggfunc="count")
    table = concat_frames([counts.reindex(columns=["n", "n_ill_posed"]).reset_index()])
    table["void"] = table.loc[:, "taxonomy"].map({"occlusion": "occluder", "chaotic": "truncation"})
    return table.sort_values("taxonomy", ascending=False, ignore_index=True)


def _cosines(results: StudyResults) -> pd.DataFrame:
    rows, mechanism = results.rows(COSINES), results.mechanism
    steering_layers = {model: layers.steering for model, layers in mechanism.models.items()} if mechanism else {}
    is_steered = [
        layer == steering_layers.get(model) for layer, model in zip(rows["layer"], rows["model"], strict=True)
    ]
    return rows.loc[is_steered].reset_index(drop=True)


def _effects(results: StudyResults) -> pd.DataFrame:
    """Return the paper's protocol rows, with dose in class gaps and degenerate share."""
    from traps_pipeline.mechanism.effects import in_gaps
    from traps_pipeline.mechanism.shares import paper_protocol_rows  # imports what steers, which few studies need

    all_effects = results.rows(STEERING_EFFECTS)
    rows = in_gaps(paper_protocol_rows(all_effects), all_effects)
    answers = rows["n"].astype(float) + rows["n_missing"].astype(float)
    return rows.assign(broken=rows["degenerate"].astype(float) / answers)


def _ill_posed(frame: pd.DataFrame) -> pd.DataFrame:
    return frame["dataset"].str.endswith("_ill_posed")


def _without_references(rows: pd.DataFrame) -> pd.DataFrame:
    """Return rows without reference strategies, if other models were asked."""
    kept_rows = rows.loc[~rows["model"].isin(reference_rows())]
    return kept_rows if len(kept_rows) else rows


class StudyResults(Results):
    """A study's results, from the tables of its workspace."""

    source = "this study"
    is_study = True
    # METRICS rows of the pairs; arms enter no table or figure.
    metrics = cached_property(lambda results: _panel_rows(results, results.tables.read_all(METRICS, dataset=DATASETS)))
    cells = cached_property(_cells)
    overall = cached_property(_overall)
    rates = cached_property(_rates)
    sub_cells = cached_property(lambda results: _scoped_metrics(results, "sub_scenario"))
    sub_scenarios = cached_property(_sub_scenarios)
    labels = cached_property(lambda results: analyses.accuracy_by_label(_scoped_metrics(results, "label")))
    composition = cached_property(_composition)
    cosines = cached_property(_cosines)
    effects = cached_property(_effects)

    def __init__(self, workspace: Workspace) -> None:
        super().__init__()
        self.tables, self.mechanism = workspace.tables, workspace.study.mechanism
        self._panel = workspace.study.panel

    @cached_property
    def panel(self) -> str:
        """The panel of all tables and figures: the study's, else the first that decided."""
        judged_rows = self.board if len(self.board) else self.tables.read_all(METRICS, ["panel"], dataset=DATASETS)
        panels = sorted({*judged_rows["panel"]}, key=lambda name: ("+" in name, name))
        own_panel = panel_id(self._panel)
        return own_panel if own_panel in panels or not panels else panels[0]

    @cached_property
    @override
    def certified(self) -> str:
        return certification_note(self.tables)

    @cached_property
    @override
    def judged_by(self) -> str:
        if self.board.empty:
            return ""
        sentence = judged_by(_panel_rows(self, self.board)).rstrip(".")
        other_models = self.board.loc[self.board["panel"] != self.panel, "model"].unique()
        return sentence + (
            f"; left out: {count_noun(len(other_models), 'model')} with metrics of other panels"
            if len(other_models)
            else ""
        )

    def rows(self, table: Table) -> pd.DataFrame:
        """Return all rows of a table of the study."""
        return self.tables.read_all(table)
