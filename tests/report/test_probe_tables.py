"""The tables of probes from rows worked out by hand: what stands beside each figure, counts and marks."""

from __future__ import annotations

from functools import cached_property
from itertools import product

import pandas as pd
import pytest

from traps_pipeline.mechanism.control_rows import PROBE_BASELINES
from traps_pipeline.mechanism.mechanism_rows import PROBES
from traps_pipeline.protocol.datasets import ANSWERABLE
from traps_pipeline.report.published_results import PublishedResults
from traps_pipeline.report.result_frames import Results
from traps_pipeline.report.tables.probe_tables import probes
from traps_pipeline.report.writing import PrintedTable
from traps_pipeline.storage.tables import Table

ABOUT = {"model": "m", "prompt": "standard", "scope": "all"}
PAIRS = (("occlusion", "occlusion_ill_posed"), ("occlusion", "chaotic"))
FEATURES = (("question words", 0.7), ("length", 0.9), ("output margin", 0.8), ("noise", 0.5))


def frame(table: Table, rows: list[dict[str, object]]) -> pd.DataFrame:
    return pd.DataFrame([ABOUT | row for row in rows]).reindex(columns=pd.Index(table.names))


def states() -> pd.DataFrame:
    """Transfer of two pairs at one layer, Cf->Cf of six voids, one dataset on itself, and what looks like voids."""
    flags = dict.fromkeys(("own_best", "all_sample_best", "chosen"), True)
    row = flags | {"layer": 3, "low": 0.8, "high": 1.0, "n_voids": 16, "n_controls": 16}
    rows = [row | {"analysis": "transfer", "source": s, "target": t, "value": 0.95} for s, t in PAIRS]
    cf = row | {"source": "occlusion", "target": "occlusion_ill_posed", "n_voids": 6, "n_controls": 6}
    for analysis, value in (("held_out", 0.85), ("confabulated", 0.93), ("confabulated_held_out", 0.61)):
        rows.append(cf | {"analysis": analysis, "value": value})
    itself = row | {"source": "occlusion", "target": "occlusion", "n_voids": 9}
    rows += [itself | {"analysis": name, "value": value, "spread": 0.1}
             for name, value in (("within", 0.97), ("shuffled", 0.5), ("held_out", 0.96))]  # fmt: skip
    extra = row | {"source": "occlusion", "target": ANSWERABLE}
    rows += [
        extra | {"analysis": "answerable_void", "value": 0.4},
        extra | {"analysis": "answerable_control", "value": 1.0},
    ]
    rows.append(extra | {"analysis": "answerable_void", "target": "length_matched", "value": 0.0})
    for analysis, share in (("centroid_void", 0.75), ("centroid_control", 0.25)):
        there = row | {"analysis": analysis, "source": "occlusion", "target": "chaotic", "value": share, "n_voids": 4}
        rows += [there | {"scope": "sub_scenario:plinko"}, there]
    return frame(PROBES, rows)


def made_baselines() -> pd.DataFrame:
    found = []
    pairs = (("transfer", *PAIRS[0]), ("transfer", *PAIRS[1]), ("confabulated", *PAIRS[0]), ("held_out", *PAIRS[0]),
             ("held_out", "occlusion", "occlusion"), ("answerable_void", "occlusion", ANSWERABLE),
             ("answerable_control", "occlusion", ANSWERABLE))  # fmt: skip
    for (analysis, source, target), (features, value) in product(pairs, FEATURES):
        row = {"analysis": analysis, "source": source, "target": target, "features": features}
        lower = 0.1 if analysis == "confabulated" else 0.0
        found.append(row | {"value": value - lower, "spread": 0.05 if features == "noise" else None})
    return frame(PROBE_BASELINES, found)


class Made(Results):
    """Results of one model's probes."""

    source, is_study = "made up", True
    prompted_probes = cached_property(lambda _: states())
    baselines = cached_property(lambda _: made_baselines())


def tables(results: Results | None = None) -> dict[str, PrintedTable]:
    return {table.name: table for table in probes(results or Made())}


def first(table: PrintedTable) -> dict[str, str]:
    return dict(zip([column.heading for column in table.columns], table.cells[0], strict=True))


BESIDE = {"Best raw input": "length", "its AUROC": "0.900", "Output margin": "0.800", "Noise": "0.500 ± 0.050"}


@pytest.mark.parametrize("name", ["probe_transfer", "probe_within"])
def test_the_best_raw_input_the_output_margin_and_noise_stand_beside_a_probe(name: str) -> None:
    assert BESIDE.items() <= first(tables()[name]).items()


def test_a_figure_without_the_scored_scenario_stands_beside_the_floor_of_its_own_split() -> None:
    row = first(tables()["probe_transfer"])
    assert (row["Held out"], row["Noise, held out"]) == ("0.850", "0.500 ± 0.050")


def test_confabulated_voids_stand_beside_baselines_of_the_same_voids_and_with_their_scenario_held_out() -> None:
    table = tables()["probe_confabulated"]
    row = first(table)
    assert (row["Cf→Cf"], row["Held out"], row["Cf voids"]) == ("0.930 †", "0.610", "6")
    assert (row["Best raw input"], row["its AUROC"], row["Output margin"]) == ("length", "0.800", "0.700")
    assert any(note.startswith("†") for note in table.notes) and len(table.cells) == 1


def test_means_over_paths_have_means_of_baselines_beside_them() -> None:
    row = first(tables()["probe_means"])
    assert BESIDE.items() - {("Noise", "0.500 ± 0.050")} <= row.items() and row["Noise"] == "0.500"
    of_confabulated = [row[f"Cf→Cf: {name}"] for name in ("Held out", "Best raw input", "its AUROC")]
    assert of_confabulated == ["0.610", "length", "0.800"]
    assert (row["Held out"], row["Noise, held out"]) == ("0.850", "0.500")
    assert (row["AUROC"], row["Cf→Cf"], row["Fewest voids"], row["Fewest Cf voids"]) == ("0.950", "0.930 †", "16", "6")


def test_a_dataset_on_itself_has_counts_an_interval_and_a_mark() -> None:
    row = first(tables()["probe_within"])
    assert (row["AUROC"], row["Over all folds"], row["from"], row["to"]) == ("0.970 †", "0.960", "0.800", "1.000")
    assert (row["Voids"], row["Controls"]) == ("9", "16")


def test_catch_rates_stand_beside_the_share_of_controls_and_say_that_these_are_shared() -> None:
    table = tables()["probe_catch_rates"]
    assert (first(table)["Catch rate %"], first(table)["Controls %"]) == ("75.0 †", "25.0")
    assert len(table.notes) == 3  # of the voids, of shared controls, of the mark


def test_the_papers_tables_have_no_empty_columns_of_baselines() -> None:
    paper = PublishedResults()
    of_paper = tables(paper)
    assert "Cf→Cf" in first(of_paper["probe_transfer"]) and "Noise" not in first(of_paper["probe_transfer"])
    absent = of_paper["probe_confabulated"]
    assert not absent.cells and absent.why != paper.why("probes")  # its figures stand in another table
    assert not any(mark for mark in of_paper["probe_transfer"].rows["mark"])  # it prints no counts to mark


def test_a_raw_input_is_named_only_where_it_is_above_chance() -> None:
    made = Made()
    rows = made_baselines()
    made.baselines = rows.assign(value=rows["value"].where(rows["features"] == "noise", 0.5))
    assert first(tables(made)["probe_transfer"])["Best raw input"] == "none above .5"
