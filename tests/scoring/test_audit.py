"""The audit of the published tables: the statements that agree, and the arithmetic of those that do not."""

import re
from pathlib import Path

import pytest

from tools.paper_audit.arranged import arranged
from tools.paper_audit.claims import CLAIMS
from tools.paper_audit.recomputed import recomputed
from traps_pipeline.scoring.audit import audit, counts_text
from traps_pipeline.scoring.published import PUBLISHED, as_printed, published


@pytest.fixture(scope="module")
def findings():
    return audit()


def test_the_shipped_audit_is_what_the_tables_give(findings):
    again = recomputed().astype(str)
    assert again.to_dict("records") == findings.to_dict("records")


def test_the_tables_that_the_paper_prints_across_are_what_the_other_files_give():
    declared = as_printed("tables").set_index("name")["columns"]
    shipped = {path.stem.removeprefix("arranged_"): path.read_text() for path in PUBLISHED.glob("arranged_*.csv")}
    assert {name: (text, declared[name]) for name, text in shipped.items()} == arranged()


def test_the_counts_are_the_documented_ones(findings):
    documented = (Path(__file__).parents[2] / "docs" / "scoring.md").read_text()
    assert re.search(r"\b" + r"\D+".join(re.findall(r"\d+", counts_text(findings))) + r"\b", documented)


def test_every_printed_probe_mean_follows_from_its_four_pairs(findings):
    means = findings[findings["group"] == "probe means"]
    assert len(means) == 3 * 3 * 2
    assert (means["verdict"] == "agrees").all()
    # (.913 + .860 + .645 + .760) / 4 = .7945, which the paper prints as .795
    (row,) = means[means["statement"] == "four-path mean AUROC, all items, qwen3-vl-8b, Cross-both"].to_dict("records")
    assert (row["published"], row["recomputed"]) == ("0.795", "0.7945")


def test_a_defect_is_counted_once_and_a_declared_difference_is_not_a_defect(findings):
    assert findings["statement"].is_unique
    about = findings[findings["statement"].str.contains("alpha 0")]
    assert list(about.loc[about["verdict"] == "differs", "statement"].str.partition(":")[0]) == [
        "steer-control", "steer-void", "steer-alpha0-families", "steer-alpha0-gemma", "sweep-alpha0",
    ]  # fmt: skip
    declared = findings[findings["verdict"] == "declared"]
    assert declared["published"].tolist() == ["25", "39"]
    # The verification run lies below the original one, but not here: 71.25 for 70.
    (above,) = findings[findings["statement"].str.startswith("gemma-4-e4b: mean void abstention at alpha 10")].to_dict(
        "records"
    )
    assert (above["verdict"], above["published"], above["recomputed"]) == ("differs", "70", "71.25")


def test_every_published_claim_is_decided(findings):
    claims = findings[findings["group"] == "claims"]
    assert set(published("claims")["id"]) == set(CLAIMS)
    assert len(claims) == 73
    differing = claims.loc[claims["verdict"] == "differs", "statement"].str.partition(":")[0]
    assert set(differing) == {
        "spread-video-native", "spread-gpt5", "steer-control", "steer-void", "gap-families", "nine-contour",
        "json-between", "gpt5-chaotic", "same-agreement", "guided-near-zero", "probe-replication-shift",
        "probe-across-domains", "steer-chaotic-control", "steer-chaotic-void", "steer-single-paths", "steer-same-paths",
        "steer-alpha0-families", "steer-alpha0-gemma", "sweep-alpha0", "sweep-chaotic", "validated-set",
    }  # fmt: skip


def test_the_overall_table_follows_from_the_cells_but_for_one(findings):
    overall = findings[findings["group"] == "overall"]
    assert len(overall) == 16 * 3 * 4
    [one] = overall[overall["verdict"] != "agrees"].to_dict("records")
    assert one["statement"] == "overall pecs of llava-next-video-7b, json"
    assert re.findall(r"-?\d[\d.]*", one["reason"]) == ["0.013", "0.013", "0.010", "0.056", "4", "0.023", "-0.002"]


def test_the_cell_behind_it_is_the_only_one_whose_factors_do_not_give_its_pecs(findings):
    factors = findings[(findings["group"] == "pecs factors") & (findings["verdict"] == "differs")]
    assert list(factors["statement"]) == ["PECS of llava-next-video-7b, chaotic, json"]
    # With Acc x J of its factors in its place the overall metric is the printed one.
    assert round((0.013 + 0.013 + 0.244 * (0.098 - 0.021) + 0.056) / 4, 3) == 0.025
