"""`traps people review` in a real browser: ten scenarios by keyboard, a kill, then a run asks what they touch."""

from __future__ import annotations

import json
import re
from typing import Any

import pytest
from playwright.sync_api import Page

from tests.conftest import EXPERIMENT, Checkout
from tests.integration.listening import listening
from tests.pages import a_browser, ready, until, watched

pytestmark = pytest.mark.slow


@pytest.fixture
def study(own_study: Checkout) -> Checkout:
    """A study whose records the tests correct."""
    return own_study


ILL_POSED = (
    "Is the balloon to the left or to the right of the wall?"  # of another plinko: the check proves it without looking
)


def decisions(study: Checkout) -> list[dict[str, Any]]:
    file = study.root / "scene_specs" / "corrections" / "review.jsonl"
    return [json.loads(line) for line in file.read_text().splitlines()] if file.exists() else []


def press(page: Page, *keys: str) -> None:
    """Press keys one after another as soon as they are heard; then another page has been reached."""
    ready(page)
    before = page.url
    for key in keys:
        page.keyboard.press(key)
    page.wait_for_url(lambda url: url != before)
    page.wait_for_load_state()


def rewrite(page: Page, *to_the_field: str, text: str, shown: str = "") -> None:
    """Write a text over what a field holds, by keys, and leave the field once the page shows what that touches."""
    for key in (*to_the_field, "Control+a"):
        page.keyboard.press(key)
    page.keyboard.type(text)
    if shown:
        until(page, f"document.getElementById('preview').textContent.includes('{shown}')")
    page.keyboard.press("Escape")


def keep_five(page: Page) -> str:
    """Keep the first five scenarios of a queue, which wants one reason; return the first."""
    assert page.locator("#progress").inner_text() == "0 of 12 reviewed"
    first = page.locator("h1").inner_text()
    page.keyboard.press("k")  # without a reason nothing is decided, and the next key is a key
    assert "keep" in page.locator("#said.error").inner_text()
    page.keyboard.press("k")
    assert page.input_value("#why") == ""
    page.keyboard.press("w")
    page.keyboard.type("looks right")
    press(page, "Enter")
    for _ in range(4):
        press(page, "k")
    assert page.locator("#progress").inner_text() == "5 of 12 reviewed"
    page.wait_for_load_state("networkidle")
    return first


def test_ten_scenarios_by_keyboard_and_then_exactly_what_they_touch_is_asked(study: Checkout) -> None:
    with a_browser() as browser:
        page, problems = watched(browser)
        with listening(study, "review", "jd") as server:
            page.goto(server.address)
            first = keep_five(page)
            assert problems == []
            server.kill()
        kept = decisions(study)
        assert [each["action"] for each in kept] == ["keep"] * 5
        expected = {"scenario_id": first, "action": "keep", "who": "jd", "when": "", "why": "looks right"}
        assert kept[0] | {"when": ""} == expected
        with listening(study, "review", "jd") as server:
            page.goto(server.address)
            assert page.locator("#progress").inner_text() == "5 of 12 reviewed"
            sixth = page.locator("h1").inner_text()
            rewrite(page, "e", text="What happens, in your words?", shown="3 items")
            rewrite(page, "w", text="unclear")
            press(page, "c")
            seventh = page.locator("h1").inner_text()
            rewrite(page, "e", "Tab", text=ILL_POSED, shown="1 item")
            press(page, "c")
            eighth = page.locator("h1").inner_text()
            for key in "dkk":
                press(page, key)
            assert page.locator("#progress").inner_text() == "10 of 12 reviewed"
            page.goto(f"http://127.0.0.1:{server.port}/scenario/{eighth}?queue=all")
            page.keyboard.press("u")  # the discarded one is back, and not reviewed
            until(page, "document.querySelector('.lead b').textContent === 'not reviewed'")
            press(page, "d")
            page.goto(f"http://127.0.0.1:{server.port}/done")
            told = page.locator("section").first.inner_text()
        assert problems == []
    lines = decisions(study)
    actions = [*["keep"] * 5, "correct", "correct", "discard", "keep", "keep", "restore", "discard"]
    assert [each["action"] for each in lines] == actions and f"Discarded: {eighth}" in told
    assert (lines[5]["scenario_id"], lines[5]["question"]) == (sixth, "What happens, in your words?")
    assert (lines[6]["scenario_id"], lines[6]["ill_posed_question"]) == (seventh, ILL_POSED)
    counts, answers = study.score(EXPERIMENT).ok().counts(), 4 * 3 * 2  # four items, three models, two regimes
    assert (counts["answers"], counts["frames"]) == (answers, 0)
    found = re.search(r"(\d+) items to ask or judge again: at most (\d+) answers and (\d+) votes", told)
    assert found and [*map(int, found.groups())] == [4, answers, counts["votes"]]


def test_two_reviewers_lose_nothing_and_strangers_get_nothing(study: Checkout) -> None:
    with listening(study, "review", "jd") as jd, listening(study, "review", "ab") as ab:
        keep = {"action": "keep", "why": "fine", "seen": 0}
        assert jd.ask("POST", "/decide", {"scenario_id": "plinko-0001", **keep}) == (200, {"seen": 1})
        status, said = ab.ask("POST", "/decide", {"scenario_id": "plinko-0001", **keep, "action": "discard"})
        assert status == 409 and said["error"].startswith("plinko-0001: jd ")
        assert ab.ask("POST", "/decide", {"scenario_id": "plinko-0002", **keep})[0] == 200
        assert [(each["scenario_id"], each["who"]) for each in decisions(study)] == [
            ("plinko-0001", "jd"),
            ("plinko-0002", "ab"),
        ]

        wrong = {"scenario_id": "plinko-0003", "action": "correct", "why": "no", "seen": 0}
        status, said = jd.ask("POST", "/decide", wrong | {"changes": {"answer": "purple"}})
        assert status == 400 and "plinko-0003" in said["error"]
        assert jd.ask("POST", "/decide", wrong | {"changes": {"who": "somebody"}})[0] == 400
        assert jd.ask("POST", "/decide", wrong | {"why": ""})[0] == 400
        assert jd.ask("POST", "/decide", {"scenario_id": "nobody-0001", **keep})[0] == 404
        outside = ("/clip/nobody-0001/control", "/clip/plinko-0001/secret", "/docs", "/../study.yaml")
        for path in ("/scenario/nobody-0001", *outside):
            assert jd.ask("GET", path)[0] == 404, path
        assert jd.ask("GET", "/clip/plinko-0001/control", Range="bytes=0-99")[0] == 206

        for headers in ({"Origin": "http://evil.example"}, {"Authorization": "Bearer wrong-token-0123456"}):
            assert jd.ask("POST", "/decide", {"scenario_id": "plinko-0003", **keep}, **headers)[0] == 403
        assert len(decisions(study)) == 2
