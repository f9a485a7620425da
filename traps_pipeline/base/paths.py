"""Locate the files that belong to the code: `assets/` and `scene_specs/`.

They are top-level folders of the repository, and a wheel carries them inside the package (`SHIPPED`). Every reader asks
this module, so that the same code runs from a checkout and from a wheel.
"""

import os
import re
from pathlib import Path

from traps_pipeline.base.errors import TrapsError

PACKAGE = Path(__file__).resolve().parents[1]
SHIPPED = PACKAGE / "shipped"  # only in an installed wheel; hatch_build.py puts it there
IS_INSTALLED = SHIPPED.is_dir()
ROOT = SHIPPED if IS_INSTALLED else PACKAGE.parent
ASSETS = ROOT / "assets"
SPECS_VARIABLE = "TRAPS_SCENE_SPECS"  # names the folder of a sampled benchmark
OWN_SPECS = ROOT / "scene_specs"  # the specs shipped with this version
SCENE_SPECS = Path(os.environ.get(SPECS_VARIABLE) or OWN_SPECS).absolute()
RELEASED = SCENE_SPECS / "released"
TWO_EVENTS_RELEASED = SCENE_SPECS / "two_events" / "released"
CORRECTIONS = SCENE_SPECS / "corrections"
# Default output of commands: in the checkout, else below the current folder.
WORKSPACES = (Path.cwd() if IS_INSTALLED else ROOT) / ".workspaces"
_NO_ADDRESS = re.compile(r"\?|%[0-9A-Fa-f]{2}")


def user_cache() -> Path:
    """Return this user's cache folder, for files that can be rebuilt."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache").absolute() / "traps"


def user_state() -> Path:
    """Return this user's folder of notes that must outlive any one study."""
    return Path(os.environ.get("XDG_STATE_HOME") or Path.home() / ".local" / "state").absolute() / "traps"


def require_root() -> Path:
    """Return the folder of `assets/` and `scene_specs/`. Raises TrapsError if missing."""
    for folder in (ASSETS, SCENE_SPECS):
        if not folder.is_dir():
            raise TrapsError(
                f"{folder} is missing: install the wheel again, or clone the repository and `pip install -e .` in it"
            )
    return ROOT


def require_own(path: Path, instead: str) -> Path:
    """Return the path if it is the user's own to change.

    instead: what to do otherwise. Raises TrapsError for a file or folder of an installed wheel: the next installation
    would overwrite the change, and two studies would differ although they name the same version.
    """
    if IS_INSTALLED and path.is_relative_to(SHIPPED):
        raise TrapsError(f"{path}: came with the installed package and is not changed; {instead}")
    return path


def require_own_corrections(folder: Path = CORRECTIONS) -> Path:
    """Return the corrections folder; raise TrapsError unless decisions may go there."""
    return require_own(
        folder, f"copy {OWN_SPECS} to a folder of your own, set {SPECS_VARIABLE} to it, and decide there"
    )


def require_history_path(folder: Path) -> None:
    """Raise TrapsError if Dagster, which puts it into a URL, cannot store its history below a folder."""
    if match := _NO_ADDRESS.search(str(folder.absolute())):
        raise TrapsError(
            f"{str(folder)!r}: the path holds {match[0]!r}, below which Dagster cannot keep its history; choose a path "
            "without it (TRAPS_WORKSPACE, --workspace or DAGSTER_HOME)"
        )
