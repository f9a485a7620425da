"""Tabulate analyses of cells (docs/spec.md 5.4): uplifts, frontier, contrasts."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from traps_pipeline.models.registry.entries import load_models
from traps_pipeline.protocol.datasets import DATASETS
from traps_pipeline.protocol.regimes import GUIDED, PROMPTING, REGIMES
from traps_pipeline.report.result_frames import Results
from traps_pipeline.report.tables.table_columns import (
    COUNT_COLUMNS,
    COUNTED,
    DATASET,
    EPOCH,
    MODEL,
    PECS,
    REGIME,
    SHARE_COLUMNS,
    J,
    cell_trace,
    combined_counts,
    entries,
    epochs,
    frame,
    mark_notes,
    no_overall,
    rightly_empty,
    sort_rows,
    with_counts,
    with_marks,
    with_titles,
)
from traps_pipeline.report.terms import SIDE_OF
from traps_pipeline.report.writing import Column, PrintedTable, SourceItems, Trace
from traps_pipeline.scoring import analyses
from traps_pipeline.scoring.epochs import EpochMismatch

if TYPE_CHECKING:
    import pandas as pd

NAIVE_THRESHOLD = 0.03


def visual_textual(results: Results) -> list[PrintedTable]:
    """Return standard AbsRec on visual and ill-posed voids and its ratio by taxonomy."""
    rates = with_marks(results.rates)
    rows = rates.drop_duplicates("model", keep="last").loc[
        :, ["model", *COUNTED, "mark"]
    ]  # the pooled row is a model's last
    columns = [MODEL]
    for taxonomy in (*analyses.TAXONOMIES, "pooled"):
        names = {kind: f"{taxonomy}_{kind}" for kind in ("visual", "textual", "gap", "epoch", "mark")}
        part = rates.loc[rates["taxonomy"] == taxonomy, ["model", *names]].rename(columns=names)
        rows = rows.merge(part, on="model", how="left")
        word = taxonomy.capitalize()
        columns += [
            Column(names["visual"], f"{word} visual %", "percent"),
            Column(names["textual"], f"{word} textual %", "percent"),
            Column(names["gap"], f"{word} gap", "ratio", mark=names["mark"]),
        ]
    columns += COUNT_COLUMNS
    notes = [
        epochs(rates.assign(dataset=rates["model"])),
        "AbsRec under standard; gap: textual over visual, ∞ where only the visual is 0",
        "pooled: means over both taxonomies, and their ratio",
        *mark_notes(rates),
        *([] if results.is_study else ["gaps of the printed, rounded rates"]),
        *results.refused.get("rates", []),
    ]
    return [
        PrintedTable(
            "visual_textual", "Visual against textual voids", rows, columns, notes, results.why("rates"), _rate_trace
        )
    ]


def _rate_trace(row: Mapping[str, Any], field: str) -> SourceItems:
    if field in COUNTED:
        return SourceItems("", row["model"], "standard")
    taxonomy, _, kind = field.rpartition("_")
    dataset = {"visual": taxonomy, "textual": f"{taxonomy}_ill_posed"}.get(kind, "") if taxonomy != "pooled" else ""
    return SourceItems(dataset, row["model"], "standard", "void")


def uplift(results: Results) -> list[PrintedTable]:
    """Return AbsRec under both prompts, its ratio, and PECS; datasets weigh equally."""
    rows, refusals, regimes = [], [], PROMPTING
    for model, means in with_marks(results.overall).groupby("model", sort=False):
        sides = {row["regime"]: row for row in means.to_dict("records") if row["regime"] in regimes}
        if len(sides) < len(regimes):
            continue
        try:
            (ratio,) = analyses.uplift(results.cells.loc[results.cells["model"] == model], means)["ratio"]
        except EpochMismatch as error:
            refusals.append(str(error))
            continue
        reason = results.refusal("overall", (str(model), "standard"), (str(model), "guided"))
        if reason is not None:
            refusals.append(f"{model}: {reason}")
            continue
        row = {
            "model": model,
            "ratio": ratio,
            "epoch": sides["standard"]["epoch"],
            **combined_counts([*sides.values()]),
        }
        for regime, side in sides.items():
            row |= {f"{regime}_{name}": side[name] for name in ("abs_rec", "false_abs", "pecs", "mark")}
        rows.append(row)
    table = with_marks(frame(rows, ["model", "ratio", *COUNTED])).sort_values(
        "ratio", ascending=False, ignore_index=True
    )
    columns = [
        MODEL,
        *(Column(f"{r}_abs_rec", f"AbsRec %, {r}", "percent") for r in regimes),
        Column("ratio", "Ratio", "ratio", digits=2, mark="mark"),
        *(Column(f"{r}_false_abs", f"FalseAbs %, {r}", "percent") for r in regimes),
        *(Column(f"{r}_pecs", f"PECS, {r}", "fraction", mark=f"{r}_mark") for r in regimes),
        *COUNT_COLUMNS,
    ]
    notes = [epochs(results.cells), "equal-weight means over the four datasets; ∞ where only standard is 0"]
    notes += [*mark_notes(table), *refusals]
    absence = "no model has standard and guided on all four datasets"
    return [PrintedTable("guided_uplift", "Guided against standard", table, columns, notes, absence, _regime_trace)]


def _regime_trace(row: Mapping[str, Any], field: str) -> SourceItems:
    regime, _, metric = field.partition("_")
    return SourceItems("", row["model"], regime if regime in REGIMES else "", SIDE_OF.get(metric, ""))


def naive(results: Results) -> list[PrintedTable]:
    """Return guided cells by Acc x AbsRec minus PECS; the product ignores FalseAbs."""
    cells = results.cells.loc[results.cells["regime"] == GUIDED]
    rows = with_marks(analyses.naive_gap(cells, -np.inf)).dropna(subset=["gap"])
    gap_cells = analyses.naive_gap(cells, NAIVE_THRESHOLD)
    rows = with_titles(rows.sort_values("gap", ascending=False, ignore_index=True, kind="stable"))
    columns = [
        MODEL, DATASET, SHARE_COLUMNS[0], SHARE_COLUMNS[1], SHARE_COLUMNS[2], PECS,
        Column("naive", "Naive", "fraction"), Column("gap", "Naive − PECS", "fraction"), *COUNT_COLUMNS, EPOCH,
    ]  # fmt: skip
    notes = [
        f"guided; Naive = Acc × AbsRec of the means over runs; {len(gap_cells)} of {len(rows)} cells differ by more "
        f"than {NAIVE_THRESHOLD}",
        epochs(cells),
        *mark_notes(rows),
    ]
    return [
        PrintedTable(
            "pecs_naive", "PECS against Acc × AbsRec", rows, columns, notes, "no cell under guided", cell_trace
        )
    ]


def zero_boundary(results: Results) -> list[PrintedTable]:
    """Return cells with PECS 0: voids not told from controls, or Acc 0."""
    rows = sort_rows(with_titles(with_marks(analyses.zero_boundary(results.cells))), ["regime", "dataset", "model"])
    columns = [MODEL, DATASET, REGIME, *SHARE_COLUMNS, PECS, *COUNT_COLUMNS, EPOCH]
    n_cells = results.cells.groupby("regime", sort=False).size()
    zero = rows.groupby("regime").size().reindex(n_cells.index, fill_value=0)
    notes = [", ".join(f"{regime}: {zero[regime]} of {n} cells" for regime, n in n_cells.items()), epochs(rows)]
    notes += mark_notes(rows)
    reason = "no cell has PECS 0" if len(results.cells) else results.why("cells")
    table = PrintedTable("zero_boundary", "Cells with PECS 0", rows, columns, notes, reason, cell_trace)
    return [rightly_empty(table, bool(len(results.cells)))]


def frontier(results: Results) -> list[PrintedTable]:
    """Return the Pareto frontier in (Acc, J), averaged over datasets, by regime."""
    rows = sort_rows(with_marks(analyses.frontier(results.overall)), ["regime"])
    columns = [REGIME, MODEL, SHARE_COLUMNS[0], J, PECS, *COUNT_COLUMNS]
    notes = ["no other model is as good in both Acc and J and better in one", epochs(results.cells), *mark_notes(rows)]
    return [PrintedTable("frontier", "Pareto frontier", rows, columns, notes, no_overall(results, False), cell_trace)]


def reasoning(results: Results) -> list[PrintedTable]:
    """Return the thinking member of each pair minus the other, by dataset and overall."""
    import pandas as pd

    cells = entries(results)
    rows, refusals = [analyses.pair_differences(cells.iloc[:0])], []
    for pair in analyses.REASONING_PAIRS:
        try:
            rows.append(analyses.pair_differences(cells.loc[cells["model"].isin(pair)]))
        except EpochMismatch as error:
            refusals.append(str(error))
    table: pd.DataFrame = pd.concat(rows, ignore_index=True)
    reasons = [
        results.refusal(row["dataset"], *((row[member], row["regime"]) for member in ("thinking", "other")))
        for row in table.to_dict("records")
    ]
    refusals += sorted({reason for reason in reasons if reason})
    table = table.loc[[reason is None for reason in reasons]].reset_index(drop=True)
    table = with_counts(table, cells, [(member, "regime", "dataset") for member in ("thinking", "other")])
    table = sort_rows(with_titles(table), ["thinking", "regime", "dataset"])
    columns = [
        Column("thinking", "Thinking"), Column("other", "Other"), REGIME, DATASET,
        *(Column(c.field, f"Δ {c.heading}", c.unit) for c in SHARE_COLUMNS),
        Column("pecs", "Δ PECS", "fraction", mark="mark"), *COUNT_COLUMNS,
    ]  # fmt: skip
    notes = [epochs(results.cells), "thinking minus other; Δ of shares in points; missing: items of both models"]
    notes += [*mark_notes(table), *refusals]
    trace: Trace = lambda row, field: SourceItems(  # noqa: E731
        row["dataset"] if row["dataset"] in DATASETS else "", row["thinking"], row["regime"], SIDE_OF.get(field, "")
    )
    absence = "no reasoning pair has both members evaluated on one dataset"
    return [PrintedTable("reasoning_pairs", "Reasoning pairs", table, columns, notes, absence, trace)]


TOO_FEW = "too few"


def contrasts(results: Results) -> list[PrintedTable]:
    """Return paired contrasts of overall PECS (Holm) between models and regimes."""
    rows = results.contrasts
    rows = rows.loc[(rows["dataset"] == "overall") & (rows["metric"] == "pecs")]
    answer_words = rows["separable"].map({True: "yes", False: "no"}).astype(object)
    rows = rows.assign(separable=answer_words.where(rows["separable"].notna(), TOO_FEW))
    rows = rows.sort_values(["kind", "p_holm", "left_model"], ignore_index=True, kind="stable")
    rows = with_counts(rows, entries(results), [(f"{s}_model", f"{s}_regime", "dataset") for s in ("left", "right")])
    columns = [
        Column("left_model", "Left"), Column("left_regime", "Regime"), Column("right_model", "Right"),
        Column("right_regime", "Regime"), Column("difference", "Δ PECS", "fraction", mark="mark"),
        Column("ci_low", "95 % CI from", "fraction"), Column("ci_high", "to", "fraction"),
        Column("p", "p", "p"), Column("p_holm", "p, Holm", "p"), Column("separable", "Separable"),
        *COUNT_COLUMNS, Column("refused", "Refused"),
    ]  # fmt: skip
    notes = ["left minus right; the other metrics and datasets are in the workspace's table `contrasts`"]
    if TOO_FEW in set(rows["separable"]):
        notes.append(f"{TOO_FEW}: no answers to so few scenarios could differ significantly")
    notes += ["missing: items of both sides", *mark_notes(rows)] if len(rows) else []
    trace: Trace = lambda row, field: SourceItems("", row["left_model"], row["left_regime"])  # noqa: E731
    reason = "fewer than two entries have all four datasets" if results.is_study else results.why("contrasts")
    return [PrintedTable("contrasts", "Paired contrasts", rows, columns, notes, reason, trace)]


def regime_tests(results: Results) -> list[PrintedTable]:
    """Return McNemar's test of two regimes on equal items, by dataset, model and run."""
    rows = sort_rows(with_titles(results.regime_tests), ["dataset", "model", "run", "decision"])
    columns = [
        DATASET, MODEL, Column("run", "Run", "count"), Column("decision", "Decision"),
        Column("left_regime", "Left"), Column("right_regime", "Right"), Column("n", "n", "count"),
        Column("only_left", "Yes, left alone", "count"), Column("only_right", "Yes, right alone", "count"),
        Column("p", "p", "p"), Column("p_holm", "p, Holm", "p"), Column("refused", "Refused"),
    ]  # fmt: skip
    trace: Trace = lambda row, field: SourceItems(row["dataset"], row["model"], row["left_regime"])  # noqa: E731
    reason = "no model has two regimes" if results.is_study else results.why("regime_tests")
    return [PrintedTable("regime_tests", "McNemar’s test of regimes", rows, columns, why=reason, trace=trace)]


