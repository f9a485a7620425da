"""Catalogue of all tables and figures (docs/spec.md 10).

An entry names the function that builds it from `Results` and the stages that it reads. It decides its asset, its
staleness, and its place on the report page and in `traps results export`. A function's module is imported only when
the function is called, so `traps status` can read all entries without importing them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from importlib import import_module
from typing import TYPE_CHECKING, Any

from traps_pipeline.models.registry.judges import BY_RULES
from traps_pipeline.people.recorded_certificates import UNCERTIFIED

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

    from traps_pipeline.report.result_frames import Results
    from traps_pipeline.report.writing import PrintedTable

RIGHT_EDGE_IN = 0.14  # width for a line of text along the right edge of a figure
PAPER = "published"  # folder below tables/ and figures/
RECOMPUTED = "recomputed"  # folder below tables/ for tables computed from the paper's
# Stages whose tables hold decisions of the panel: reports that read them name the judges. A test compares this
# with the graph.
JUDGED_STAGES = {
    *("leaderboard", "metrics", "contrasts", "regime_tests", "two_way", "hypotheses", "graded", "leave_one_out"),
    *("item_scores", "corrected", "gate"),
    *("steering_effects", "steering_shares", "steering_nulls", "steering_pecs"),
}
CLAIM_STAGES = (
    *("interaction", "two_way"),
    *("leads", "probes", "probe_baselines", "gate", "item_scores", "sentences", "lens", "patching"),
    *("cosines", "steering_effects", "steering_nulls"),
)


@dataclass(frozen=True)
class TableReport:
    """A table of the report, or several that belong together: name, and the function that makes it.

    function: makes it (module.function of `report.tables`); reads: the stages whose tables it uses; paper:
    whether the paper has tables of this kind (`report.printed_tables`); recomputed: the names of its tables that `make`
    also computes from the paper's tables, since the paper does not print their figures.
    """

    name: str
    function: str
    reads: tuple[str, ...]
    paper: bool = False
    recomputed: tuple[str, ...] = ()
    title: str = ""  # title of several tables together; default: the first one's

    @property
    def make(self) -> Callable[[Results], list[PrintedTable]]:
        """The function that makes the table from results."""
        return _function(f"tables.{self.function}")

    @property
    def doc(self) -> str:
        """The table's caption: the docstring of its function."""
        return _caption(self.make)

    @property
    def published(self) -> bool:
        """Whether the paper prints this table, or numbers from which it is recomputed."""
        return self.paper or bool(self.recomputed)

    def tables(self, results: Results) -> list[PrintedTable]:
        """Return a study's tables, cached; of the paper, those recomputed from it, without empty columns."""
        if self.name not in results.kept:
            results.kept[self.name] = self._tables(results)
        return results.kept[self.name]

    def _tables(self, results: Results) -> list[PrintedTable]:
        from traps_pipeline.report.tables.table_columns import printed_columns

        if not results.is_study and not self.recomputed:
            return []
        remarks = [results.certified, *([results.judged_by] if _is_judged(self.reads) else [])]
        with_columns = ((t, printed_columns(results, t.rows, t.columns)) for t in self.make(results))
        tables = [replace(table, columns=columns, notes=[*remarks, *table.notes]) for table, columns in with_columns]
        return [table for table in tables if results.is_study or table.name in self.recomputed]

    def as_printed(self) -> list[PrintedTable]:
        """Return the paper's tables as it prints them, and a table of numbers that only its text states."""
        from traps_pipeline.report.printed_tables import paper_tables

        return paper_tables(self.name)

    def files(self, results: Results) -> dict[str, bytes]:
        """Return the tables' files, content by path; the paper's are in `tables/published` and `recomputed`."""
        from traps_pipeline.report.writing import table_files

        if results.is_study:
            parts = {"tables": self.tables(results)}
        else:
            parts = {f"tables/{PAPER}": self.as_printed(), f"tables/{RECOMPUTED}": self.tables(results)}
        folder_files = [
            (folder, file) for folder, tables in parts.items() for t in tables for file in table_files(t).items()
        ]
        return {f"{folder}/{name}": content for folder, (name, content) in folder_files}


