"""Answers that are read from sheets without the key are scored by what a value names."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from bench.blind_reading import chosen, scored, write_sheets
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.base.paths import TWO_EVENTS_RELEASED
from traps_pipeline.benchmark.records import two_events_lines

SPECS = {id_: line.spec for id_, line in two_events_lines(TWO_EVENTS_RELEASED).items()}


def test_an_abstention_is_right_where_nothing_is_shown_and_an_answer_where_it_names_the_truth():
    truths = SPECS["slide-e001"].lanes[0].ground_truth, None
    items = [f"two_events:slide-e001:left.{clip}" for clip in ("neither", "left")]
    key = pd.DataFrame(
        [(str(n), items[n % 2], truths[n % 2]) for n in range(4)], columns=["number", "item_id", "truth"]
    )
    answers = pd.DataFrame({"number": ["3", "1", "2", "0"], "answer": ["Unknown", "yes", "unknown", f" {truths[0]}. "]})
    read = scored(key=key.iloc[[0, 2, 3]], answers=answers, specs=SPECS)
    assert read["right"].tolist() == [True, False, True]  # item 2 was answered by "unknown", though it is shown
    assert read["side"].tolist() == ["control", "control", "void"]
    assert scored(answers, key, SPECS)["right"].tolist() == [True, False, False, True]  # 1: nobody can know it
    answers.loc[0, "answer"] = " "
    with pytest.raises(TrapsError, match="questions 3: 1 have no answer"):
        scored(answers, key, SPECS)


def test_scenarios_of_all_families_are_chosen_before_a_second_one_of_any():
    families = [spec.family for spec in chosen(SPECS, 40, np.random.default_rng(1))]
    assert len(families) == 40 and len({*families[:30]}) == 30 and len({*families[30:]}) == 10


def test_the_key_may_not_lie_beside_the_sheets(tmp_path: Path):
    with pytest.raises(TrapsError, match="name another place"):
        write_sheets([], tmp_path / "sheets", tmp_path / "sheets" / "key.csv", tmp_path, np.random.default_rng(1))


@pytest.mark.slow
def test_sheets_tell_no_side_and_their_key_has_half_of_the_truths(tmp_path: Path):
    specs, folder = [SPECS["slide-e001"]], tmp_path / "sheets"
    write_sheets(specs, folder, tmp_path / "key.csv", TWO_EVENTS_RELEASED, np.random.default_rng(1))
    answers, key = pd.read_csv(folder / "answers.csv"), pd.read_csv(tmp_path / "key.csv")
    assert len({*folder.glob("*.png")}) == 4 and answers.columns.tolist() == ["number", "sheet", "question", "answer"]
    assert answers["number"].tolist() == key["number"].tolist() == [*range(1, 9)] and key["truth"].isna().sum() == 4