def spreads(results: Results) -> list[PrintedTable]:
    """Return quartiles of the standard deviations of PECS over runs, by family."""
    cells: pd.DataFrame = results.cells
    families = {entry.id: entry.groups.family for entry in load_models().values()}
    rows = []
    for family, part in [*cells.assign(family=cells.loc[:, "model"].map(families)).groupby("family"), ("all", cells)]:
        repeated_cells = part.loc[part["n_runs"] > 1]
        if len(repeated_cells):
            rows.append({"family": family, **analyses.spread(repeated_cells).iloc[0].to_dict()})
    quartiles = {"q25": "25 %", "median": "Median", "q75": "75 %"}
    columns = [
        Column("family", "Family"),
        *(Column(name, heading, "fraction", 4) for name, heading in quartiles.items()),
        Column("n", "Cells", "count"),
    ]
    notes = ["quartiles over cells of the population standard deviation of PECS over runs; cells of one run left out"]
    reason = "no cell has more than one run" if len(cells) else results.why("cells")
    rows = frame(rows, ["family"])
    trace: Trace = lambda row, field: SourceItems()  # noqa: E731
    return [PrintedTable("run_spread", "Spread over runs", rows, columns, [*notes, epochs(cells)], reason, trace)]


def degenerate(results: Results) -> list[PrintedTable]:
    """Return expected and measured scores of strategies that do not discriminate."""
    rows = analyses.degenerate_strategies()
    columns = [
        Column("strategy", "Strategy"), *SHARE_COLUMNS, Column("j", "J", "fraction"),
        Column("naive", "Naive", "fraction"), Column("pecs", "PECS", "fraction"),
    ]  # fmt: skip
    notes = ["in expectation; Acc is open where the strategy does not determine it, and PECS is still 0"]
    if results.is_study:
        measured_rows = results.overall.loc[results.overall["regime"] == "standard"]
        names = {"model": "strategy", **{name: f"measured_{name}" for name in ("j", "j_std", "pecs", "pecs_std")}}
        measured_rows = measured_rows[[*names, *COUNTED]].rename(columns=names)
        rows = with_marks(rows.merge(measured_rows, on="strategy", how="left"))
        columns += [
            Column("measured_j", "J, measured", "fraction", spread="measured_j_std"),
            Column("measured_pecs", "PECS, measured", "fraction", spread="measured_pecs_std", mark="mark"),
            *COUNT_COLUMNS,
        ]
        notes.append("measured: overall, standard; PECS clips J at 0, so chance alone lifts a random strategy above 0")
        notes += mark_notes(rows)
    trace: Trace = lambda row, field: (  # noqa: E731
        SourceItems("", row["strategy"], "standard") if field.startswith("measured") or field in COUNTED else None
    )
    return [
        PrintedTable(
            "degenerate_strategies", "Degenerate strategies", rows, columns, notes, trace=trace, dash="open, or not run"
        )
    ]
