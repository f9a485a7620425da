"""Rows of canary calls."""

from __future__ import annotations

import datetime
from typing import Any

from traps_pipeline.checks.canary import CanaryRow


def asked(epoch: str, item: str, day: int, **said: Any) -> CanaryRow:
    fields = {"served_model": "m-1", "outcome": "answer", "text": "left", "abstained": False, "value": "left"}
    at = datetime.datetime(2026, 11, day, tzinfo=datetime.UTC)
    return CanaryRow(model="m", item_id=item, epoch=epoch, created_at=at, **(fields | {"prompt_tokens": 100} | said))
