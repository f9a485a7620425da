"""Tables and figures of controls inside models, from rows worked out by hand."""

from __future__ import annotations

import io
import re
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import numpy as np
import pandas as pd
import pytest

from tests.build.controls import Made, effects, gate, item_scores, patching
from traps_pipeline.report import publish, study_results
from traps_pipeline.report.cards import Sources, figure_card, table_card
from traps_pipeline.report.catalogue import FIGURE_REPORTS, INSIDE, TABLE_REPORTS
from traps_pipeline.report.figures.looks import arrow
from traps_pipeline.report.result_frames import Results
from traps_pipeline.report.study_results import StudyResults
from traps_pipeline.report.tables import control_reports
from traps_pipeline.report.tables.claims import CLAIMS, SUBJECT_NAMES, Claim, claim_frame, verdict
from traps_pipeline.report.tables.claims import claims as claim_tables
from traps_pipeline.report.tables.inside_columns import why_not
from traps_pipeline.report.tables.patching_tables import patching as patching_table
from traps_pipeline.report.tables.steering_tables import steering as steering_tables
from traps_pipeline.report.writing import PrintedTable
from traps_pipeline.scoring.score_rows import TWO_WAY
from traps_pipeline.storage.study import Layers, MechanismSettings, Study
from traps_pipeline.storage.workspace import Workspace


def cells(table: PrintedTable) -> list[dict[str, str]]:
    headings = [column.heading for column in table.columns]
    return [dict(zip(headings, row, strict=True)) for row in table.cells]


def test_a_claim_is_held_only_where_no_control_that_must_fail_holds_too() -> None:
    claim = Claim("x", "says", "metric", 0.1, lambda *_: None, ("random_0", "placebo"))
    for values, expected in (
        ({"model": 0.1, "random_0": 0.09, "placebo": 0.0, "random_1": 0.9}, "holds"),
        ({"model": 0.1, "random_0": 0.1, "placebo": 0.0}, "holds in random 0 too"),
        ({"model": 0.3, "random_0": 0.2, "placebo": 0.2}, "holds in random 0, placebo too"),
        ({"model": 0.3, "no_gap": 0.0}, "no control"),
        ({"model": 0.09, "random_0": 0.2}, "model below bound"),
        ({"random_0": 0.2}, "not measured"),
    ):
        assert verdict(claim, values) == expected


def test_claims_stand_beside_random_weights_placebos_and_the_best_rival() -> None:
    table, _, rivals = claim_tables(Made())
    rows = {row["Claim"]: row for row in cells(table)}
    lead = rows["states tell visual voids better than all rivals"]
    assert [lead[name] for name in ("model", "random 0", "random 1", "placebo")] == [
        "0.200",
        "0.150",
        "not run",
        "0.050",
    ]
    assert lead["Verdict"] == "holds in random 0 too"
    assert rows["states tell visual voids better than the output does"]["model"] == "0.250"  # .9 less .65 of the logits
    own, *_ = cells(rivals)
    assert (own["States"], own["Question words"], own["Best rival"], own["Lead"]) == (
        "0.900", "0.700", "question words", "0.200",
    )  # fmt: skip


def test_the_first_claim_is_the_interaction_at_the_chosen_layer_with_families_held_out_beside_the_answers() -> None:
    made = Made()
    answers = {"model": "m", "regime": "guided", "own_effect": 0.7, "other_effect": 0.6}
    made.two_way = pd.DataFrame([answers]).reindex(columns=pd.Index(TWO_WAY.names))
    claims_of, table, _ = claim_tables(made)
    first = cells(claims_of)[0]
    assert [first[name] for name in ("model", "random 0", "random 1", "Verdict")] == [
        "0.800",
        "0.500",
        "not run",
        "holds",
    ]
    rows = {(row["Prompt"], row["Read from"], row["Held out"]): row for row in cells(table)}
    own, words = (rows["guided", features, "families"] for features in ("states", "words"))
    assert (own["Within a clip"], own["Confound"], own["Answers: own"], own["other"]) == (
        "0.90",
        "0.95",
        "0.70",
        "0.60",
    )
    assert words["Answers: own"] == rows["random_0", "states", "families"]["Answers: own"] == "–"
    assert (first["best rival"], first["placebo"], first["pocket, no gap"]) == ("0.500", "–", "–")
    rows, is_rival = made.interaction, made.interaction["features"] == "words"
    for changed, expected in (
        ({"within": 0.9}, "holds"),  # the AUROC of random weights and of rivals is at chance
        ({"auroc": 0.9, "within": rows["within"].where(is_rival, 0.9)}, "holds in random 0 too"),
        ({"auroc": 0.9, "within": rows["within"].mask(is_rival, 0.9)}, "holds in best rival too"),
        ({"same": rows["same"].mask(rows["prompt"] == "random_0", 1.0)}, "no control"),
    ):
        made.interaction = rows.assign(**changed)
        assert claim_frame(made)["verdict"].iloc[0] == expected
    assert cells(claim_tables(made)[0])[0]["random 0"] == "constant"