@dataclass(frozen=True)
class FigureReport:
    """A figure of the report: its name, title and the function that draws it.

    reads: the stages whose tables it uses; published: whether the paper prints its numbers.
    frames: the frames of `Results` that it draws, if it is to be drawn again only when these change.
    """

    name: str
    title: str
    function: str
    reads: tuple[str, ...]
    published: bool = True
    has_finding: bool = False
    frames: tuple[str, ...] = ()

    @property
    def make(self) -> Callable[[Results], Figure]:
        """The function that draws the figure from results."""
        return _function(f"figures.{self.function}")

    @property
    def doc(self) -> str:
        """The figure's caption: the docstring of its function."""
        return _caption(self.make)

    def finding(self, results: Results) -> str:
        """Return one sentence per model about a study; empty if the figure has none."""
        return _function(f"findings.{self.name}")(results) if self.has_finding else ""

    def note(self, results: Results) -> str:
        """Return the finding about a study (one sentence per model) and the caption."""
        return f"{self.finding(results)} {self.doc}".strip()

    def inputs(self, results: Results) -> list[str]:
        """Return as texts all that the figure depends on: its frames' rows, refusals, judges, certificates."""
        frames: list[pd.DataFrame] = [getattr(results, name) for name in self.frames]
        said = [repr(results.refused), results.judged_by, results.certified]
        return [repr(rows.to_dict("split")) for rows in frames] + said

    def files(self, results: Results) -> dict[str, bytes]:
        """Return the figure as PDF, SVG and PNG files, content by path; empty if its data were not computed."""
        from traps_pipeline.report.writing import NotRun, figure_files

        try:
            files = figure_files(self.name, self.figure(results))
        except NotRun:
            return {}
        return {f"{folder('figures', results)}/{name}": content for name, content in files.items()}

    def figure(self, results: Results) -> Figure:
        """Return the figure, with a note if rules judged, or people certify no pairs. Raises NotRun without data."""
        figure = self.make(results)
        is_by_rules = BY_RULES in results.judged_by.lower() and _is_judged(self.reads)
        said = [BY_RULES] * is_by_rules + [UNCERTIFIED] * results.certified.startswith(UNCERTIFIED)
        if said:
            _say_below(figure, "\n".join(said))
        return figure


TABLE_REPORTS: tuple[TableReport, ...] = (
    TableReport("overall", "leaderboards.overall", ("leaderboard",), paper=True, recomputed=("overall",)),
    TableReport("replication_overall", "leaderboards.replication_overall", ("leaderboard",),
        paper=True, recomputed=("replication_overall",)),
    TableReport("per_dataset", "leaderboards.per_dataset", ("leaderboard",), paper=True),
    TableReport("expanded", "leaderboards.expanded", ("leaderboard",), paper=True,
        title="By dataset and regime"),
    TableReport("replication_per_dataset", "leaderboards.replication_per_dataset", ("leaderboard",),
        paper=True),
    TableReport("guided_uplift", "comparisons.uplift", ("leaderboard", "contrasts"),
        recomputed=("guided_uplift",)),
    TableReport("visual_textual", "comparisons.visual_textual", ("leaderboard",), paper=True,
        recomputed=("visual_textual",)),
    TableReport("reasoning_pairs", "comparisons.reasoning", ("leaderboard", "contrasts"),
        recomputed=("reasoning_pairs",)),
    TableReport("frontier", "comparisons.frontier", ("leaderboard",), recomputed=("frontier",)),
    TableReport("pecs_naive", "comparisons.naive", ("leaderboard",), paper=True, recomputed=("pecs_naive",)),
    TableReport("zero_boundary", "comparisons.zero_boundary", ("leaderboard",),
        recomputed=("zero_boundary",)),
    TableReport("contrasts", "comparisons.contrasts", ("leaderboard", "contrasts")),
    TableReport("regime_tests", "comparisons.regime_tests", ("regime_tests",)),
    TableReport("run_spread", "comparisons.spreads", ("leaderboard",), recomputed=("run_spread",)),
    TableReport("degenerate_strategies", "comparisons.degenerate", ("leaderboard",), paper=True),
    TableReport("occlusion_sub_scenarios", "sub_scenarios.occlusion_sub_scenarios", ("metrics", "items"),
        paper=True, recomputed=("occlusion_sub_scenarios", "hidden_sub_scenarios")),
    TableReport("chaotic_sub_scenarios", "sub_scenarios.chaotic_sub_scenarios", ("metrics", "items"),
        paper=True, recomputed=("chaotic_sub_scenarios",)),
    TableReport("two_way", "two_way_table.two_way", ("two_way",)),
    TableReport("hypotheses", "hypothesis_tables.hypotheses", ("hypotheses",),
        title="Hypotheses of the paper, by dose"),
    TableReport("graded", "graded_tables.graded", ("graded",)),
    TableReport("judge_agreement", "judge_tables.agreement", ("agreement",), paper=True),
    TableReport("judge_bias", "judge_tables.judge_bias", ("judge_bias", "leave_one_out")),
    TableReport("confabulation", "judge_tables.confabulation", ("confabulation_prevalence",),
        paper=True),
    TableReport("people", "human_tables.people", ("human_row", "human_agreement"), title="People"),
    TableReport("judge_corrected", "human_tables.judge_corrected", ("panel_errors", "corrected"),
        title="Corrected for judges’ errors"),
    TableReport("judge_validation", "judge_tables.validation", ("judge_validation",), paper=True),
    TableReport("claims", "claims.claims", CLAIM_STAGES, title="What is claimed of a model"),
    TableReport("probes", "probe_tables.probes", ("probes", "probe_baselines"), paper=True,
        recomputed=("probe_means",), title="Probes"),
    TableReport("gate", "control_reports.gate", ("gate",)),
    TableReport("patching", "patching_tables.patching", ("patching",)),
    TableReport("cosines", "steering_tables.cosines", ("cosines",), paper=True,
        title="Void directions"),
    TableReport("steering", "steering_tables.steering", ("steering_effects", "steering_shares"),
        paper=True, recomputed=("steering_regimes",), title="Steering"),
    TableReport("steering_controls", "control_reports.steering_nulls", ("steering_nulls", "steering_pecs"),
        title="Steering among its controls"),
    TableReport("composition", "setup_tables.composition", ("items",), paper=True),
    TableReport("leaks", "setup_tables.leaks", ("items",), title="What gives recorded voids away"),
    TableReport("models", "setup_tables.models", ("leaderboard",), paper=True),
    TableReport("hyperparameters", "setup_tables.hyperparameters", ("leaderboard", "judge_bias"),
        paper=True),
)  # fmt: skip
FIGURE_REPORTS: tuple[FigureReport, ...] = (
    FigureReport("pecs_landscape", "PECS landscape", "landscape.landscape", ("leaderboard",),
        frames=("overall", "cells")),
    FigureReport("visual_textual", "Visual against textual voids", "abstention.visual_textual", ("leaderboard",),
        frames=("rates",)),
    FigureReport("abs_rec", "AbsRec, standard and guided", "abstention.abs_rec_by_model", ("leaderboard",),
        frames=("overall", "cells")),
    FigureReport("reasoning_arrows", "Reasoning in PECS space", "landscape.reasoning", ("leaderboard",),
        frames=("overall",)),
    FigureReport("doubt_conversion", "Doubt and conversion", "abstention.doubt",
        ("leaderboard", "confabulation_prevalence"), frames=("rates", "confabulation")),
    FigureReport("sub_scenarios", "AbsRec by sub-scenario", "grids.sub_scenarios", ("metrics", "items"),
        frames=("visual_sub_scenarios", "visual_sub_cells")),
    FigureReport("two_way", "Two events, one of them hidden", "two_way_figure.two_way", ("two_way",), published=False,
        frames=("two_way",)),
    FigureReport("graded", "Graded cuts", "graded_figure.graded", ("graded",), published=False),
    FigureReport("confabulation", "Prevalence of confabulation", "grids.confabulation", ("confabulation_prevalence",)),
    FigureReport("claims", "What is claimed of a model", "expression_figures.claims", CLAIM_STAGES, published=False,
        has_finding=True),
    FigureReport("leads", "States among their rivals", "expression_figures.leads", ("leads",), published=False,
        has_finding=True),
    FigureReport("lens", "The margin by layer", "expression_figures.lens", ("lens",), published=False),
    FigureReport("patching", "Activation patching", "control_figures.patching", ("patching",), published=False,
        has_finding=True),
    FigureReport("confabulated_strip", "Probes on confabulated voids", "steering_figures.confabulated_strip",
        ("probes",)),
    FigureReport("dose_response", "Steering: dose and response", "steering_figures.dose_response",
        ("steering_effects", "steering_shares")),
    FigureReport("cosines", "Cosines of void directions", "steering_figures.cosine_heatmaps", ("cosines",)),
)  # fmt: skip

