"""The demo's report in a real browser: nothing clipped, no error, no request off the machine, every link leads on."""

from __future__ import annotations

from pathlib import Path

import pandas as pd
import pytest
from playwright.sync_api import Browser, Page, expect

from tests.conftest import Checkout
from tests.pages import until, watched
from traps_pipeline.scoring.score_rows import LEADERBOARD
from traps_pipeline.storage.workspace import Workspace

pytestmark = pytest.mark.slow


def opened(browser: Browser, file: Path, width: int) -> tuple[Page, list[str]]:
    """A page of that width, and where its console messages and requests that leave the machine are collected."""
    page, problems = watched(browser, width, ("file:", "data:"))
    page.goto(file.as_uri())
    return page, problems


@pytest.mark.parametrize("width", [390, 1280, 1920])
def test_the_report_opens_from_disk_at_each_width(demo: Checkout, browser: Browser, width: int) -> None:
    page, problems = opened(browser, demo.workspace / "reports" / "report.html", width)
    assert page.evaluate("document.documentElement.scrollWidth") <= width
    assert page.evaluate("[...document.images].every(image => image.naturalWidth > 0)")
    assert page.locator("#leaderboard tbody tr").count() == 9 * 3 + 1  # with the heading of reference rows
    assert "the 9 reference strategies abstain on 0 to 100 % of the voids" in page.inner_text("#findings")
    assert page.locator("#appendix ~ details[open]").count() == 0
    anchors = page.evaluate("[...document.querySelectorAll('a[href^=\"#\"]')].map(a => a.hash.slice(1))")
    assert len(anchors) > 30 and page.evaluate("ids => ids.filter(id => !document.getElementById(id))", anchors) == []
    assert "Spread over runs: " in page.inner_text("#not-run + section")
    page.goto(page.url + "#table-models")  # opens what is collapsed
    expect(page.locator("#table-models tbody tr").first).to_be_visible()
    if width > 1100:  # a narrow page lists chapters alone
        page.locator("a[href='#table-expanded']").click()
        expect(page.locator("#table-expanded tbody tr").first).to_be_visible()
    assert problems == []


def test_a_number_leads_to_its_answers_and_the_explorer_back_to_the_report(demo: Checkout, browser: Browser) -> None:
    page, problems = opened(browser, demo.workspace / "reports" / "report.html", 1280)
    row = page.locator("#leaderboard tbody tr", has_text="random-50").first
    row.locator("a[href*='dataset=occlusion']").first.click()
    page.wait_for_selector(".answer")
    assert page.locator(".status").inner_text().startswith("32 of 3456 answers")  # 16 pairs
    page.locator(".answer a").first.click()
    until(page, "[...document.querySelectorAll('video')].some(video => video.readyState >= 2)")  # of the study's folder
    page.get_by_role("link", name="Report").click()
    page.wait_for_selector("#leaderboard")
    assert problems == []


def test_tables_and_figures_are_saved_with_a_click(demo: Checkout, browser: Browser, tmp_path: Path) -> None:
    page, problems = opened(browser, demo.workspace / "reports" / "report.html", 1280)
    saved = {}
    for place, kind in (
        ("#leaderboard", "CSV"),
        ("#leaderboard", "LaTeX"),
        ("#figure-abs_rec", "SVG"),
        ("#figure-abs_rec", "PNG"),
    ):
        with page.expect_download() as download:
            page.locator(place).get_by_text(kind, exact=True).first.click()
        saved[kind] = tmp_path / download.value.suggested_filename
        download.value.save_as(saved[kind])
    assert [path.name for path in saved.values()] == [
        "leaderboard_overall.csv", "leaderboard_overall.tex", "abs_rec.svg", "abs_rec.png",
    ]  # fmt: skip
    board = Workspace.open(demo.workspace).tables.read(LEADERBOARD, {})
    expected = board.loc[board["dataset"] == "overall"].set_index(["model", "regime"])["acc"].sort_index()
    read = pd.read_csv(saved["CSV"]).set_index(["model", "regime"])["acc"].sort_index()
    pd.testing.assert_series_equal(read, expected)
    assert r"\begin{table}" in saved["LaTeX"].read_text()
    assert saved["SVG"].read_text().startswith("<?xml") and saved["PNG"].read_bytes().startswith(b"\x89PNG")
    assert problems == []