def test_a_row_that_joins_two_models_is_left_out_of_claims() -> None:
    made = Made()
    made.item_scores = item_scores().assign(joins="states: nf4, 25 frames; answers: bfloat16, 16 frames")
    rows = claim_frame(made).set_index("claim")
    made.gate = gate().assign(joins="states: nf4, 25 frames; answers: bfloat16, 16 frames")
    assert any(note.startswith("m joins two models (states: nf4") for note in control_reports.gate(made)[0].notes)
    for name in ("unexpressed", "sentence"):
        assert rows.loc[name, "verdict"].startswith("two models (states: nf4") and np.isnan(rows.loc[name, "in_model"])
    assert rows.loc["lead_visual", "verdict"] == "holds in random 0 too"


def test_a_gate_stands_beside_its_controls_and_what_it_costs() -> None:
    (sources,) = control_reports.gate(Made())
    found = [(row["Gate on"], row["Target"]) for row in cells(sources)]
    assert found == [("states", "all"), ("states", "ch"), ("question words", "all")]
    assert [(row["Controls"], row["Voids"]) for row in cells(sources)] == [("64", "64")] * 3


def test_what_the_prompt_changes_is_measured_in_answers_and_in_states() -> None:
    made = Made()
    (row,) = control_reports.prompts(made).to_dict("records")  # chaotic alone has answers, under guided
    assert (row["dataset"], row["probe_standard"], row["probe_guided"]) == ("chaotic", 0.98, 0.96)
    assert row["margin_standard"] == 0.9 and np.isnan([row["margin_guided"], row["change"]]).all()
    made.gate = pd.concat([gate(), gate().assign(regime="standard", plain_abs_rec=0.2)])
    assert control_reports.prompts(made)["change"].tolist() == pytest.approx([0.5 - 0.2])


def test_few_answers_are_marked_and_p_is_printed() -> None:
    nulls, _ = control_reports.steering_nulls(Made())
    (row,) = cells(nulls)
    assert (row["Effect, points"], row["p"], row["Draws"]) == ("80.0 †", "0.048", "20")
    assert any(note.startswith("†") for note in nulls.notes)
    (patched,) = patching_table(Made())
    (row,) = cells(patched)
    printed = [row[name] for name in ("Estimate", "Indirect effect", "Same side", "Other times", "Left out")]
    assert printed == ["0.800", "0.990 †", "0.010", "–", "1"]


def test_every_site_that_was_patched_is_in_the_table_and_has_a_panel() -> None:
    made, rows = Made(), patching()
    sites = [rows.assign(site=site, effect=rows["effect"] / n) for n, site in enumerate(("mlp", "attention"), start=2)]
    made.patching = pd.concat([*(part.loc[part["source"] == "pair"] for part in sites), rows])
    (table,) = patching_table(made)
    found = [(row["Site"], row["Indirect effect"], row["Same side"]) for row in cells(table)]
    assert found == [("residual stream", "0.990 †", "0.010"), ("attention", "0.330 †", "–"), ("MLP", "0.495 †", "–")]
    axes = next(report for report in FIGURE_REPORTS if report.name == "patching").make(made).axes
    titles = [ax.get_title(loc="left") for ax in axes if ax.get_title(loc="left")]
    assert titles == ["residual stream", "attention", "MLP"]
    assert axes[0].get_ylabel().replace("\n", " ") == "m: chaotic, into the control, 6 pairs"


@pytest.mark.parametrize("name", INSIDE)
def test_a_figure_is_drawn_from_them(name: str) -> None:
    report = next(report for report in FIGURE_REPORTS if report.name == name)
    axes = report.make(Made()).axes
    assert axes and all(ax.has_data() for ax in axes)  # no panel for a dataset that was not asked


# The numbers of each sentence, in their order.
FINDINGS = {
    "claims": "4 18",  # above the shipped figures of the pocket without the gap, and in no other control
    "leads": "0.90 0.70 +0.20 +0.05 +0.30",
    "patching": "0.99 0 1 1 0.99 0 1 1",  # share, layer, panels of panels
}


