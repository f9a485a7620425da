"""Every table and figure by name: the function that makes it from `Results`, and the stages it reads (docs/spec.md 10).

A new table or figure is an entry here. Its asset, its staleness and its place on the report page and in `traps export`
follow from the entry.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

from traps_pipeline.models.judges import BY_RULES
from traps_pipeline.report.figures import abstention, grids, landscape, mechanism
from traps_pipeline.report.results import Results
from traps_pipeline.report.tables import comparisons, judges, leaderboards, setup, sub_scenarios
from traps_pipeline.report.tables import mechanism as tables_of_mechanism
from traps_pipeline.report.tables.shared import printed
from traps_pipeline.report.writing import SOFT, PrintedTable, figure_bytes, figure_files, figure_style, table_files

if TYPE_CHECKING:
    from matplotlib.figure import Figure

PAPER = "published"  # folder below tables/ and figures/
JUDGED_STAGES = {"leaderboard", "metrics", "contrasts", "regime_tests", "steering_effects", "steering_shares"}


@dataclass(frozen=True)
class TableReport:
    """A table (or several that belong together). reads: the stages whose tables it is made from; published: whether the
    paper prints such a table."""

    name: str
    make: Callable[[Results], list[PrintedTable]]
    reads: tuple[str, ...]
    published: bool = True
    title: str = ""  # of several tables together; by default the title of the first one

    @property
    def doc(self) -> str:
        """What it shows."""
        return _first_paragraph(self.make)

    def tables(self, results: Results) -> list[PrintedTable]:
        """The tables; those of the paper's numbers without the columns that the paper does not print."""
        said = [results.judged_by] if _is_judged(self.reads) else []
        shown = ((table, printed(results, table.rows, table.columns)) for table in self.make(results))
        return [replace(table, columns=columns, notes=[*said, *table.notes]) for table, columns in shown]

    def files(self, results: Results) -> dict[str, bytes]:
        """Files by path: `tables/name.csv` and so on, for the paper's numbers in `tables/published`."""
        made = [file for table in self.tables(results) for file in table_files(table).items()]
        return {f"{folder('tables', results)}/{name}": content for name, content in made}


@dataclass(frozen=True)
class FigureReport:
    """A figure. reads: the stages whose tables it is made from; published: whether the paper prints its numbers."""

    name: str
    title: str
    make: Callable[[Results], Figure]
    reads: tuple[str, ...]
    published: bool = True

    @property
    def doc(self) -> str:
        """What it shows."""
        return _first_paragraph(self.make)

    def path(self, results: Results) -> str:
        """Path of its PNG."""
        return f"{folder('figures', results)}/{self.name}.png"

    def picture(self, results: Results) -> dict[str, bytes]:
        """The PNG alone, by path, for the page and for Dagster."""
        return {self.path(results): figure_bytes(self._figure(results))}

    def files(self, results: Results) -> dict[str, bytes]:
        """PDF, SVG and PNG by path."""
        files = figure_files(self.name, self._figure(results))
        return {f"{folder('figures', results)}/{name}": content for name, content in files.items()}

    def _figure(self, results: Results) -> Figure:
        """The figure; where its numbers are not comparable it says so itself, since pictures lose their captions."""
        figure = self.make(results)
        if BY_RULES in results.judged_by.lower() and _is_judged(self.reads):
            _say_below(figure, BY_RULES)
        return figure


Report = TableReport | FigureReport

