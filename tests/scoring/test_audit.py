"""The audit of the published tables: the statements that agree, and the arithmetic of those that do not."""

from pathlib import Path

import pytest

from traps_pipeline.cli import main
from traps_pipeline.scoring.audit import _same_words, audit
from traps_pipeline.scoring.claims import CLAIMS
from traps_pipeline.scoring.published import published


@pytest.fixture(scope="module")
def findings():
    return audit()


def test_the_counts_are_the_documented_ones(findings):
    assert findings["verdict"].value_counts().to_dict() == {"agrees": 431, "within rounding": 69, "differs": 16}
    documented = (Path(__file__).parents[2] / "docs" / "scoring.md").read_text()
    assert "prints 516 statements" in documented
    assert "500 agree" in documented


def test_a_statement_agrees_only_with_the_same_numbers_and_the_same_names():
    assert _same_words("gemini-3.1-pro 0.568", "gemini-3.1-pro 0.5683")
    assert not _same_words("gemini-3.1-pro 0.568", "gemini-3.1-pro-r-low 0.568")
    assert not _same_words("gemini-3.1-pro-r-low 0.568", "gemini-3.1-pro 0.568")
    assert not _same_words("gpt-5-pro", "gpt-5-pro; gpt-5-mini")


def test_the_shift_of_confabulated_items_is_held_against_the_model_that_it_is_stated_of(findings):
    shifts = findings[findings["group"] == "probe means"]
    assert len(shifts) == 3
    assert shifts["statement"].str.contains("qwen3-vl-8b").all()
    assert (shifts["verdict"] == "agrees").all()


def test_every_published_claim_is_decided(findings):
    claims = findings[findings["group"] == "claims"]
    assert set(published("claims")["id"]) == set(CLAIMS)
    assert len(claims) == 33
    differing = claims.loc[claims["verdict"] == "differs", "statement"].str.partition(":")[0]
    assert set(differing) == {"spread-video-native", "spread-gpt5", "steer-control", "steer-void", "steer-family"}


def test_the_overall_table_follows_from_the_cells_but_for_one(findings):
    overall = findings[findings["group"] == "overall"]
    assert len(overall) == 16 * 3 * 4
    [one] = overall[overall["verdict"] != "agrees"].to_dict("records")
    assert one["statement"] == "overall pecs of llava-next-video-7b, json"
    assert one["reason"] == "(0.013 + 0.013 + 0.010 + 0.056) / 4 = 0.023, off by -0.002"


def test_the_cell_behind_it_is_the_only_one_whose_factors_do_not_give_its_pecs(findings):
    factors = findings[(findings["group"] == "pecs factors") & (findings["verdict"] == "differs")]
    assert list(factors["statement"]) == ["PECS of llava-next-video-7b, chaotic, json"]
    # With Acc x J of its factors in its place the overall figure is the printed one.
    assert round((0.013 + 0.013 + 0.244 * (0.098 - 0.021) + 0.056) / 4, 3) == 0.025


def test_two_printed_transfer_types_contradict_the_definitions(findings):
    types = findings[(findings["group"] == "transfer types") & (findings["verdict"] == "differs")]
    assert [s.rsplit("of ")[-1] for s in types["statement"]] == ["oc_ip to oc", "ch_ip to ch"]


def test_the_command_prints_claims_and_discrepancies_and_writes_all_findings(tmp_path, capsys):
    assert main(["audit", "--csv", str(tmp_path / "audit.csv")]) == 0
    printed = capsys.readouterr().out
    assert "differs         steer-family" in printed
    assert "1 differs" in printed
    assert "overall acc of gemini-2.5-pro" not in printed
    assert "overall acc of gemini-2.5-pro" in (tmp_path / "audit.csv").read_text()
