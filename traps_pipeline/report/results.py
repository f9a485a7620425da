"""What tables and figures are made from, whosesoever the results are: tidy frames with the same columns.

A frame without rows means that this was not run. Shares are fractions; every frame with figures has a column `epoch`.
"""

from __future__ import annotations

from collections.abc import Iterable
from functools import cached_property

import pandas as pd

from traps_pipeline.mechanism import effects
from traps_pipeline.partitions import DATASETS
from traps_pipeline.scoring import Frame

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


def datasets_of(cells: Frame) -> list[str]:
    """The datasets that cells are of, in the benchmark's order."""
    there = set(cells["dataset"])
    return [name for name in DATASETS if name in there]


def joined(parts: Iterable[Frame]) -> Frame:
    """One below the other; a frame without rows or columns where there are none."""
    return pd.concat([pd.DataFrame(), *parts], ignore_index=True)
