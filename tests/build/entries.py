"""Entries that a test adds: a fixture to import."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from traps_pipeline.models.registry import user_registry


@pytest.fixture(autouse=True)
def nobodys_own() -> Iterator[None]:
    """Entries that a test adds are forgotten at its end."""
    yield
    user_registry.add_entries(user_registry.UserRegistry(), Path("none"))
    user_registry.clear_caches()
