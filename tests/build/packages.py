"""Packages from outside, built and installed by pip into a folder of a test."""

from __future__ import annotations

import importlib
import subprocess
import sys
from pathlib import Path

from tests.conftest import ROOT
from traps_pipeline.base.plugins import plugins
from traps_pipeline.scenes import family_registry as registry


def install(source: Path, folder: Path) -> None:
    """Install a package's source into a folder, which a test puts on the path."""
    options = ["--quiet", "--no-deps", "--no-build-isolation", "--no-index", "--disable-pip-version-check"]
    command = [sys.executable, "-m", "pip", "install", *options, "--target", str(folder), str(source)]
    subprocess.run(command, check=True)


def install_soft_bodies(folder: Path) -> None:
    """Install the families of soft bodies for this process, unless `make setup` has."""
    if "soft_rope" not in plugins("families"):
        install(ROOT / "traps_soft_bodies", folder)
        sys.path.append(str(folder))
        importlib.invalidate_caches()
        for cached in (plugins, registry.family_names, registry.get_family, registry.families):
            cached.cache_clear()


def write_package(folder: Path, name: str, code: str, **entry_points: str) -> Path:
    """Write the source of a package of one module; an entry point is its group, and `name = module:object`."""
    folder.mkdir(parents=True)
    (folder / f"{name.replace('-', '_')}.py").write_text(code)
    groups = "".join(f'[project.entry-points."traps.{group}"]\n{line}\n' for group, line in entry_points.items())
    (folder / "pyproject.toml").write_text(
        '[build-system]\nrequires = ["hatchling"]\nbuild-backend = "hatchling.build"\n'
        f'[project]\nname = "{name}"\nversion = "1.2"\n{groups}'
    )
    return folder
