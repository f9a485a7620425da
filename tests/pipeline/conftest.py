"""The tests of this folder need the declared graph."""

import traps_pipeline.definitions  # noqa: F401