@pytest.mark.parametrize("name", FINDINGS)
def test_a_lead_figure_says_what_it_shows_of_the_study_and_nothing_of_an_empty_one(name: str) -> None:
    report = next(report for report in FIGURE_REPORTS if report.name == name)
    assert re.findall(r"[+-]?\d+(?:\.\d+)?(?: %)?", report.finding(Made())) == re.split(r" (?!%)", FINDINGS[name])
    assert report.note(Results()) == report.doc


def test_the_page_of_a_study_that_looked_inside_leads_with_the_four_figures_of_its_controls_in_order(
    tmp_path: Path,
) -> None:
    """What can refute a claim about probes comes first, then gates, patches and doses; else figures stand as ever."""

    def shown(mechanism: MechanismSettings | None) -> list[str]:
        workspace = Workspace.create(tmp_path / f"{mechanism is None}", Study(mechanism=mechanism))
        return [part.name for part in publish.report_parts(Sources(workspace)) if part.chapter == "figures"]

    order = [report.name for report in FIGURE_REPORTS]
    assert shown(None) == order and order[: len(INSIDE)] != [*INSIDE]
    inside = shown(MechanismSettings(models={"tiny": Layers(steering=1, centroid=1)}))
    assert inside[:3] == ["claims", "leads", "lens"] == [*INSIDE[:3]]
    assert inside == [*INSIDE, *(name for name in order if name not in INSIDE)]


def test_steered_cells_have_their_dose_in_class_gaps_their_counts_and_what_is_no_answer() -> None:
    every = effects().assign(n_missing=0, degenerate=1)
    made = Made()
    made.effects = study_results._effects(cast(StudyResults, SimpleNamespace(rows=lambda _: every)))
    found = {table.name: table for table in steering_tables(made)}
    (row,) = cells(found["steering_top"])
    assert (row["α"], row["in class gaps"]) == ("10", "0.05")  # the gap is 200
    assert row["Controls abstained on %"].endswith("†") and (row["Controls"], row["Voids"]) == ("5", "5")
    assert (row["Degenerate %, controls"], row["voids"]) == ("20.0", "20.0")
    assert [line["in class gaps"] for line in cells(found["steering_dose"])] == ["0.00", "0.05"]
    for name in ("steering_top", "steering_dose", "steering_regimes", "steering_domains"):
        assert {"n =", "†"} <= {re.split(r" \w", note)[0] for note in found[name].notes}, name


def test_a_figure_or_table_that_cannot_be_made_is_named_with_its_models_and_the_others_are_made() -> None:
    made = Made()
    made.overall = pd.DataFrame({"model": ["m"]})
    made.leads = made.leads.drop(columns="target")
    sources = cast(Sources, SimpleNamespace(study=made))
    by_name = {report.name: report for report in FIGURE_REPORTS}
    broken, sound = (figure_card(by_name[name], sources) for name in ("leads", "lens"))
    assert not broken.html and broken.why.startswith("figure leads of m: ") and "KeyError" in broken.why
    assert sound.html and not sound.why
    (table,) = (report for report in TABLE_REPORTS if report.name == "claims")
    assert table_card(table, sources).why.startswith("table claims of m: ")


def test_an_arrow_from_or_to_an_undefined_point_is_left_out_and_the_figure_is_saved() -> None:
    from matplotlib.figure import Figure

    figure = Figure()
    axes = figure.add_subplot()
    for start, end in (((0.1, 0.2), (float("nan"), 0.5)), ((float("nan"), 0.2), (0.3, 0.5)), ((0.1, 0.1), (0.4, 0.5))):
        arrow(axes, start, end, "black")
    figure.savefig(io.BytesIO())
    assert len(axes.texts) == 1


def test_only_a_study_without_a_mechanism_section_is_told_so() -> None:
    made = Results()
    made.is_study = True
    assert "`mechanism`" in why_not(made)
    made.mechanism = MechanismSettings(models={"tiny": Layers(steering=1, centroid=1)})
    assert why_not(made) and "`mechanism`" not in why_not(made)


def test_a_claim_whose_metric_is_undefined_is_not_measured_and_never_held():
    for claim in CLAIMS:  # as of a network of random weights, no answer of which is decided
        assert verdict(claim, dict.fromkeys(SUBJECT_NAMES, float("nan"))) == "not measured"
        assert verdict(claim, dict.fromkeys(SUBJECT_NAMES)) == "not measured"
