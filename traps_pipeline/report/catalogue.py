"""Every table and figure by name: the function that makes it from `Results`, and the stages it reads (docs/spec.md 10).

A new table or figure is an entry here. Its asset, its staleness and its place on the report page and in `traps export`
follow from the entry.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from traps_pipeline.report.figures import abstention, grids, landscape, mechanism
from traps_pipeline.report.figures import inside as figures_of_inside
from traps_pipeline.report.results import Results
from traps_pipeline.report.tables import comparisons, inside, judges, leaderboards, setup, sub_scenarios
from traps_pipeline.report.tables import mechanism as tables_of_mechanism
from traps_pipeline.report.tables.shared import printed
from traps_pipeline.report.writing import PrintedTable, figure_bytes, figure_files, table_files

if TYPE_CHECKING:
    from matplotlib.figure import Figure

PAPER = "published"  # folder below tables/ and figures/


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
        return [replace(t, columns=printed(results, t.rows, t.columns)) for t in self.make(results)]

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
        return {self.path(results): figure_bytes(self.make(results))}

    def files(self, results: Results) -> dict[str, bytes]:
        """PDF, SVG and PNG by path."""
        files = figure_files(self.name, self.make(results))
        return {f"{folder('figures', results)}/{name}": content for name, content in files.items()}


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
    TableReport(
        "probe_baselines",
        inside.probe_baselines,
        ("probes", "probe_baselines"),
        published=False,
        title="Probes and their baselines",
    ),
    TableReport("gate", inside.gate, ("gate",), published=False, title="Probe-gated abstention"),
    TableReport("patching", inside.patching, ("patching",), published=False),
    TableReport("cosines", tables_of_mechanism.cosines, ("cosines",), title="Void directions"),
    TableReport("steering", tables_of_mechanism.steering, ("steering_effects", "steering_shares"), title="Steering"),
    TableReport(
        "steering_controls",
        inside.steering_nulls,
        ("steering_nulls", "steering_pecs"),
        published=False,
        title="Steering among its controls",
    ),
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
    FigureReport(
        "probe_baselines",
        "Probes against their baselines",
        figures_of_inside.probe_baselines,
        ("probes", "probe_baselines"),
        published=False,
    ),
    FigureReport(
        "gate_arrows",
        "Probe-gated abstention",
        figures_of_inside.gate_arrows,
        ("gate", "risk_coverage"),
        published=False,
    ),
    FigureReport("patching", "Activation patching", figures_of_inside.patching, ("patching",), published=False),
    FigureReport(
        "doses_among_nulls",
        "Doses among nulls",
        figures_of_inside.doses_among_nulls,
        ("steering_effects",),
        published=False,
    ),
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

INSIDE = ("probe_baselines", "gate_arrows", "patching", "doses_among_nulls")  # figures of controls inside models

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


def _first_paragraph(make: Callable[..., object]) -> str:
    return " ".join((make.__doc__ or "").split("\n\n")[0].split())