TABLES: tuple[TableReport, ...] = (
    TableReport("overall", leaderboards.overall, ("leaderboard",)),
    TableReport("replication_overall", leaderboards.replication_overall, ("leaderboard",)),
    TableReport("per_dataset", leaderboards.per_dataset, ("leaderboard",)),
    TableReport("expanded", leaderboards.expanded, ("leaderboard",), title="By dataset and regime"),
    TableReport("replication_per_dataset", leaderboards.replication_per_dataset, ("leaderboard",)),
    TableReport("guided_uplift", comparisons.uplift, ("leaderboard", "contrasts")),
    TableReport("visual_textual", comparisons.visual_textual, ("leaderboard",)),
    TableReport("reasoning_pairs", comparisons.reasoning, ("leaderboard", "contrasts")),
    TableReport("frontier", comparisons.frontier, ("leaderboard",)),
    TableReport("pecs_naive", comparisons.naive, ("leaderboard",)),
    TableReport("zero_boundary", comparisons.zero_boundary, ("leaderboard",)),
    TableReport("contrasts", comparisons.contrasts, ("leaderboard", "contrasts"), published=False),
    TableReport("regime_tests", comparisons.regime_tests, ("regime_tests",), published=False),
    TableReport("run_spread", comparisons.spreads, ("leaderboard",)),
    TableReport("degenerate_strategies", comparisons.degenerate, ("leaderboard",), published=False),
    TableReport("occlusion_sub_scenarios", sub_scenarios.occlusion_sub_scenarios, ("metrics", "items")),
    TableReport("chaotic_sub_scenarios", sub_scenarios.chaotic_sub_scenarios, ("metrics", "items")),
    TableReport("judge_agreement", judges.agreement, ("agreement",)),
    TableReport("judge_bias", judges.judge_bias, ("judge_bias", "leave_one_out"), published=False),
    TableReport("confabulation", judges.confabulation, ("confabulation_prevalence",)),
    TableReport("judge_validation", judges.validation, ("judge_validation",)),
    TableReport("probes", tables_of_mechanism.probes, ("probes",), title="Probes"),
    TableReport("cosines", tables_of_mechanism.cosines, ("cosines",), title="Void directions"),
    TableReport("steering", tables_of_mechanism.steering, ("steering_effects", "steering_shares"), title="Steering"),
    TableReport("composition", setup.composition, ("items",)),
    TableReport("models", setup.models, ("leaderboard",)),
    TableReport("hyperparameters", setup.hyperparameters, ("leaderboard", "judge_bias")),
)
FIGURES: tuple[FigureReport, ...] = (
    FigureReport("pecs_landscape", "PECS landscape", landscape.landscape, ("leaderboard",)),
    FigureReport("visual_textual", "Visual against textual voids", abstention.visual_textual, ("leaderboard",)),
    FigureReport("abs_rec", "AbsRec, standard and guided", abstention.abs_rec_by_model, ("leaderboard",)),
    FigureReport("reasoning_arrows", "Reasoning in PECS space", landscape.reasoning, ("leaderboard",)),
    FigureReport(
        "doubt_conversion", "Doubt and conversion", abstention.doubt, ("leaderboard", "confabulation_prevalence")
    ),
    FigureReport("sub_scenarios", "AbsRec by sub-scenario", grids.sub_scenarios, ("metrics", "items")),
    FigureReport("confabulation", "Prevalence of confabulation", grids.confabulation, ("confabulation_prevalence",)),
    FigureReport("probe_curves", "Probe transfer by layer", mechanism.probe_curves, ("probes",), published=False),
    FigureReport("confabulated_strip", "Probes on confabulated voids", mechanism.confabulated_strip, ("probes",)),
    FigureReport(
        "dose_response",
        "Steering: dose and response",
        mechanism.dose_response,
        ("steering_effects", "steering_shares"),
    ),
    FigureReport("cosines", "Cosines of void directions", mechanism.cosine_heatmaps, ("cosines",)),
)

# Assets by name. A study has one for each table or figure; the paper's numbers change together, so they have one asset
# for all tables and one for all figures.
OF_STUDY: Mapping[str, Report] = {
    **{f"table_{report.name}": report for report in TABLES},
    **{f"figure_{report.name}": report for report in FIGURES},
}
OF_PAPER: Mapping[str, Sequence[Report]] = {
    "published_tables": [report for report in TABLES if report.published],
    "published_figures": [report for report in FIGURES if report.published],
}
PRINTED: Sequence[str] = (*OF_STUDY, *OF_PAPER)


def folder(kind: str, results: Results) -> str:
    """The folder of a kind, `tables` or `figures`; the paper's files are in a folder below it."""
    return kind if results.is_study else f"{kind}/{PAPER}"


def workspace_files(report: Report, results: Results) -> dict[str, bytes]:
    """The files that a workspace keeps: all files of a table, the PNG of a figure; `traps export` writes the rest."""
    return report.files(results) if isinstance(report, TableReport) else report.picture(results)


def _say_below(figure: Figure, text: str) -> None:
    """Write a line at the foot of a figure, or along its right edge where its layout is frozen and the foot is full."""
    look: dict[str, Any] = {"fontsize": 6, "color": SOFT, "parse_math": False}
    with figure_style():
        if figure.get_layout_engine() is not None:
            figure.supxlabel(text, x=0.99, ha="right", **look)
        else:
            figure.text(0.995, 0.5, text, rotation=90, ha="right", va="center", **look)


def _is_judged(reads: Sequence[str]) -> bool:
    """Whether a report shows numbers that a panel decided, by the stages that it reads."""
    return bool({*reads} & JUDGED_STAGES)


def _first_paragraph(make: Callable[..., object]) -> str:
    return " ".join((make.__doc__ or "").split("\n\n")[0].split())
