"""A command whose output is not read any more ends quietly with 130, also when only the last flush finds that out."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests.conftest import ROOT, Checkout


def ended(*arguments: str, closed: tuple[str, ...]) -> tuple[int, str, str]:
    """Exit code, stdout and stderr of a `traps` command; `closed` names the streams that nobody reads."""
    reading, writing = os.pipe()
    os.close(reading)
    out, err = (writing if name in closed else subprocess.PIPE for name in ("stdout", "stderr"))
    command = [sys.executable, "-m", "traps_pipeline.cli", *arguments]
    done = subprocess.run(command, cwd=ROOT, text=True, check=False, stdout=out, stderr=err)
    os.close(writing)
    return done.returncode, done.stdout or "", done.stderr or ""


@pytest.mark.slow
@pytest.mark.parametrize(
    ("arguments", "closed"),
    [
        (("init", "demo"), ("stdout",)),
        (("models", "check", "oracle"), ("stdout",)),
        (("status",), ("stderr",)),
        (("status",), ("stdout", "stderr")),
    ],
)
def test_what_nobody_reads_is_no_failure_and_no_traceback(
    arguments: tuple[str, ...], closed: tuple[str, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TRAPS_WORKSPACE", str(tmp_path / "study"))
    assert ended(*arguments, closed=closed) == (130, "", "")


@pytest.mark.parametrize(("arguments", "unbuffered"), [(("run", "--help"), "1"), (("no-such-command",), "")])
def test_a_help_or_a_complaint_that_nobody_reads_is_none(
    arguments: tuple[str, ...], unbuffered: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PYTHONUNBUFFERED", unbuffered)
    assert ended(*arguments, closed=("stdout", "stderr")) == (130, "", "")


@pytest.mark.slow
def test_a_command_without_an_output_does_its_work(tmp_path: Path) -> None:
    command = f"{sys.executable} -m traps_pipeline.cli init demo --workspace {tmp_path / 'study'} >&-"
    assert subprocess.run(command, cwd=ROOT, shell=True, check=False).returncode == 0
    assert (tmp_path / "study" / "study.yaml").is_file()


@pytest.mark.parametrize("closed", [">&-", ">&- 2>&-", "<&- >&- 2>&-"])
def test_a_closed_output_is_no_failure_and_no_file_gets_its_number(closed: str, tmp_path: Path) -> None:
    """A ledger whose number is that of an output would hold what a library prints."""
    program = "import os, sys; from traps_pipeline.cli import main; sys.argv[1:] = ['--version']; code = main()"
    seen = f"n = os.open({str(tmp_path / 'ledger')!r}, os.O_CREAT | os.O_WRONLY); sys.exit(10 * code + (n <= 2))"
    command = f'{sys.executable} -c "{program}; {seen}" {closed}'
    assert subprocess.run(command, cwd=ROOT, shell=True, check=False).returncode == 0


@pytest.mark.slow
def test_the_state_of_a_study_is_asked_for_without_an_output(study: Checkout) -> None:
    shutil.rmtree(study.workspace / "tables" / "leaderboard")
    for options in ("", "--json"):
        command = f"{sys.executable} -m traps_pipeline.cli status {options} --workspace {study.workspace} >&-"
        assert subprocess.run(command, cwd=ROOT, shell=True, check=False).returncode == 0
