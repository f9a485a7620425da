"""Puts the repository's data folders into the wheel, below the package, where `base/paths.py` looks for them.

An editable installation gets none of them: it reads the checkout's own.
"""

from __future__ import annotations

from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface

SHIPPED = ("assets", "scene_specs", "LICENSE-DATA", "CITATION.cff")


class Shipped(BuildHookInterface):
    """Asked by hatchling before it writes a wheel."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Add the folders and files to a wheel. version: "standard", or "editable"."""
        if version == "standard":
            build_data["force_include"] |= {name: f"traps_pipeline/shipped/{name}" for name in SHIPPED}