# Leading figures of a study with mechanistic analyses: the claim, and its possible refutations.
INSIDE = ("claims", "leads", "lens", "patching")


def folder(kind: str, results: Results) -> str:
    """Return a kind's folder, `tables` or `figures`; the paper's is a subfolder of it."""
    return kind if results.is_study else f"{kind}/{PAPER}"


def _say_below(figure: Figure, text: str) -> None:
    """Write lines at a figure's foot, or above its legend's keys; along its right edge if nothing may move."""
    from traps_pipeline.report.writing import SOFT, figure_style

    look: dict[str, Any] = {"fontsize": 6, "color": SOFT, "parse_math": False}
    with figure_style():
        if figure.get_layout_engine() is None:
            figure.text(0.995, 0.5, text, rotation=90, ha="right", va="center", **look)
        elif figure.legends:
            caption = figure.legends[0].get_title().get_text()
            figure.legends[0].set_title(f"{caption}\n{text}".strip())
        else:
            figure.supxlabel(text, x=0.99, ha="right", **look)


def _function(name: str) -> Callable[..., Any]:
    """Return a function of this room by the name of its module and its own."""
    module, _, function = name.rpartition(".")
    return getattr(import_module(f"traps_pipeline.report.{module}"), function)


def _is_judged(reads: Sequence[str]) -> bool:
    """Return whether a report shows decisions of a panel, by the stages that it reads."""
    return bool({*reads} & JUDGED_STAGES)


def _caption(make: Callable[..., object]) -> str:
    """Return a docstring as a caption, without the verb `Return`."""
    text = " ".join((make.__doc__ or "").split()).removeprefix("Return ")
    return text[:1].upper() + text[1:]
