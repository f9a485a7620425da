"""The three tiers of tests, the shards of the last one, and what a test of the first may cost (docs/testing.md).

`make check` runs tests without a mark, `make test` also those marked `promise`, and `make campaign` those that are only
marked `slow`. A test that uses one of the `SERVICES` is slow by itself.
"""

from __future__ import annotations

import ast
import json
import os
import re
import time
from collections import Counter, defaultdict
from collections.abc import Generator, Mapping
from functools import cache
from pathlib import Path
from typing import Any

import pytest

DURATIONS = Path(__file__).with_name("durations.json")  # tier to file to CPU seconds, written by the full campaign
UNKNOWN_S = 5.0  # CPU seconds that a file without a measurement is taken to need
SERVICES = {"demo", "small", "shared_provider", "page", "stored", "whole", "postgres", "s3", "tiny_disk"}
FAST_S = 5.0  # CPU seconds of a test of `make check`, on the machine on which `LOOP_S` was measured
LOOP_S = 0.011  # CPU seconds of `_loop` there
FAST, PROMISED = "not slow and not promise", "promise or not slow"  # what `make check` and `make test` choose
COMPLETE = "TRAPS_TEST_ALL"  # set by `make test` and `make campaign`: only skips that are listed here are accepted
ACCEPTED_SKIPS = {
    r"needs Node": "the explorer's unit tests are for machines that have it; continuous integration does",
    r"there is a GPU": "the test shows the error on a machine without one",
    r"no environment \w+: make environments": "other harnesses are installed by `make environments` before a release",
    r"faults through every stage take an hour": "TRAPS_FAULTS=100 asks for them before a release",
}
CPU = pytest.StashKey[float]()
SHARED_S = [0.0]  # CPU seconds of fixtures of the session, which count for no test


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add the options of the campaign."""
    group = parser.getgroup("tiers")
    group.addoption("--shard", metavar="K/N", help="run the K-th of N parts of the selected tests, of equal CPU time")
    group.addoption("--any-cpu", action="store_true", help="no limit to the CPU time of a fast test")
    group.addoption("--write-durations", action="store_true", help=f"store CPU seconds by file in {DURATIONS.name}")


def tier_of(item: pytest.Item) -> str:
    """Return `check`, `test` or `campaign`."""
    if item.get_closest_marker("promise"):
        return "test"
    return "campaign" if item.get_closest_marker("slow") else "check"


@cache
def durations(tier: str) -> dict[str, float]:
    """Return CPU seconds by test file of a tier, as the last full campaign measured them."""
    return json.loads(DURATIONS.read_text()).get(tier, {}) if DURATIONS.is_file() else {}


def shards(costs: Mapping[str, float], count: int) -> list[list[str]]:
    """Deal names to `count` shards so that their costs are about equal; the same for the same costs."""
    parts, loads = [list[str]() for _ in range(count)], [0.0] * count
    for name in sorted(costs, key=lambda name: (-costs[name], name)):
        least = loads.index(min(loads))
        parts[least].append(name)
        loads[least] += costs[name]
    return parts


def file_of(item: pytest.Item) -> str:
    """Return the file of a test as its id has it."""
    return item.nodeid.partition("::")[0]


def of_shard(items: list[pytest.Item], shard: str) -> list[pytest.Item]:
    """Return the tests of shard `K/N`. Raises UsageError for another form.

    Files that need the demo stay together, since it takes minutes to make; one that takes longer than a shard is dealt
    test by test.
    """
    match = re.fullmatch(r"(\d+)/(\d+)", shard)
    if match is None or not 1 <= int(match[1]) <= int(match[2]):
        raise pytest.UsageError(f"--shard {shard}: give K/N with K from 1 to N, such as 2/6")
    tests, known = Counter(map(file_of, items)), durations("campaign")
    costs = {file: known.get(file, UNKNOWN_S) for file in tests}
    limit = sum(costs.values()) / int(match[2])
    demo = {file_of(item) for item in items if "demo" in getattr(item, "fixturenames", ())}

    def unit(item: pytest.Item) -> str:
        file = file_of(item)
        return "demo" if file in demo else item.nodeid if costs[file] > limit else file

    loads: dict[str, float] = defaultdict(float)
    for item in items:
        loads[unit(item)] += costs[file_of(item)] / tests[file_of(item)]
    chosen = {*shards(loads, int(match[2]))[int(match[1]) - 1]}
    return [item for item in items if unit(item) in chosen]


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """Import no file of which `make check` or `make test` runs nothing: many import torch, which takes seconds."""
    chosen = config.option.markexpr
    if chosen not in (FAST, PROMISED) or not collection_path.match("test_*.py"):
        return None
    text = collection_path.read_text(encoding="utf-8")
    if "pytest.mark.slow" not in text or (chosen == PROMISED and "pytest.mark.promise" in text):
        return None
    return any(ast.unparse(line) == "pytestmark = pytest.mark.slow" for line in ast.parse(text).body) or None


@pytest.hookimpl(wrapper=True)
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> Generator[None, None, None]:
    """Mark what needs a service as slow; after `-m` chose, take the shard, and put files that take long first."""
    for item in items:
        if SERVICES & set(getattr(item, "fixturenames", ())):
            item.add_marker(pytest.mark.slow)
    yield
    if shard := config.getoption("--shard"):
        chosen = of_shard(items, shard)
        taken = {id(item) for item in chosen}
        config.hook.pytest_deselected(items=[item for item in items if id(item) not in taken])
        items[:] = chosen
    costs: dict[str, float] = defaultdict(float)
    for item in items:
        costs[file_of(item)] = max(costs[file_of(item)], durations(tier_of(item)).get(file_of(item), 0.0))
    items.sort(key=lambda item: tier_of(item) == "check")
    items[:] = in_slices(items, costs, int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", "1")))


def in_slices(items: list[pytest.Item], costs: Mapping[str, float], workers: int) -> list[pytest.Item]:
    """Order tests for `--dist worksteal`, which first deals equal slices: each begins with what takes long.

    costs: CPU seconds by file. Tests of a file stay together where its slice has room.
    """
    files: dict[str, list[pytest.Item]] = defaultdict(list)
    for item in items:
        files[file_of(item)].append(item)
    slices, loads, rooms = [list[pytest.Item]() for _ in range(workers)], [0.0] * workers, list[int]()
    for k in range(workers):
        rooms.append((len(items) - sum(rooms)) // (workers - k))
    for name in sorted(files, key=lambda name: -costs[name]):
        chosen = -1
        for item in files[name]:
            if chosen < 0 or len(slices[chosen]) == rooms[chosen]:
                free = [k for k in range(workers) if len(slices[k]) < rooms[k]]
                chosen = min(free, key=lambda k: loads[k])
            slices[chosen].append(item)
            loads[chosen] += costs[name] / len(files[name])
    return [item for part in slices for item in part]


# --- what a test costs ------------------------------------------------------------------------------------------------


def cpu_s() -> float:
    """Return the CPU seconds of this process and of its children that have ended."""
    times = os.times()
    return times.user + times.system + times.children_user + times.children_system


@cache
def slowness() -> float:
    """Return how many times slower this machine is than the one of `LOOP_S`; at least 1."""

    def _loop() -> float:
        began = time.process_time()
        sum(i * i for i in range(300_000))
        return time.process_time() - began

    return max(1.0, min(_loop() for _ in range(3)) / LOOP_S)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_setup(item: pytest.Item) -> Generator[None, object, object]:
    """Note the CPU seconds before the test."""
    item.stash[CPU], SHARED_S[0] = cpu_s(), 0.0
    return (yield)


@pytest.hookimpl(wrapper=True)
def pytest_fixture_setup(fixturedef: pytest.FixtureDef[Any]) -> Generator[None, object, object]:
    """Note what fixtures of the session take."""
    began = cpu_s()
    result = yield
    if fixturedef.scope == "session":
        SHARED_S[0] += cpu_s() - began
    return result


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call(item: pytest.Item) -> Generator[None, object, object]:
    """Fail a test of `make check` that takes too much CPU time, its own fixtures included."""
    result = yield
    took = cpu_s() - item.stash[CPU] - SHARED_S[0]
    limited = tier_of(item) == "check" and not item.config.getoption("--any-cpu")
    if limited and took > FAST_S and took > FAST_S * slowness():
        pytest.fail(f"took {took:.1f} s of CPU, of {FAST_S:.0f} s: mark it slow, or promise", pytrace=False)
    return result


@pytest.hookimpl(wrapper=True)
def pytest_runtest_teardown(item: pytest.Item) -> Generator[None, object, object]:
    """Attach tier and CPU seconds to the report, which xdist brings to the process that writes them."""
    result = yield
    item.user_properties.append(("cpu", [tier_of(item), cpu_s() - item.stash[CPU]]))
    return result


class Durations:
    """CPU seconds by tier and file, collected from the reports of all workers."""

    def __init__(self) -> None:
        self.of: dict[str, dict[str, float]] = {"check": {}, "test": {}, "campaign": {}}

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Add what a test took."""
        if report.when == "teardown":
            for tier, took in (value for name, value in report.user_properties if name == "cpu"):  # pyright: ignore
                files = self.of[tier]
                file = report.nodeid.partition("::")[0]
                files[file] = files.get(file, 0.0) + took

    def pytest_sessionfinish(self, session: pytest.Session, exitstatus: int) -> None:
        """Store them, if this is the full campaign and it came to its end."""
        ended = exitstatus in (pytest.ExitCode.OK, pytest.ExitCode.TESTS_FAILED)
        if ended and session.config.getoption("--write-durations"):
            known = json.loads(DURATIONS.read_text()) if DURATIONS.is_file() else {}
            for tier in ("test", "campaign"):
                files = known.get(tier, {}) | self.of[tier]
                kept = {file: round(took, 1) for file, took in sorted(files.items()) if Path(file).is_file()}
                known[tier] = kept
            DURATIONS.write_text(json.dumps(known, indent=1) + "\n")

    def pytest_terminal_summary(self, terminalreporter: Any) -> None:
        """Say what each tier took, and the dearest files."""
        for tier, files in self.of.items():
            if files:
                dearest = sorted(files, key=lambda file: -files[file])[:5]
                told = ", ".join(f"{file.removeprefix('tests/')} {files[file]:.0f}" for file in dearest)
                terminalreporter.write_line(f"{tier}: {sum(files.values()):.0f} s of CPU in tests; most in {told}")


