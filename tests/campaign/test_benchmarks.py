"""Every benchmark runs at its small size; what its figures are is nobody's concern here."""

from __future__ import annotations

import subprocess
import sys

import pytest

from tests.conftest import ROOT

pytestmark = pytest.mark.slow
# They need Ray and minutes: tests/integration/test_cluster.py and pipeline/test_lost_runs.py use their parts.
OF_CLUSTERS = {"cluster", "cluster_asking", "cluster_launcher", "cluster_kills", "cluster_study", "cluster_watch"}
PARTS = {"cpu_share", "equality", "launcher_project", "quick"}  # what others import, or what compares two studies
SCRIPTS = sorted({path.stem for path in (ROOT / "bench").glob("*.py")} - OF_CLUSTERS - PARTS)


@pytest.mark.parametrize("name", SCRIPTS)
def test_a_benchmark_runs_at_its_small_size(name: str) -> None:
    command = [sys.executable, ROOT / "bench" / f"{name}.py", "--quick"]
    finished = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert finished.returncode == 0, finished.stdout[-2000:] + finished.stderr[-3000:]
    assert any(character.isdigit() for character in finished.stdout), finished.stdout
