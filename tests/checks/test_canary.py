"""The canary says what changed between two epochs under one served name."""

from __future__ import annotations

import datetime
from typing import Any

import pandas as pd

from traps_pipeline.checks.canary import CANARY, CanaryRow, changes, changes_text


def asked(epoch: str, item: str, day: int, **said: Any) -> CanaryRow:
    fields = {"served_model": "m-1", "outcome": "answer", "text": "left", "abstained": False, "value": "left"}
    at = datetime.datetime(2026, 11, day, tzinfo=datetime.UTC)
    return CanaryRow(model="m", item_id=item, epoch=epoch, created_at=at, **(fields | {"prompt_tokens": 100} | said))


def test_what_changed_between_two_epochs_is_counted_by_item() -> None:
    rows = [
        *(asked("nov", item, 1) for item in "abcd"),
        asked("dec", "a", 9, prompt_tokens=104),
        asked("dec", "b", 9, value="right", text="right"),
        asked("dec", "c", 9, abstained=True, value=None, text="I don't know."),
        asked("dec", "e", 9),  # not asked before
    ]
    frame = pd.DataFrame([vars(row) for row in rows], columns=pd.Index(CANARY.names))
    (found,) = changes(frame).to_dict("records")
    assert (found["from"], found["to"], found["served"], found["n"]) == ("nov", "dec", "m-1", 3)
    assert (found["outcome"], found["abstained"], found["value"]) == (0, 1, 2)
    assert found["tokens"] == 4 / 3
    assert "m-1" in changes_text(frame)


def test_a_new_served_name_is_shown_and_one_epoch_alone_has_nothing_to_compare() -> None:
    one = pd.DataFrame([vars(asked("nov", "a", 1))])
    assert changes(one).empty and "study.yaml" in changes_text(one)
    two = pd.concat([one, pd.DataFrame([vars(asked("dec", "a", 2, served_model="m-2", prompt_tokens=None))])])
    (found,) = changes(two).to_dict("records")
    assert found["served"] == "m-1 -> m-2" and found["tokens"] != found["tokens"]
