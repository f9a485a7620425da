"""A real browser: pages that note what they say and ask for, and waiting for what a page's own content policy would
not let Playwright evaluate."""

from __future__ import annotations

import shutil
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from playwright.sync_api import Browser, Dialog, Error, Page, sync_playwright

CHROMIUM = shutil.which("chromium") or "/usr/bin/chromium"
QUIET = [
    *("--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-background-networking"),
    *("--disable-sync", "--disable-component-update"),
]
PATIENCE_S = 270  # nine times what Playwright itself would wait
LOCAL = ("http://127.0.0.1:", "data:,", "blob:http://127.0.0.1:")  # blob: a clip that is held in memory


@contextmanager
def a_browser() -> Iterator[Browser]:
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=QUIET)
        yield browser
        browser.close()


def watched(
    browser: Browser, width: int = 1280, inside: tuple[str, ...] = LOCAL, recording: Path | None = None
) -> tuple[Page, list[str]]:
    """A page of a person of their own, and what it says to the console or asks of others than those `inside`.

    recording: the file into which all traffic is written when its context is closed.
    """
    context = browser.new_context(
        viewport={"width": width, "height": 1000}, record_har_path=recording, record_har_content="embed"
    )
    page, problems = patient(context.new_page()), list[str]()

    def dismiss(dialog: Dialog) -> None:
        problems.append(dialog.message)
        dialog.dismiss()

    page.on("console", lambda message: problems.append(message.text))
    page.on("pageerror", lambda error: problems.append(str(error)))
    page.on("dialog", dismiss)
    page.on("request", lambda r: None if r.url.startswith(inside) else problems.append(r.url))
    return page, problems


def ready(page: Page) -> None:
    """Wait until a page hears keys."""
    until(page, "document.documentElement.dataset.ready === '1'")


def patient(page: Page) -> Page:
    """The page, whose actions wait for as long as a slow machine may need."""
    page.set_default_timeout(1000 * PATIENCE_S)
    return page


def until(page: Page, condition: str, seconds: float = PATIENCE_S) -> None:
    """Wait until a JavaScript expression holds. Playwright's own `wait_for_function` evaluates a text inside the page,
    which a page without `unsafe-eval` forbids."""
    end = time.monotonic() + seconds
    while not _holds(page, condition):
        assert time.monotonic() < end, f"not within {seconds} s: {condition}"
        page.wait_for_timeout(15)


def _holds(page: Page, condition: str) -> bool:
    try:
        return bool(page.evaluate(f"document.readyState !== 'loading' && ({condition})"))
    except Error as error:
        if "context was destroyed" in str(error):  # the page was just being left
            return False
        raise
