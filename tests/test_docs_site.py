"""The documentation as a site: every link leads somewhere, nothing is fetched, a second build has the same bytes."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from tests.conftest import ROOT
from tests.test_rooms import ROOMS

pytestmark = pytest.mark.slow


def build(folder: Path) -> dict[str, bytes]:
    """Every file of the site by its path, built as `make docs` builds it."""
    environment = os.environ | {"SOURCE_DATE_EPOCH": "1580601600", "NO_MKDOCS_2_WARNING": "1"}
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "-d", folder]
    finished = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True)
    assert finished.returncode == 0, finished.stdout + finished.stderr  # a link that leads nowhere is an error
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.mark.promise
def test_the_site_is_built_twice_to_the_same_bytes_and_fetches_nothing(tmp_path: Path) -> None:
    site = build(tmp_path / "a")
    assert build(tmp_path / "b") == site
    pages = {name: content.decode() for name, content in site.items() if name.endswith(".html")}
    for name, page in pages.items():
        loaded = re.findall(r'<(?:script|img|iframe|source)[^>]*\bsrc="?([^" >]+)', page)
        loaded += re.findall(r'<link[^>]*\bhref="?([^" >]+)', page)
        assert loaded and not [one for one in loaded if re.match(r"(https?:)?//", one)], name
    # The first page is the README, each page of docs/ is there, and each room with public names has its reference.
    assert "Two commands" in pages["index.html"] and "moving_pair.gif" in pages["index.html"]
    assert {f"{path.stem}.html" for path in (ROOT / "docs").glob("*.md")} <= {*pages}
    assert {room for room in ROOMS if f"reference/{room}.html" not in pages} <= {"definitions"}
    assert "traps_pipeline.scoring.metrics" in pages["reference/scoring.html"]
