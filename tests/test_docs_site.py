"""The documentation as a site: every link leads somewhere, nothing is fetched, a second build has the same bytes."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests.conftest import ROOT

pytestmark = pytest.mark.slow

NO_SOURCE = (".*", "__pycache__", "build", "dist", "node_modules", "site", "wheels")


@pytest.fixture
def checkout(tmp_path: Path) -> Path:
    """A copy of this checkout: pages link to any of its files."""
    return Path(shutil.copytree(ROOT, tmp_path / "checkout", ignore=shutil.ignore_patterns(*NO_SOURCE)))


def make_docs(checkout: Path) -> subprocess.CompletedProcess[str]:
    """Run `make docs` with the environment of the tests instead of one that `make setup` makes."""
    command = ["make", "-C", checkout, "-o", "setup", f"BIN={Path(sys.executable).parent}", "docs"]
    return subprocess.run(command, capture_output=True, text=True)


def build(checkout: Path) -> dict[str, bytes]:
    """Every file of the site by its path."""
    finished = make_docs(checkout)
    assert finished.returncode == 0, finished.stdout + finished.stderr
    site = checkout / "site"
    return {path.relative_to(site).as_posix(): path.read_bytes() for path in site.rglob("*") if path.is_file()}


@pytest.mark.promise
def test_the_site_is_built_twice_to_the_same_bytes_and_fetches_nothing(checkout: Path) -> None:
    site = build(checkout)
    assert build(checkout) == site
    pages = {name: content.decode() for name, content in site.items() if name.endswith(".html")}
    for name, page in pages.items():
        loaded = re.findall(r'<(?:script|img|iframe|source)[^>]*\bsrc="?([^" >]+)', page)
        loaded += re.findall(r'<link[^>]*\bhref="?([^" >]+)', page)
        assert loaded and not [one for one in loaded if re.match(r"(https?:)?//", one)], name
    # The first page is the README, each page of docs/ is there, and the reference.
    titles = re.findall("^## (.+)$", (ROOT / "README.md").read_text(), re.MULTILINE)
    assert [one for one in (*titles, "moving_pair.gif") if one not in pages["index.html"]] == []
    assert {f"{path.stem}.html" for path in (ROOT / "docs").glob("*.md")} <= {*pages}
    named = {"python": "traps_pipeline.inside", "tables": "leaderboard", "yaml": "budget_usd"}
    for name, text in {**named, "certificates": "does not promise"}.items():
        assert text in pages[f"reference/{name}.html"]
    assert "families/plinko.html" in pages["families.html"] and "plinko.jpg" in pages["families/plinko.html"]
