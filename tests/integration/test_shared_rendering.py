"""Processes of `traps run` that want the clips of one category at once."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from dagster import AssetKey, DagsterInstance

from tests.conftest import Checkout, make_checkout
from traps_pipeline.pipeline.step import TAKEN
from traps_pipeline.storage.benchmark_tables import VIDEOS

pytestmark = pytest.mark.slow
SCENARIOS = 5
EXPERIMENT = f"""
name: shared
description: One category.
models: [oracle]
regimes: [standard]
panel: rules
scenarios: [{", ".join(f"plinko-{n:04d}" for n in range(1, SCENARIOS + 1))}]
"""


def start(checkout: Checkout) -> subprocess.Popen[str]:
    command = (sys.executable, "-m", "traps_pipeline.cli", "run", "shared.yaml", "--until", "videos")
    return checkout.start("env", "TRAPS_CORES=1", *command)


def frames(process: subprocess.Popen[str]) -> int:
    out, err = process.communicate()
    assert process.returncode == 0, err
    found = re.search(r"(\d+) frames rendered", out)
    assert found, out
    return int(found[1])


def notes(study: Path) -> dict[str, int]:
    """Frames of each clip that is finished."""
    found = (study / "clips").rglob("*.json")
    return {str(path.relative_to(study)): json.loads(path.read_text())["n_frames"] for path in found}


def contents(study: Path) -> dict[str, bytes]:
    paths = [*(study / "clips").rglob("*"), *(study / "tables").rglob("*")]
    whole = (path for path in paths if path.is_file() and not path.name.startswith("."))  # a kill leaves a hidden part
    return {str(path.relative_to(study)): path.read_bytes() for path in whole}


def test_two_share_what_a_killed_one_has_left_and_it_is_what_one_alone_makes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    root = make_checkout(tmp_path / "checkout")
    (root / "shared.yaml").write_text(EXPERIMENT)
    study, alone = Checkout(root, tmp_path / "study"), Checkout(root, tmp_path / "alone")
    killed = start(study)
    while len(notes(study.workspace)) < 4:  # in the middle of the second scenario
        assert killed.poll() is None, killed.communicate()
        time.sleep(0.02)
    os.killpg(killed.pid, signal.SIGKILL)
    killed.communicate()
    left = notes(study.workspace)
    shares = [frames(process) for process in (start(study), start(study))]
    whole = frames(start(alone))
    # A truncated void is a part of its control, which is drawn once more where the kill came between them.
    drawn = [count for name, count in left.items() if "/void-" not in name]
    assert min(shares) > 0 and 0 <= sum(shares) + sum(drawn) - whole <= max(drawn)
    assert contents(study.workspace) == contents(alone.workspace)
    monkeypatch.setenv("DAGSTER_HOME", str(study.workspace / "dagster"))
    with DagsterInstance.get() as instance:
        told = instance.fetch_materializations(AssetKey(VIDEOS.name), limit=10).records
    assert sorted(TAKEN in one.asset_materialization.metadata for one in told if one.asset_materialization) == [
        False, True
    ]  # fmt: skip
    assert len(notes(alone.workspace)) == 3 * SCENARIOS