def pytest_configure(config: pytest.Config) -> None:
    """Collect what tests take where reports arrive: not in a worker of xdist."""
    if not hasattr(config, "workerinput"):
        config.pluginmanager.register(Durations(), "durations-of-tiers")


# --- what is skipped --------------------------------------------------------------------------------------------------


def is_accepted(reason: str) -> bool:
    """Return whether a complete run accepts that a test is skipped for this reason."""
    return any(re.search(pattern, reason) for pattern in ACCEPTED_SKIPS)


def _refuse(report: pytest.TestReport | pytest.CollectReport) -> None:
    """Make a failure of a skip that a complete run does not accept."""
    if report.skipped and os.environ.get(COMPLETE) and not hasattr(report, "wasxfail"):
        reason = str(report.longrepr[-1]) if isinstance(report.longrepr, tuple) else str(report.longrepr)
        if not is_accepted(reason):
            report.outcome = "failed"
            report.longrepr = f"{reason} ({COMPLETE} is set: only skips of tests/tiers.py are accepted)"


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport() -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """Refuse skips of tests in a complete run."""
    report = yield
    _refuse(report)
    return report


@pytest.hookimpl(wrapper=True)
def pytest_make_collect_report() -> Generator[None, pytest.CollectReport, pytest.CollectReport]:
    """Refuse skips of whole files in a complete run."""
    report = yield
    _refuse(report)
    return report


def pytest_terminal_summary(terminalreporter: Any) -> None:
    """Name each skipped test and why: what did not run was not tested."""
    for report in terminalreporter.stats.get("skipped", ()):
        terminalreporter.write_line(f"not run: {report.nodeid}: {report.longrepr[-1]}")
