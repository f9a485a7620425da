"""What hosts and editors read of this repository: workflows, hooks, owners, locks. Each names only what there is."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from itertools import takewhile
from pathlib import Path
from typing import Any

import pytest
import yaml

from tests.conftest import ROOT
from tools.lock import outdated
from tools.release import PLACEHOLDERS, TO_FILL

WORKFLOWS = sorted((ROOT / ".github" / "workflows").glob("*.yml"))
MAKEFILES = [ROOT / "Makefile", ROOT / "maintainers.mk"]
TARGETS = {name for file in MAKEFILES for name in re.findall(r"^([a-z-]+):", file.read_text(), re.MULTILINE)}


def steps(workflow: Path) -> list[dict[str, Any]]:
    return [step for job in yaml.safe_load(workflow.read_text())["jobs"].values() for step in job["steps"]]


def make_targets(command: str) -> list[str]:
    """Return the targets of each `make` of a shell command."""
    calls = re.findall(r"\bmake ([^\n;&|]*)", command)
    return [word for call in calls for word in takewhile(lambda word: "=" not in word, call.split())]


@pytest.mark.parametrize("workflow", WORKFLOWS, ids=lambda path: path.stem)
def test_a_workflow_calls_targets_and_programs_that_there_are(workflow: Path) -> None:
    commands = [step["run"] for step in steps(workflow) if "run" in step]
    targets = [target for command in commands for target in make_targets(command)]
    assert targets and {*targets} <= TARGETS
    for program in re.findall(r"\btools/[\w/.-]+", "\n".join(commands)):
        assert (ROOT / program).is_file(), program


def test_a_workflow_has_no_more_rights_than_it_needs_and_puts_no_name_of_a_branch_into_a_shell() -> None:
    for workflow in WORKFLOWS:
        assert yaml.safe_load(workflow.read_text())["permissions"] == {"contents": "read"}, workflow.name
        for step in steps(workflow):
            assert "github." not in step.get("run", ""), (workflow.name, step)


def test_checks_run_on_every_python_that_the_package_admits_and_every_shard_at_night() -> None:
    check, nightly = (
        yaml.safe_load((ROOT / f".github/workflows/{name}.yml").read_text()) for name in ("check", "nightly")
    )
    classifiers = re.findall(r"Python :: (3\.\d+)", (ROOT / "pyproject.toml").read_text())
    assert check["jobs"]["check"]["strategy"]["matrix"]["python"] == classifiers
    shards = nightly["jobs"]["campaign"]["strategy"]["matrix"]["shard"]
    assert shards == [f"{k}/{len(shards)}" for k in range(1, len(shards) + 1)]


def make(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    """Run make of a checkout with this environment's Python, without setting it up."""
    command = ["make", "--no-print-directory", "-o", "setup-core", f"BIN={Path(sys.executable).parent}", *arguments]
    environment = os.environ | {"PYTHONPATH": str(folder)}
    return subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=False)


def test_a_tag_that_is_another_version_and_a_placeholder_that_is_left_stop_a_release() -> None:
    command = [sys.executable, "-m", "hatchling", "version"]
    version = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout.strip()
    another = make(ROOT, "release-check", "TAG=v0.0.1")
    assert another.returncode != 0
    checkout, changelog, *placeholders = [line for line in another.stderr.splitlines() if not line.startswith("make")]
    assert f"v{version}" in checkout and "v0.0.1" in checkout and "CHANGELOG.md" in changelog
    assert {line.partition(":")[0] for line in placeholders} == {*TO_FILL}
    assert checkout not in make(ROOT, "release-check", f"TAG=v{version}").stderr


