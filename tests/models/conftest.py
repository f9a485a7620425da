"""What several tests of models share."""

from __future__ import annotations

import pytest

from traps_pipeline.models.wire.api import load_litellm


@pytest.fixture(scope="session")
def client_library() -> None:
    """Import the client library, which takes as long as a test may."""
    load_litellm()
