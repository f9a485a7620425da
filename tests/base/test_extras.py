"""A command installs what it needs: extras and locks agree with each other, and a missing extra is one sentence."""

from __future__ import annotations

import json
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from tests.conftest import ROOT
from traps_pipeline.base.extras import EXTRAS, ExtraName

PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
# Of modules whose package has another name.
OWN = {"traps_cluster"}  # in no index: a distribution of this repository
DISTRIBUTIONS = {"dagster_webserver": "dagster-webserver", "model_signing": "model-signing"}
BLOCK = "import sys; sys.modules.update(dict.fromkeys({blocked!r}))"  # to Python's imports these are not there


def named(requirements: list[str]) -> set[str]:
    return {re.match(r"[\w.-]+", line)[0].lower() for line in requirements}  # type: ignore[index]


def pins(lock: Path) -> dict[tuple[str, str], set[str]]:
    """Hashes of each file that a lock takes, by name and version."""
    found = {}
    for entry in re.split(r"\n(?=\w)", lock.read_text()):
        pin, *hashes = entry.replace("\\\n", "").split("--hash=")
        (name, version) = re.match(r"([\w.-]+)(?:\[.*\])?==([^ ;]+)", pin).groups()  # type: ignore[union-attr]
        found[name, version] = {one.strip() for one in hashes}
    return found


def test_every_module_of_an_extra_is_in_that_extra_of_the_package() -> None:
    extras = PROJECT["optional-dependencies"]
    for name, extra in EXTRAS.items():
        assert {DISTRIBUTIONS.get(module, module) for module in extra.modules} - OWN <= named(extras[name]), name
    (everything,) = extras["all"]
    assert {*EXTRAS} - {"sign", "cluster"} == set(re.findall(r"[\w-]+", everything.partition("[")[2]))


def test_the_lock_of_the_demo_is_a_part_of_the_whole_lock_and_holds_what_the_package_names() -> None:
    core, everything = pins(ROOT / "requirements-core.lock"), pins(ROOT / "requirements.lock")
    assert {pin: everything.get(pin) for pin in core} == core
    distributions = {name for name, _ in core}
    assert named(PROJECT["dependencies"]) <= distributions
    optional = {DISTRIBUTIONS.get(module, module) for extra in EXTRAS.values() for module in extra.modules}
    assert not optional & distributions
    assert optional - OWN - {"torch", "model-signing"} <= {name for name, _ in everything}
    assert all(everything.values())


def test_pylock_holds_the_pins_and_hashes_of_the_lock_and_no_address() -> None:
    text = (ROOT / "pylock.toml").read_text()
    assert "://" not in text
    locked = pins(ROOT / "requirements.lock")
    packages = tomllib.loads(text)["packages"]
    assert {(one["name"], one["version"]) for one in packages} == {*locked}
    for one in packages:
        files = [*one.get("wheels", ()), *filter(None, [one.get("sdist")])]
        hashes = {f"sha256:{file['hashes']['sha256']}" for file in files}
        assert hashes and hashes <= locked[one["name"], one["version"]]
        assert all(re.fullmatch(r"wheels/[^/]+", file["path"]) for file in files)


@pytest.mark.slow
def test_the_bill_of_materials_names_every_pin_and_is_written_twice_to_the_same_bytes(tmp_path: Path) -> None:
    for out in (tmp_path / "a.json", tmp_path / "b.json"):
        subprocess.run([sys.executable, "tools/sbom.py", out], cwd=ROOT, check=True, capture_output=True)
    assert (tmp_path / "a.json").read_bytes() == (tmp_path / "b.json").read_bytes()
    components = json.loads((tmp_path / "a.json").read_text())["components"]
    hashes = {
        (one["name"], one["version"]): {f"sha256:{file['hashes'][0]['content']}" for file in one["externalReferences"]}
        for one in components
    }
    assert len(components) == len(hashes) and all(one["licenses"] for one in components if one["name"] == "numpy")
    assert hashes == {pin: found & hashes[pin] for pin, found in pins(ROOT / "requirements.lock").items()}


@pytest.mark.parametrize(
    ("name", "blocked"),
    [("api", ["litellm"]), ("web", ["fastapi", "uvicorn"])],
)
def test_a_missing_extra_is_one_sentence_with_the_line_to_type(name: ExtraName, blocked: list[str]) -> None:
    line = f"from traps_pipeline.base.extras import require_extra; require_extra({name!r})"
    code = f"{BLOCK.format(blocked=blocked)}\n{line}"
    finished = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True)
    assert finished.returncode == 1
    told = finished.stderr.splitlines()[-1]
    assert [one for one in (*EXTRAS[name].modules, "`make setup`") if one in told] == [*blocked, "`make setup`"]


@pytest.mark.slow
def test_an_import_that_nobody_looked_after_is_told_in_the_same_sentence(tmp_path: Path) -> None:
    program = "import runpy; runpy.run_module('tools.pocket', run_name='__main__')"
    code = f"{BLOCK.format(blocked=['torch'])}\nsys.path.insert(0, '.'); {program}"
    arguments = ["train", "--data", tmp_path / "data", "--out", tmp_path / "out"]
    finished = subprocess.run([sys.executable, "-c", code, *arguments], cwd=ROOT, capture_output=True, text=True)
    assert (finished.returncode, finished.stdout) == (1, "")
    (told,) = finished.stderr.splitlines()
    assert told.startswith("traps: ") and " torch" in told and "`make setup`" in told
