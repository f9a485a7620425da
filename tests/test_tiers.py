"""Tiers, shards, the guard over fast tests, and the skips that a complete run accepts."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from tests import tiers
from tests.conftest import ROOT

COSTS = {"a": 50.0, "b": 30.0, "c": 30.0, "d": 20.0, "e": 10.0}
TESTS = """
import time
import pytest

def burn():
    end = time.process_time() + 0.6
    while time.process_time() < end:
        pass

def test_quick(): pass
def test_dear(): burn()
@pytest.mark.slow
def test_slow(): burn()
@pytest.mark.slow
@pytest.mark.promise
def test_promise(): burn()
def test_lacking(): pytest.skip("strace is not installed")
def test_accepted(): pytest.skip("there is a GPU")
"""
RUN = """
import sys, pytest
from tests import tiers
tiers.FAST_S, tiers.slowness = 0.5, lambda: 1.0  # on a machine twice as slow, 0.6 s of work would be within the limit
sys.exit(pytest.main([*sys.argv[1:], "-p", "no:cacheprovider", "--strict-markers", "-rA"], plugins=[tiers]))
"""


def test_shards_hold_each_file_once_and_cost_the_same() -> None:
    parts = tiers.shards(COSTS, 3)
    assert parts == [["a"], ["b", "d"], ["c", "e"]]  # 50, 50, 40
    assert sorted(name for part in parts for name in part) == sorted(COSTS)
    assert tiers.shards(COSTS, 1) == [["a", "b", "c", "d", "e"]]
    assert tiers.shards({"a": 1.0}, 2) == [["a"], []]


def test_a_file_that_takes_longer_than_a_shard_is_dealt_by_its_tests(monkeypatch: pytest.MonkeyPatch) -> None:
    costs = {"a": 60.0, "b": 20.0, "c": 10.0, "d": 10.0}  # 50 a shard
    monkeypatch.setattr(tiers, "durations", {"campaign": costs}.__getitem__)
    names = ("a::1", "a::2", "a::3", "b::1", "b::2", "c::1", "d::1")
    tests: list[Any] = [SimpleNamespace(nodeid=name, fixturenames=["demo"] * (name[0] in "cd")) for name in names]
    first, second = ({test.nodeid for test in tiers.of_shard(tests, shard)} for shard in ("1/2", "2/2"))
    assert first == {"a::1", "a::3", "c::1", "d::1"} and second == {"a::2", "b::1", "b::2"}


def test_each_worker_begins_with_what_takes_long() -> None:
    tests: list[Any] = [SimpleNamespace(nodeid=name) for name in ("c::1", "c::2", "c::3", "b::1", "a::1", "a::2")]
    ordered = tiers.in_slices(tests, {"a": 50.0, "b": 30.0, "c": 0.0}, 2)
    assert [test.nodeid for test in ordered[:3]] == ["a::1", "a::2", "c::3"]
    assert [test.nodeid for test in ordered[3:]] == ["b::1", "c::1", "c::2"]
    assert tiers.in_slices(tests, dict.fromkeys("abc", 0.0), 1) == tests


@pytest.mark.parametrize("shard", ["0/3", "4/3", "2", "2/0", "a/b"])
def test_a_shard_that_there_is_not_is_refused(shard: str) -> None:
    with pytest.raises(pytest.UsageError, match="K/N"):
        tiers.of_shard([], shard)


@pytest.mark.slow
@pytest.mark.promise
@pytest.mark.parametrize(
    ("selection", "complete", "passed", "failed"),
    [
        (tiers.PROMISED, False, {"test_quick", "test_promise"}, {"test_dear"}),
        ("slow and not promise", False, {"test_slow"}, set()),
        (tiers.FAST, True, {"test_quick"}, {"test_dear", "test_lacking"}),
    ],
)
def test_a_tier_has_its_tests_and_fails_those_that_are_too_dear_or_lack_something(
    selection: str, complete: bool, passed: set[str], failed: set[str], tmp_path: Path
) -> None:
    (tmp_path / "test_tier.py").write_text(TESTS)
    if selection in (tiers.FAST, tiers.PROMISED):
        (tmp_path / "test_heavy.py").write_text("import pytest\npytestmark = pytest.mark.slow\nassert not 'imported'\n")
    (tmp_path / "pytest.ini").write_text("[pytest]\nmarkers =\n  slow: x\n  promise: x\n")
    environment = {name: value for name, value in os.environ.items() if not name.startswith(("PYTEST", "TRAPS"))}
    environment |= {"PYTHONPATH": str(ROOT)} | ({tiers.COMPLETE: "1"} if complete else {})
    command = [sys.executable, "-c", RUN, tmp_path, "-m", selection]
    finished = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)
    assert "imported" not in finished.stdout
    lines = [line.split() for line in finished.stdout.splitlines() if line.startswith(("PASSED ", "FAILED "))]
    assert {words[1].partition("::")[2] for words in lines if words[0] == "PASSED"} == passed, finished.stdout
    assert {words[1].partition("::")[2] for words in lines if words[0] == "FAILED"} == failed, finished.stdout
    assert "test_tier.py::test_accepted: Skipped: there is a GPU" in finished.stdout or "slow and" in selection


def test_every_promise_of_the_page_has_its_test() -> None:
    listed = re.findall(
        r"^\|(.*)\| `([\w/]+\.py)::(\w+)` \|$", (ROOT / "docs" / "testing.md").read_text(), re.MULTILINE
    )
    assert len(listed) > 35
    for told, file, name in listed:
        source = (ROOT / "tests" / file).read_text()
        assert f"def {name}(" in source, (file, name)
        assert "|" in told or "mark.promise" in source, (file, name)  # of those with a page, any tier


@pytest.mark.promise
def test_what_all_tests_import_loads_no_library_that_takes_seconds() -> None:
    code = "import tests.conftest, sys; print(sorted({'dagster', 'aiohttp', 'pandas', 'torch'} & set(sys.modules)))"
    finished = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert finished.stdout.strip() == "[]"