@pytest.mark.slow
def test_one_command_cuts_a_version_and_leaves_nothing_where_it_cannot(tmp_path: Path) -> None:
    checkout = tmp_path / "checkout"
    git = ["git", "-c", "user.name=t", "-c", "user.email=t@example.org", "-C", str(checkout)]
    subprocess.run(["git", "clone", "--quiet", str(ROOT), str(checkout)], check=True)

    def asked(*command: str) -> str:
        return subprocess.run([*git, *command], check=True, capture_output=True, text=True).stdout

    for key, value in {"user.name": "t", "user.email": "t@example.org"}.items():
        asked("config", key, value)
    head = asked("rev-parse", "HEAD")
    refused = make(checkout, "release", "VERSION=9.0.0")
    assert refused.returncode != 0 and "OWNER" in refused.stderr and "host.invalid" in refused.stderr
    for name in TO_FILL:
        text = (checkout / name).read_text()
        (checkout / name).write_text(PLACEHOLDERS.sub("example", text))
    dirty = make(checkout, "release", "VERSION=9.0.0")
    assert dirty.returncode != 0 and "SECURITY.md" in dirty.stderr and "host.invalid" not in dirty.stderr
    assert (asked("rev-parse", "HEAD"), asked("tag", "--list", "v9*")) == (head, "")
    asked("commit", "--quiet", "--all", "--message", "Name the publisher")
    assert "no version" in make(checkout, "release", "VERSION=9.0.x").stderr
    cut = make(checkout, "release", "VERSION=9.0.0")
    assert cut.returncode == 0, cut.stderr
    assert [path.name for path in sorted((checkout / "dist").iterdir())] == [
        "sbom.json",
        "traps_pipeline-9.0.0-py3-none-any.whl",
    ]
    assert make(checkout, "release-check", "TAG=v9.0.0").returncode == 0
    assert re.search(r"^## 9\.0\.0 - \d{4}-\d\d-\d\d$", (checkout / "CHANGELOG.md").read_text(), re.MULTILINE)
    again = make(checkout, "release", "VERSION=8.9.0")
    assert again.returncode != 0 and "v9.0.0" in again.stderr and "Unreleased" in again.stderr


def test_the_lock_meets_the_project_and_one_that_does_not_is_named(tmp_path: Path) -> None:
    assert [*outdated()] == []
    project = tmp_path / "pyproject.toml"
    text = (ROOT / "pyproject.toml").read_text()
    project.write_text(text.replace('"rich>=15,<16"', '"rich>=16,<17"').replace('"scipy>=1.17,<2"', '"leftpad>=1"'))
    sentences = "\n".join(outdated(project))
    assert "rich" in sentences and "leftpad" in sentences and sentences.count("make lock") == 2


def commit(message: str, folder: Path) -> subprocess.CompletedProcess[str]:
    """Run git with the hook in an empty repository."""
    git = ["git", "-c", "user.name=t", "-c", "user.email=t@t", "-c", f"core.hooksPath={ROOT / 'tools/hooks'}"]
    if not (folder / ".git").is_dir():
        subprocess.run([*git, "init", "-q", folder], check=True)
    command = [*git, "-C", folder, "commit", "-q", "--allow-empty", "--file=-"]
    return subprocess.run(command, input=message, capture_output=True, text=True, check=False)


@pytest.mark.slow
def test_a_message_in_the_form_of_the_page_is_committed(tmp_path: Path) -> None:
    for message in (
        "Add a column for retries",
        "Bring the clips of a study\n\nThey were left behind where a bucket was slow.\n",
        "Pass the seed on\n\n" + "x" * 200,
        "Merge branch 'main' into a-branch-with-a-name-that-is-longer-than-the-seventy-two-characters",
        'Revert "added a column."',
        "Use `inside` in the notebook\n# Added by git.\n",
    ):
        finished = commit(message, tmp_path)
        assert (finished.returncode, finished.stderr) == (0, ""), message


@pytest.mark.slow
def test_another_message_is_refused_by_the_rule_that_it_breaks(tmp_path: Path) -> None:
    told = dict[str, str]()
    for message, named in {
        **{f"{verb} a column": f"'{verb}'" for verb in ("Added", "Adds", "Adding")},
        "fix: a column": "'fix'",
        "Add a column.": "",
        "Add " + "a" * 69: "73",
        "Add a column\nfor retries": "",
    }.items():
        finished = commit(message, tmp_path)
        (told[message],) = finished.stderr.splitlines()
        assert finished.returncode != 0 and named in told[message], message
    assert len({*told.values()}) == len(told)
