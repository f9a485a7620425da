"""Where the checkout's data lies. The package runs from a checkout (editable install), never from a wheel alone."""

from __future__ import annotations

import os
from pathlib import Path

from traps_pipeline.errors import TrapsError

CHECKOUT = Path(__file__).resolve().parents[1]
ASSETS = CHECKOUT / "assets"
SPECS_VARIABLE = "TRAPS_SCENE_SPECS"  # names the folder of a sampled benchmark
SCENE_SPECS = Path(os.environ.get(SPECS_VARIABLE) or CHECKOUT / "scene_specs").absolute()
RELEASED = SCENE_SPECS / "released"
CORRECTIONS = SCENE_SPECS / "corrections"


def require_checkout() -> Path:
    """The checkout's root. Raises TrapsError with the remedy when the package was installed without one."""
    for folder in (ASSETS, SCENE_SPECS):
        if not folder.is_dir():
            raise TrapsError(
                f"{folder} is missing: traps runs from a checkout; clone the repository and `pip install -e .` in it"
            )
    return CHECKOUT
