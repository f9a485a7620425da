"""The demo's report in a real browser: nothing clipped, no error, no request off the machine, every link leads on."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import pytest
from playwright.sync_api import Page, sync_playwright

from tests.build.cells import CELL, HOSTILE, write_cell
from tests.conftest import Checkout
from tests.pages import patient
from traps_pipeline.report.cell_pages import item_pages
from traps_pipeline.storage.study import Study
from traps_pipeline.storage.workspace import Workspace

pytestmark = pytest.mark.slow
CHROMIUM = shutil.which("chromium") or "/usr/bin/chromium"


def problems(page: Page) -> list[str]:
    """Where console errors and requests that leave the machine are collected from now on."""
    found = list[str]()
    page.on("console", lambda message: found.append(message.text))
    page.on("pageerror", lambda error: found.append(str(error)))
    page.on("request", lambda r: found.append(r.url) if not r.url.startswith(("file:", "data:")) else None)
    return found


def test_the_report_opens_from_disk_at_both_widths_and_its_links_lead_to_items(demo: Checkout, tmp_path: Path) -> None:
    reports = demo.workspace / "reports"
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox", "--disable-gpu"])
        for width in (1280, 1920):
            page = patient(browser.new_page(viewport={"width": width, "height": 1000}))
            found = problems(page)
            page.goto((reports / "report.html").as_uri())
            assert page.evaluate("document.documentElement.scrollWidth") <= width
            assert page.evaluate("[...document.images].every(image => image.naturalWidth > 0)")
            first = page.locator("section").first
            assert first.locator("h2").inner_text() == "Overall"
            assert first.locator("tbody tr").count() == 9 * 3
            page.screenshot(path=tmp_path / f"{width}.png", full_page=True)
            assert found == []
        hrefs = page.evaluate("[...document.querySelectorAll('a')].map(a => a.getAttribute('href'))")
        anchors = dict[str, set[str]]()
        for target, anchor in {(h.partition("#")[0], h.partition("#")[2]) for h in hrefs}:
            if target not in anchors:
                text = (reports / (target or "report.html")).read_text()
                anchors[target] = set(re.findall(r'id="([^"]+)"', text))
            assert not anchor or anchor in anchors[target], (target, anchor)
        assert len([target for target in anchors if target]) == 108 + 2  # a page a cell, the index, and the cases
        page.locator('a[href="items/occlusion__random-50__standard__run1.html"]').first.click()  # a PECS on a dataset
        assert "Voids: cannot be answered (16)" in page.inner_text("body")
        assert found == []

        hostile = Workspace.create(tmp_path / "study", Study(scenarios=["plinko-0001"]))
        write_cell(hostile)
        (tmp_path / "hostile.html").write_text("".join(item_pages(hostile, CELL, None)))
        page.goto((tmp_path / "hostile.html").as_uri())
        assert page.locator("td .text").first.inner_text() == HOSTILE
        assert page.locator("script, img").count() == 0
        assert found == []
        browser.close()
