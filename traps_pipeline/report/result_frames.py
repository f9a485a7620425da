"""The frames behind tables and figures, for a study or the paper: tidy, with the same columns.

A frame without rows means that its part was not run. Shares are fractions; every frame with figures has a column
`epoch`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from functools import cached_property
from typing import TYPE_CHECKING, Any, ClassVar

from traps_pipeline.judging.judging_rows import AGREEMENT, JUDGE_BIAS, JUDGE_VALIDATION
from traps_pipeline.mechanism import effects
from traps_pipeline.mechanism.control_rows import (
    GATE,
    ITEM_SCORES,
    LENS,
    PATCHING,
    PROBE_BASELINES,
    RISK_COVERAGE,
    SENTENCES,
    STEERING_NULLS,
    STEERING_PECS,
)
from traps_pipeline.mechanism.mechanism_rows import PROBES, STEERING_EFFECTS, STEERING_SHARES
from traps_pipeline.people.human_label_rows import HUMAN_AGREEMENT
from traps_pipeline.people.human_score_rows import CORRECTED, HUMAN_ROW, PANEL_ERRORS
from traps_pipeline.protocol.datasets import DATASETS
from traps_pipeline.protocol.regimes import PROBE_PROMPT
from traps_pipeline.scoring.score_rows import (
    CONFABULATION_PREVALENCE,
    CONTRASTS,
    GRADED_CUTS,
    HYPOTHESES,
    LEADERBOARD,
    LEAVE_ONE_OUT,
    REGIME_TESTS,
    ROBUST,
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


Makers = Mapping[str, Callable[[Any], "pd.DataFrame"]]  # functions of the results, by the name of their frame


class LazyFrame:
    """A lazily computed frame of `Results`: by the maker of its name, by `derive`, or the rows of `table`."""

    def __init__(
        self, doc: str = "", *, table: Table | None = None, derive: Callable[[Results], pd.DataFrame] | None = None
    ) -> None:
        self.__doc__, self.table, self.derive = doc or (f"{table.name.upper()} rows." if table else ""), table, derive

    def __set_name__(self, owner: type[Results], name: str) -> None:
        self.name = name

    def __get__(self, results: Results, owner: type[Results]) -> pd.DataFrame:
        if self.name not in results.made:
            results.made[self.name] = self._make(results)
        return results.made[self.name]

    def _make(self, results: Results) -> pd.DataFrame:
        make = results.makers.get(self.name, self.derive)
        if make is not None:
            return make(results)
        if self.table is None:
            raise NotImplementedError(f"{type(results).__name__} has no maker of {self.name!r}")
        return results.rows(self.table)


class Results:
    """One set of results; a frame has no rows if its part was not run.

    To add a frame, add an attribute here, and a function of that name in the `makers` of the study's and the paper's
    results.
    """

    source = ""  # in words, for titles
    is_study = False
    judged_by = ""  # the judges, in words, for the notes of a study's tables and figures
    makers: ClassVar[Makers] = {}
    mechanism: MechanismSettings | None = None  # of a study with mechanistic analyses

    board = LazyFrame(table=LEADERBOARD)
    cells = LazyFrame("CELL_COLUMNS, one row per (model, dataset, regime), averaged over runs.")
    overall = LazyFrame(
        "One row per (model, regime) that has all four datasets: the columns of cells without dataset, and j; a study's"
        " rows also have j_std, the intervals and ranks of LEADERBOARD. epoch joins the datasets' epochs by +."
    )
    rates = LazyFrame(
        "RATE_COLUMNS: visual and textual AbsRec under standard, one row per model and taxonomy (or pooled)."
    )
    sub_scenarios = LazyFrame("SUB_COLUMNS: means over models, one row per sub-scenario.")
    sub_cells = LazyFrame("One row per (model, dataset, regime) and sub-scenario (column scope).")
    labels = LazyFrame(
        "Mean Acc over models by the control's answer: dataset, sub_scenario, label, acc, n_pairs, n_models."
    )
    agreement = LazyFrame(table=AGREEMENT)
    bias = LazyFrame(table=JUDGE_BIAS)
    leave_one_out = LazyFrame(table=LEAVE_ONE_OUT)
    robust = LazyFrame(table=ROBUST)
    hypotheses = LazyFrame(table=HYPOTHESES)
    graded = LazyFrame(table=GRADED_CUTS)
    contrasts = LazyFrame(table=CONTRASTS)
    regime_tests = LazyFrame(table=REGIME_TESTS)
    confabulation = LazyFrame(table=CONFABULATION_PREVALENCE)
    validation = LazyFrame(table=JUDGE_VALIDATION)
    human_row = LazyFrame(table=HUMAN_ROW)
    human_agreement = LazyFrame(table=HUMAN_AGREEMENT)
    panel_errors = LazyFrame(table=PANEL_ERRORS)
    corrected = LazyFrame(table=CORRECTED)
    composition = LazyFrame("taxonomy, category, void, n (well-posed pairs), n_ill_posed.")
    prompted_probes = LazyFrame("PROBES rows under every prompt.", table=PROBES)
    prompted_baselines = LazyFrame("PROBE_BASELINES rows under every prompt.", table=PROBE_BASELINES)
    probes = LazyFrame(
        "PROBES rows under PROBE_PROMPT; the paper has only transfer, confabulated, shuffled, centroid_void.",
        derive=lambda results: _of_probe_prompt(results.prompted_probes),
    )
    cosines = LazyFrame("COSINES rows at the steered layer of each model.")
    effects = LazyFrame(
        "STEERING_EFFECTS rows of the paper's protocol: void directions, doses in alpha, signs by label."
    )
    baselines = LazyFrame(
        "PROBE_BASELINES rows under PROBE_PROMPT.", derive=lambda results: _of_probe_prompt(results.prompted_baselines)
    )
    gate = LazyFrame(table=GATE)
    risk_coverage = LazyFrame(table=RISK_COVERAGE)
    patching = LazyFrame(table=PATCHING)
    own_effects = LazyFrame(
        "STEERING_EFFECTS rows of datasets along their own directions and nulls, and `gaps`, the dose.",
        derive=lambda results: effects.own_effects(results.rows(STEERING_EFFECTS)),
    )
    nulls = LazyFrame(table=STEERING_NULLS)
    steering_pecs = LazyFrame(table=STEERING_PECS)
    shares = LazyFrame(table=STEERING_SHARES)
    steering_regimes = LazyFrame(
        "Rows of `mechanism.effects.regime_matrix`.", derive=lambda results: effects.regime_matrix(results.effects)
    )
    lens = LazyFrame(table=LENS)
    sentences = LazyFrame(table=SENTENCES)
    item_scores = LazyFrame("ITEM_SCORES rows under PROBE_PROMPT.", table=ITEM_SCORES)
    steering_families = LazyFrame(
        "Rows of `mechanism.effects.family_asymmetry`.",
        derive=lambda results: effects.family_asymmetry(results.effects),
    )
    steering_domains = LazyFrame(
        "Rows of `mechanism.effects.domains`.", derive=lambda results: effects.domains(results.effects)
    )
    steering_layers = LazyFrame(
        "Rows of `mechanism.effects.sweep`.", derive=lambda results: effects.sweep(results.effects)
    )

    def __init__(self) -> None:
        self.made: dict[str, pd.DataFrame] = {}
        self.kept: dict[str, list[PrintedTable]] = {}  # cache of the catalogue's tables, by name
        # The reasons, by analysis, why figures were not computed: their sides are of different epochs.
        self.refused: dict[str, list[str]] = {}

    def rows(self, table: Table) -> pd.DataFrame:
        """Return all rows of a table of a study; for the paper, a frame without rows."""
        import pandas as pd

        return pd.DataFrame(columns=pd.Index([column.name for column in table.columns]))

    def refusal(self, dataset: str, left: tuple[str, str], right: tuple[str, str]) -> str | None:
        """Return why two entries (model, regime) may not be compared on a dataset; None if they may."""
        return self._refusals.get((dataset, frozenset((left, right))))

    @cached_property
    def _refusals(self) -> dict[tuple[str, frozenset[tuple[str, str]]], str]:
        rows = self.contrasts.dropna(subset=["refused"]).to_dict("records")
        sides = [frozenset((r[f"{side}_model"], r[f"{side}_regime"]) for side in ("left", "right")) for r in rows]
        return {(row["dataset"], pair): row["refused"] for row, pair in zip(rows, sides, strict=True)}

    def why(self, what: str) -> str:
        """Return the reason, for people, why a frame has no rows."""
        return "; ".join(self.refused.get(what, [])) or (
            "this study has no such results yet" if self.is_study else "the paper prints no such table"
        )


def _of_probe_prompt(rows: pd.DataFrame) -> pd.DataFrame:
    return rows.loc[rows["prompt"] == PROBE_PROMPT]


def datasets_of(cells: pd.DataFrame) -> list[str]:
    """Return the datasets of the cells, in the benchmark's order."""
    names = set(cells["dataset"])
    return [name for name in DATASETS if name in names]


def joined(parts: Iterable[pd.DataFrame]) -> pd.DataFrame:
    """Return the concatenated parts; without parts, a frame without rows or columns."""
    import pandas as pd

    return pd.concat([pd.DataFrame(), *parts], ignore_index=True)
