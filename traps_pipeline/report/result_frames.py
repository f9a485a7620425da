"""Prepare the frames behind tables and figures, for a study or the paper.

A frame without rows means that its part was not run. Shares are fractions; every frame with metrics has a column
`epoch`.
"""

from __future__ import annotations

from collections.abc import Iterable
from functools import cached_property
from typing import TYPE_CHECKING

from traps_pipeline.judging.judging_rows import AGREEMENT, JUDGE_BIAS, JUDGE_VALIDATION
from traps_pipeline.mechanism import effects
from traps_pipeline.mechanism.control_rows import (
    GATE,
    INTERACTION,
    ITEM_SCORES,
    LEADS,
    LENS,
    PATCHING,
    PROBE_BASELINES,
    SENTENCES,
    STEERING_NULLS,
    STEERING_PECS,
)
from traps_pipeline.mechanism.mechanism_rows import COSINES, PROBES, STEERING_EFFECTS, STEERING_SHARES
from traps_pipeline.people.human_label_rows import HUMAN_AGREEMENT
from traps_pipeline.people.human_score_rows import CORRECTED, HUMAN_ROW, PANEL_ERRORS
from traps_pipeline.protocol.datasets import DATASETS
from traps_pipeline.protocol.regimes import PROBE_PROMPT
from traps_pipeline.scoring.analyses import TAXONOMIES
from traps_pipeline.scoring.score_rows import (
    CONFABULATION_PREVALENCE,
    CONTRASTS,
    GRADED_CUTS,
    HYPOTHESES,
    LEADERBOARD,
    LEAVE_ONE_OUT,
    REGIME_TESTS,
    TWO_WAY,
)
from traps_pipeline.storage.study import MechanismSettings
from traps_pipeline.storage.tables import Table

if TYPE_CHECKING:
    import pandas as pd

    from traps_pipeline.report.writing import PrintedTable

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
TEXTUAL_COLUMNS = ("ill_posed_n_models", "abs_rec_ill_posed", "textual_over_visual", "n_missing")


def no_rows(columns: Iterable[str]) -> cached_property[pd.DataFrame]:
    """Return an attribute that holds a frame with these columns and without rows."""
    return cached_property(lambda results: _empty_frame(columns))


def table_frame(table: Table) -> cached_property[pd.DataFrame]:
    """Return an attribute that holds a table's rows as a frame, read when it is first used."""
    return cached_property(lambda results: results.rows(table))


