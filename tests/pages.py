"""Waiting in a real browser for what a page's own content policy would not let Playwright evaluate."""

from __future__ import annotations

import time

from playwright.sync_api import Error, Page

PATIENCE_S = 270  # nine times what Playwright itself would wait


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
