"""The wheel: what is in it, that its bytes are the same each time, and that it works without a checkout."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import venv
import zipfile
from importlib.metadata import distributions
from pathlib import Path

import pytest

from tests.build.packages import install
from tests.conftest import ROOT, Finished
from traps_pipeline.base.extras import EXTRAS, ExtraName

pytestmark = pytest.mark.slow
SHIPPED = "traps_pipeline/shipped"
EXPERIMENT = """
name: tiny
description: Two reference models on two scenarios.
models: [oracle, always-abstain]
regimes: [standard]
panel: rules
epoch: tiny
scenarios: [domino_chain-0001, hidden_race-0001]
"""
NEEDING: dict[str, ExtraName] = {  # an experiment, and the extra that it wants
    "models: [pocket]\npanel: rules\njudged_by_rules: true": "local",
    "models: [gpt-5-mini]\npanel: paper": "api",
}


def build(folder: Path, *, umask: int = 0o022) -> Path:
    """The wheel of this checkout, built without a network."""
    command = [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", folder]
    subprocess.run(command, cwd=ROOT, check=True, capture_output=True, umask=umask)
    (wheel,) = folder.glob("*.whl")
    return wheel


class Installed:
    """A wheel in an environment of its own, which sees the packages of `requirements-core.lock` and no others."""

    def __init__(self, wheel: Path, folder: Path) -> None:
        self.folder, self.work = folder, folder / "elsewhere"
        self.work.mkdir(parents=True)
        venv.create(folder / "venv", with_pip=False)
        self.python = folder / "venv" / "bin" / "python"
        (site,) = (folder / "venv").glob("lib/python*/site-packages")
        (site / "core.pth").write_text(f"{self._core()}\n")
        pip = [sys.executable, "-m", "pip", "--python", self.python, "install", "--no-index", "--no-deps", wheel]
        subprocess.run(pip, check=True, capture_output=True)
        self.shipped = site / SHIPPED

    def _core(self) -> Path:
        """A folder of links to the packages of the demo's lock, as they are installed here."""
        wanted = set(re.findall(r"^([\w.-]+)", (ROOT / "requirements-core.lock").read_text(), re.MULTILINE))
        core = self.folder / "core"
        core.mkdir()
        for one in distributions():
            if re.sub(r"[-_.]+", "-", one.metadata["Name"]).lower() not in wanted:
                continue
            tops = {file.parts[0] for file in one.files or () if file.parts[0] not in ("..", "__pycache__")}
            for top in tops - {path.name for path in core.iterdir()}:
                (core / top).symlink_to(Path(str(one.locate_file(top))))
        return core

    def run(self, *command: str | Path, **variables: str) -> Finished:
        """Run a command in a folder that is no checkout."""
        environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
        environment |= {"TRAPS_WORKSPACE": str(self.work / "study"), **variables}
        finished = subprocess.run(
            list(map(str, command)), cwd=self.work, env=environment, capture_output=True, text=True, check=False
        )
        return Finished(finished.returncode, finished.stdout, finished.stderr)

    def traps(self, *arguments: str | Path, **variables: str) -> Finished:
        """Run the command that pip installed."""
        return self.run(self.python.with_name("traps"), *arguments, **variables)


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return build(tmp_path_factory.mktemp("wheel"))


