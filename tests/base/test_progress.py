"""Progress: the one in force, and how time reads."""

from __future__ import annotations

import pytest

from traps_pipeline.base import progress
from traps_pipeline.base.progress import Progress, clock, reporting


def test_a_progress_holds_for_its_block_even_when_it_fails() -> None:
    before, mine = progress.current(), Progress()
    with pytest.raises(ValueError, match="x"), reporting(mine):
        assert progress.current() is mine
        raise ValueError("x")
    assert progress.current() is before


@pytest.mark.parametrize(("seconds", "text"), [(0, "0:00"), (59.4, "0:59"), (59.6, "1:00"), (3600, "60:00")])
def test_time_reads_as_minutes_and_seconds(seconds: float, text: str) -> None:
    assert clock(seconds) == text
