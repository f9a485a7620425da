"""The explorer's scripts: unit tests under Node, where a machine has it (pyright brings one for most)."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest

TESTS = Path(__file__).with_name("scripts.test.mjs")
NODE = shutil.which("node")


@pytest.mark.skipif(NODE is None, reason="needs Node")
def test_functions_of_the_explorer_do_what_their_unit_tests_say() -> None:
    finished = subprocess.run([str(NODE), "--test", TESTS], capture_output=True, text=True, check=False)
    assert finished.returncode == 0, finished.stdout + finished.stderr
    assert "# fail 0" in finished.stdout and "# pass 9" in finished.stdout