@pytest.fixture(scope="module")
def installed(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Installed:
    return Installed(wheel, tmp_path_factory.mktemp("installed"))


def test_a_second_build_gives_the_same_bytes_whatever_the_mode_of_new_files(wheel: Path, tmp_path: Path) -> None:
    assert build(tmp_path, umask=0o077).read_bytes() == wheel.read_bytes()


def test_the_wheel_holds_the_package_and_its_data_and_nothing_else(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        inside = {name: archive.read(name) for name in archive.namelist() if ".dist-info/" not in name}
        metadata = next(archive.read(name).decode() for name in archive.namelist() if name.endswith("/METADATA"))
    data = [path for name in ("assets", "scene_specs") for path in sorted((ROOT / name).rglob("*")) if path.is_file()]
    data += [ROOT / "LICENSE-DATA", ROOT / "CITATION.cff"]
    code = sorted((ROOT / "traps_pipeline").rglob("*.py"))
    assert len(data) > 700 and len(code) > 250
    expected = {f"{SHIPPED}/{path.relative_to(ROOT).as_posix()}": path.read_bytes() for path in data}
    expected |= {path.relative_to(ROOT).as_posix(): path.read_bytes() for path in code}
    rest = {*inside} - {*expected}
    assert {name: inside.get(name) for name in expected} == expected
    assert "traps_pipeline/py.typed" in rest and "traps_pipeline/report/templates/report.html.j2" in rest
    assert {Path(name).suffix for name in rest} == {".typed", ".j2", ".js", ".css", ".sha256"}
    assert re.search(r"^License-Expression: Apache-2.0 AND CC-BY-4.0 AND CC-BY-NC-4.0$", metadata, re.MULTILINE)
    assert "Requires-Python: <3.14,>=3.11" in metadata


def test_the_package_for_several_hosts_is_a_wheel_of_its_own_and_its_absence_is_one_sentence(
    installed: Installed, tmp_path: Path
) -> None:
    install(ROOT / "traps_cluster", tmp_path)
    own = {path.name for path in (ROOT / "traps_cluster").glob("*.py")}
    assert {path.name for path in (tmp_path / "traps_cluster").glob("*.py")} == own
    (metadata,) = tmp_path.glob("traps_cluster-*.dist-info/METADATA")
    assert "Requires-Dist: traps-pipeline[cluster]" in metadata.read_text()
    refused = installed.traps("init", "demo", "--database", "LAB_DATABASE", "--workspace", "s")
    assert refused.code != 0 and "traps-cluster" in refused.err and "Traceback" not in refused.err


def test_an_installed_wheel_makes_a_leaderboard_in_a_folder_that_is_no_checkout(installed: Installed) -> None:
    assert installed.traps("--help").out.startswith("usage: traps")
    looked = installed.traps("doctor").ok()
    assert f"{installed.shipped}: trapsbench 0.4.0, 702 scenarios" in looked.out
    (installed.work / "tiny.yaml").write_text(EXPERIMENT)
    finished = installed.traps("run", "tiny.yaml", "--until", "leaderboard").ok()
    # Two models, an occlusion scenario each with its ill-posed twin: 2 x 2 x (2 pairs of 2 items).
    assert finished.counts()["answers"] == 2 * 2 * 4
    assert not [path for path in installed.shipped.rglob("*") if path.name == "__pycache__"]


@pytest.mark.parametrize("wants", NEEDING)
def test_a_study_that_wants_more_says_so_before_it_renders(installed: Installed, wants: str) -> None:
    name = re.findall(r"\w+", wants)[1]
    (installed.work / f"{name}.yaml").write_text(
        f"name: {name}\n{wants}\nregimes: [standard]\nscenarios: [domino_chain-0001]\n"
    )
    folder = installed.work / name
    for options in ([], ["--no-preflight"]):
        finished = installed.traps("run", f"{name}.yaml", "--workspace", folder, *options)
        assert finished.code == 1
        extra = NEEDING[wants]
        named = [*EXTRAS[extra].modules, f"`python -m pip install 'traps-pipeline[{extra}]'`"]
        assert finished.err.startswith("traps: ") and [one for one in named if one not in finished.err] == []
        assert not [*(folder / "clips").rglob("*.mp4")]


@pytest.mark.parametrize(("command", "extra"), [("ui", "ui"), ("people review", "web"), ("people annotate", "web")])
def test_a_command_that_wants_more_is_one_sentence(installed: Installed, command: str, extra: str) -> None:
    finished = installed.traps(*command.split())
    assert (finished.code, finished.out) == (1, "")
    assert len(finished.err.splitlines()) == 1
    assert finished.err.endswith(f"`python -m pip install 'traps-pipeline[{extra}]'`\n")


def test_the_shipped_benchmark_is_not_changed_and_a_copy_of_it_is(installed: Installed) -> None:
    code = (
        "from datetime import date; from traps_pipeline.base.errors import TrapsError\n"
        "from traps_pipeline.benchmark.decisions import Correction, save_decision\n"
        "kept = Correction(scenario_id='plinko-0001', action='keep', who='jd', when=date(2026, 11, 22), why='test')\n"
        "try: save_decision(kept, 0)\n"
        "except TrapsError as error: raise SystemExit(str(error))"
    )
    before = {path: path.stat().st_mtime_ns for path in installed.shipped.rglob("*")}
    refused = installed.run(installed.python, "-c", code)
    assert refused.code == 1
    assert str(installed.shipped / "scene_specs") in refused.err and "TRAPS_SCENE_SPECS" in refused.err
    assert {path: path.stat().st_mtime_ns for path in installed.shipped.rglob("*")} == before
    subprocess.run(["cp", "-r", installed.shipped / "scene_specs", installed.work / "mine"], check=True)
    installed.run(installed.python, "-c", code, TRAPS_SCENE_SPECS=str(installed.work / "mine")).ok()
    assert '"plinko-0001"' in (installed.work / "mine" / "corrections" / "review.jsonl").read_text()
