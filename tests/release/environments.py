"""Pythons of environments of their own, in which the libraries and harnesses that others use are installed.

`make environments` makes them; a variable may name another one. Where one is not there, its tests are skipped by name.
"""

from __future__ import annotations

import os
import subprocess
from pathlib import Path

import pytest

from tests.conftest import ROOT

FOLDER = ROOT / ".workspaces" / "environments"


def python_of(name: str) -> str:
    """The Python of `hub`, `sign`, `inspect`, `lmms` or `eval`; skips the test where it is not there."""
    variable = f"TRAPS_TEST_{name.upper()}"
    found = Path(os.environ.get(variable) or FOLDER / name / "bin" / "python")
    if not found.is_file():
        pytest.skip(f"no environment {name}: make environments, or set {variable} to its Python")
    return str(found)


def run_in(name: str, *arguments: str | Path, folder: Path | None = None, **variables: str) -> str:
    """What the Python of an environment prints, offline and without this checkout on its path, in a folder."""
    environment = {key: value for key, value in os.environ.items() if not key.startswith(("PYTHON", "TRAPS"))}
    environment |= {"HF_HUB_OFFLINE": "1", "HF_DATASETS_OFFLINE": "1"} | variables
    finished = subprocess.run(
        [python_of(name), *map(str, arguments)],
        cwd=folder,
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert finished.returncode == 0, finished.stdout[-3000:] + finished.stderr[-3000:]
    return finished.stdout