class Results:
    """The results of a study or of the paper, as frames; a frame has no rows if its part was not run.

    A new frame is an attribute here, made when first read; kinds of results that have it override `no_rows`.
    """

    source = ""  # in words, for titles
    is_study = False
    judged_by = ""  # who judged, in words, for the notes of a study's tables and figures
    certified = ""  # how many recorded pairs people certify, for the notes of its tables
    mechanism: MechanismSettings | None = None  # of a study that looks inside models

    board = table_frame(LEADERBOARD)
    cells = no_rows(CELL_COLUMNS)  # one row per (model, dataset, regime), averaged over runs
    # One row per (model, regime) that has all four datasets. A study's rows also have j_std, the intervals and ranks of
    # LEADERBOARD. epoch joins the datasets' epochs by +.
    overall = no_rows([*(name for name in CELL_COLUMNS if name != "dataset"), "j"])
    rates = no_rows(RATE_COLUMNS)  # visual and textual AbsRec under standard, by model and taxonomy (or pooled)
    sub_scenarios = no_rows(SUB_COLUMNS)  # means over models, one row per sub-scenario
    # One row per (model, dataset, regime) and sub-scenario (column scope).
    sub_cells = no_rows(["model", "dataset", "regime", "scope", "abs_rec", "n_pairs"])
    # Both without what ill-posed questions decide: a correction of one need not draw the heatmaps again.
    visual_sub_scenarios = cached_property(lambda results: results.sub_scenarios.drop(columns=[*TEXTUAL_COLUMNS]))
    visual_sub_cells = cached_property(
        lambda results: results.sub_cells.loc[results.sub_cells["dataset"].isin(TAXONOMIES)]
    )
    labels = no_rows(["dataset", "sub_scenario", "label", "acc"])  # mean Acc over models by the control's answer
    agreement = table_frame(AGREEMENT)
    bias = table_frame(JUDGE_BIAS)
    leave_one_out = table_frame(LEAVE_ONE_OUT)
    two_way = table_frame(TWO_WAY)
    hypotheses = table_frame(HYPOTHESES)
    graded = table_frame(GRADED_CUTS)
    contrasts = table_frame(CONTRASTS)
    regime_tests = table_frame(REGIME_TESTS)
    confabulation = table_frame(CONFABULATION_PREVALENCE)
    validation = table_frame(JUDGE_VALIDATION)
    human_row = table_frame(HUMAN_ROW)
    human_agreement = table_frame(HUMAN_AGREEMENT)
    panel_errors = table_frame(PANEL_ERRORS)
    corrected = table_frame(CORRECTED)
    composition = no_rows(["taxonomy", "category", "void", "n", "n_ill_posed"])  # n: well-posed pairs
    prompted_probes = table_frame(PROBES)  # under every prompt
    # PROBES rows under PROBE_PROMPT; the paper has only transfer, confabulated, shuffled, centroid_void.
    probes = cached_property(
        lambda results: results.prompted_probes.loc[results.prompted_probes["prompt"] == PROBE_PROMPT]
    )
    cosines = no_rows(COSINES.names)  # at the steered layer of each model
    effects = no_rows(STEERING_EFFECTS.names)  # of void directions, doses in alpha, signs by label
    baselines = table_frame(PROBE_BASELINES)  # under PROBE_PROMPT alone
    gate = table_frame(GATE)
    patching = table_frame(PATCHING)
    nulls = table_frame(STEERING_NULLS)
    steering_pecs = table_frame(STEERING_PECS)
    shares = table_frame(STEERING_SHARES)
    steering_regimes = cached_property(lambda results: effects.regime_matrix(results.effects))
    leads = table_frame(LEADS)
    interaction = table_frame(INTERACTION)
    lens = table_frame(LENS)
    sentences = table_frame(SENTENCES)
    item_scores = table_frame(ITEM_SCORES)  # under PROBE_PROMPT alone
    steering_families = cached_property(lambda results: effects.family_asymmetry(results.effects))
    steering_domains = cached_property(lambda results: effects.domains(results.effects))
    steering_layers = cached_property(lambda results: effects.sweep(results.effects))

    def __init__(self) -> None:
        self.kept: dict[str, list[PrintedTable]] = {}  # the tables of the catalogue that were made of them, by name
        # The reasons, by analysis, why metrics were not computed: their sides are of different epochs.
        self.refused: dict[str, list[str]] = {}

    def rows(self, table: Table) -> pd.DataFrame:
        """Return all rows of a study's table as a frame; for the paper, a frame without rows."""
        return _empty_frame(table.names)

    def refusal(self, dataset: str, left: tuple[str, str], right: tuple[str, str]) -> str | None:
        """Return why two entries (model, regime) are not comparable on a dataset, or None."""
        return self._refusals.get((dataset, frozenset((left, right))))

    @cached_property
    def _refusals(self) -> dict[tuple[str, frozenset[tuple[str, str]]], str]:
        rows = self.contrasts.dropna(subset=["refused"]).to_dict("records")
        sides = [frozenset((r[f"{side}_model"], r[f"{side}_regime"]) for side in ("left", "right")) for r in rows]
        return {(row["dataset"], pair): row["refused"] for row, pair in zip(rows, sides, strict=True)}

    def why(self, what: str) -> str:
        """Return in words why a frame of these results has no rows."""
        return "; ".join(self.refused.get(what, [])) or (
            "this study has no such results yet" if self.is_study else "the paper prints no such table"
        )


def _empty_frame(columns: Iterable[str]) -> pd.DataFrame:
    import pandas as pd

    return pd.DataFrame(columns=pd.Index([*columns]))


def datasets_of(cells: pd.DataFrame) -> list[str]:
    """Return the names of the datasets in the cells (rows of model, dataset, regime), in the benchmark's order."""
    names = set(cells["dataset"])
    return [name for name in DATASETS if name in names]


def concat_frames(parts: Iterable[pd.DataFrame]) -> pd.DataFrame:
    """Return one frame of all rows of the parts; without parts, a frame without rows or columns."""
    import pandas as pd

    return pd.concat([pd.DataFrame(), *parts], ignore_index=True)
