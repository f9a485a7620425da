"""The explorer in a real browser, from disk and from a web host: its metrics, its ways to an answer, its silence."""

from __future__ import annotations

import functools
import http.server
import re
import shutil
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from decimal import ROUND_HALF_UP, Decimal
from pathlib import Path

import pandas as pd
import pytest
from playwright.sync_api import Browser, Page
from scipy.stats import binomtest

from tests.build.cells import row, write_cell
from tests.conftest import Checkout
from tests.pages import patient, until, watched
from traps_pipeline.judging.judging_rows import VERDICTS, VOTES
from traps_pipeline.models.asking.answer_rows import RESPONSES
from traps_pipeline.protocol.metric_words import METRIC_WORDS
from traps_pipeline.report.explorer.site import write_site
from traps_pipeline.report.leaderboard_page import leaderboards
from traps_pipeline.report.published_results import PublishedResults
from traps_pipeline.report.writing import NOT_RUN, fraction, percent
from traps_pipeline.scoring.score_rows import CONTRASTS, LEADERBOARD, METRICS, REGIME_TESTS
from traps_pipeline.storage.benchmark_tables import ITEMS
from traps_pipeline.storage.study import Study
from traps_pipeline.storage.workspace import Workspace

pytestmark = pytest.mark.slow
PRINTED = {m.heading: (m.name, percent if m.unit == "percent" else fraction) for m in METRIC_WORDS.values()}
# Markup, LaTeX, a right-to-left override, a zero-width space, a byte-order mark and a tag character.
HOSTILE = (
    '<script>parent.document.title="owned"</script><img src="http://evil.example/x.png" onerror="alert(1)"> '
    "\\textbf{bold} $x$ \u202etxet desrever\u202c zero\u200bwidth \ufeffmark \U000e0041 end"
)
AS_SHOWN = HOSTILE
for _hidden in ("\u202e", "\u202c", "\u200b", "\ufeff", "\U000e0041"):
    AS_SHOWN = AS_SHOWN.replace(_hidden, f"U+{ord(_hidden):04X}")


@dataclass(frozen=True)
class Site:
    """A site in a folder, and the study that it shows."""

    folder: Path
    workspace: Workspace

    @property
    def address(self) -> str:
        return (self.folder / "index.html").as_uri()


@dataclass(frozen=True)
class Visit:
    """A page of the site, with its console messages and the requests that left the folder."""

    page: Page
    address: str
    problems: list[str]

    def go(self, view: str) -> Page:
        """Show a view of the page as it is open, and wait until it is there."""
        self.page.evaluate("delete document.documentElement.dataset.shown")
        if "#" in self.page.url and self.page.url.startswith(self.address):
            again = "hash => location.hash === hash ? dispatchEvent(new Event('hashchange')) : (location.hash = hash)"
            self.page.evaluate(again, view)
        else:
            self.page.goto(self.address + view)
        until(self.page, "document.documentElement.dataset.shown")
        return self.page


@pytest.fixture(scope="module")
def site(small: Checkout, tmp_path_factory: pytest.TempPathFactory) -> Site:
    """The site of the small study, written by the command, then moved: nothing in it names where it was made."""
    made, folder = tmp_path_factory.mktemp("made") / "site", tmp_path_factory.mktemp("moved") / "site"
    finished = small.traps("site", made).ok()
    assert str(made / "index.html") in finished.out
    shutil.move(made, folder)
    return Site(folder, Workspace.open(small.workspace))


@contextmanager
def visit(browser: Browser, address: str, width: int = 1280) -> Iterator[Visit]:
    """A new page at an address; at the end it must have said nothing and asked for nothing outside."""
    inside = address.rpartition("/")[0], "data:,", "blob:"  # a clip that is held in memory
    page, problems = watched(browser, width, inside)
    yield Visit(page, address, problems)
    page.context.close()
    assert problems == []


@contextmanager
def hosted(folder: Path) -> Iterator[str]:
    """The address of a folder on a web host of this machine."""

    class Quiet(http.server.SimpleHTTPRequestHandler):
        def log_message(self, format: str, *args: object) -> None:
            pass

    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), functools.partial(Quiet, directory=folder))
    threading.Thread(target=server.serve_forever, daemon=True).start()
    try:
        yield f"http://127.0.0.1:{server.server_port}/index.html"
    finally:
        server.shutdown()


def by_heading(page: Page, name: str) -> list[dict[str, str]]:
    """The texts of a table's rows by the headings of their columns."""
    script = """table => {
        const text = cell => cell.innerText.replace(/ [▾▴]$/, "").trim();
        const headings = [...table.tHead.rows[0].cells].map(text);
        return [...table.tBodies[0].rows].map(
            row => Object.fromEntries([...row.cells].map((cell, k) => [headings[k], text(cell)])));
    }"""
    return page.locator(f"table[data-name={name}]").evaluate(script)


def rows_of(page: Page) -> list[dict[str, str]]:
    """The leaderboard's rows, without the heading above those of reference strategies."""
    return [line for line in by_heading(page, "leaderboard") if "Regime" in line]


@pytest.mark.promise
def test_every_leaderboard_metric_is_that_of_the_table(site: Site, browser: Browser) -> None:
    board = site.workspace.tables.read(LEADERBOARD, {})
    compared = 0
    with visit(browser, site.address) as visited:
        for dataset in board["dataset"].unique():
            page = visited.go(f"#/?dataset={dataset}")
            shown = {(line["Model"], line["Regime"]): line for line in rows_of(page)}
            rows = board.loc[board["dataset"] == dataset].to_dict("records")
            assert len(shown) == len(rows)
            for wanted in rows:
                line = shown[wanted["model"], wanted["regime"]]
                for heading, (name, printed) in PRINTED.items():
                    low, high = (printed(wanted[f"{name}_ci_{end}"]) for end in ("low", "high"))
                    assert line[heading].split("\n") == [printed(wanted[name]), f"[{low}, {high}]"], (wanted, name)
                    compared += 3
                low, high = wanted["rank_low"], wanted["rank_high"]
                assert line["Rank"] == (f"{low:.0f}" if low == high else f"{low:.0f}–{high:.0f}")
                for heading, name in (("n", "n_pairs"), ("Runs", "n_runs"), ("Missing", "n_missing")):
                    assert line[heading] == str(wanted[name])
        # The order by PECS is the report's own.
        (ranked, *_) = leaderboards(board)
        page = visited.go("#/")
        order = [(line["Model"], line["Regime"]) for line in rows_of(page)]
        assert order == [*zip(ranked.rows["model"], ranked.rows["regime"], strict=True)]
    assert compared == 3 * len(PRINTED) * len(board) == 450


def test_the_paper_stands_beside_the_study_and_what_was_not_run_says_so(site: Site, browser: Browser) -> None:
    published = PublishedResults().cells
    published = published.loc[published["dataset"] == "chaotic"].set_index(["model", "regime"])
    with visit(browser, site.address) as visited:
        page = visited.go("#/?dataset=chaotic&paper=1")
        lines = {(line["Model"], line["Regime"]): line for line in rows_of(page)}
        assert len(lines) == 6 + len(published)
        for key, paper in published.iterrows():
            for heading, (name, printed) in PRINTED.items():
                assert lines[key][heading] == NOT_RUN
                if name != "j":
                    assert lines[key][f"Paper: {heading}"] == printed(paper[name])
        assert lines["oracle", "json"]["Paper: PECS"] == "–"
        assert "gpt-5-pro" in visited.go("#/model/gpt-5-pro").inner_text("main:has(.notice) h1")


def test_counts_of_pairs_agree_with_the_table_of_metrics(site: Site, browser: Browser) -> None:
    metrics = site.workspace.tables.read_all(METRICS)
    whole = metrics.loc[(metrics["scope"] == "all") & (metrics["n_missing"] == 0)]
    assert len(whole) == len(metrics.loc[metrics["scope"] == "all"])
    with visit(browser, site.address) as visited:
        for cell in whole.to_dict("records"):
            page = visited.go(f"#/model/{cell['model']}?dataset={cell['dataset']}&regime={cell['regime']}")
            heading = page.get_by_role("table", name="Outcomes of pairs by regime")
            line = heading.locator("tbody tr", has=page.get_by_role("rowheader", name=cell["regime"], exact=True))
            pairs, _, *counts = line.locator("td").all_inner_texts()
            right, confabulated, cautious, mistaken, wrong, missing = map(int, counts)
            assert int(pairs) == cell["n_pairs"] == sum(map(int, counts))
            assert right + confabulated == round(cell["acc"] * cell["n_acc"])
            assert right + cautious + mistaken == round(cell["abs_rec"] * cell["n_abs_rec"])
            assert missing == 0 and wrong >= 0


def test_a_comparison_counts_what_differs_and_tests_it_as_the_tables_do(site: Site, browser: Browser) -> None:
    tests = site.workspace.tables.read(REGIME_TESTS, {})
    verdicts = site.workspace.tables.read_all(VERDICTS)
    differences = site.workspace.tables.read(CONTRASTS, {})

    def counted(page: Page) -> tuple[list[int], str]:
        numbers = [int(text) for line in by_heading(page, "counts") for text in [*line.values()][1:]]
        return numbers, page.locator("[data-field=p]").inner_text().removeprefix("p ").removeprefix("= ")

    def printed(p: float) -> str:
        return "< 0.0001" if p < 1e-4 else fraction(p, 4)

    with visit(browser, site.address) as visited:
        for test in tests.to_dict("records"):
            page = visited.go(
                f"#/compare?left={test['model']}&leftRegime={test['left_regime']}&right={test['model']}"
                f"&rightRegime={test['right_regime']}&dataset={test['dataset']}&decision={test['decision']}"
            )
            (_, only_left, only_right, _), p = counted(page)
            assert (only_left, only_right, p) == (test["only_left"], test["only_right"], printed(test["p"]))
        voids = verdicts.loc[(verdicts["dataset"] == "chaotic") & (verdicts["side"] == "void")]
        by = voids.loc[voids["regime"] == "standard"].pivot(index="item_id", columns="model", values="abstained")
        left, right = by["oracle"].astype(bool), by["prior"].astype(bool)
        page = visited.go("#/compare?left=oracle&right=prior&leftRegime=standard&rightRegime=standard&dataset=chaotic")
        numbers, p = counted(page)
        only = int((left & ~right).sum()), int((right & ~left).sum())
        assert numbers == [int((left & right).sum()), *only, int((~left & ~right).sum())]
        exact = Decimal(binomtest(only[0], sum(only), 0.5).pvalue)  # 1/32 of a few items: browsers round a half up
        assert p == str(exact.quantize(Decimal("0.0001"), ROUND_HALF_UP))
        key = ["kind", "dataset", "metric", "left_model", "left_regime", "right_model"]
        found = differences.set_index(key).loc["models", "chaotic", "pecs", "oracle", "standard", "prior"]
        lines = {(line["Dataset"], line["Metric"]): line for line in by_heading(page, "differences")}
        assert lines["Chaotic", "PECS"]["Difference"] == fraction(found["difference"])
        interval = f"[{fraction(found['ci_low'])}, {fraction(found['ci_high'])}]"
        assert lines["Chaotic", "PECS"]["95 % interval"] == interval
        listed = page.locator("ul.pairs").first.locator("a").all_inner_texts()
        assert sorted(listed) == sorted(item.split(":")[1] for item in by.index[left & ~right])


@pytest.mark.parametrize("over", [pytest.param("file", marks=pytest.mark.promise), "http"])
def test_a_confabulation_is_found_in_three_clicks_and_its_clips_play_in_step(
    site: Site, browser: Browser, over: str
) -> None:
    with hosted(site.folder) as web, visit(browser, site.address if over == "file" else web) as visited:
        page = visited.go("#/")
        page.get_by_role("link", name="prior").first.click()
        page.get_by_role("link", name=re.compile(r"\d+ Confabulated, standard|\d+ Confabulated, json")).first.click()
        first = page.locator(".answer").first
        assert first.locator(".chip").inner_text() == "answered"
        first.get_by_role("link").first.click()
        page.wait_for_selector(".panel h3 .chip")
        assert page.locator(".panel h3 .chip").inner_text() == "Confabulated"
        assert page.locator(".panel .text").count() == 2
        until(page, "document.querySelectorAll('video').length >= 1")
        until(page, "[...document.querySelectorAll('video')].every(video => video.readyState >= 2)")
        times = "[...document.querySelectorAll('.control video, .void video')].map(video => video.currentTime)"
        page.get_by_role("button", name="one frame on").click()
        page.keyboard.press("Escape")
        assert "frame 2 of" in page.locator("output").inner_text()
        until(page, f"{times}.every(time => time > 0)")
        assert len({round(time, 4) for time in page.evaluate(times)}) == 1
        page.get_by_role("button", name="Play").click()
        until(page, f"{times}[0] > 0.5")
        page.get_by_role("button", name="Pause").click()
        playing = page.evaluate(times)
        assert max(playing) - min(playing) <= 3 / 10  # three frames, while two cores decode
        if over == "http":
            assert visited.page.url.startswith("http://127.0.0.1")


def test_filters_and_search_find_exactly_what_the_tables_hold(site: Site, browser: Browser) -> None:
    responses = site.workspace.tables.read_all(RESPONSES, ["item_id", "model", "regime", "side", "text"])
    verdicts = site.workspace.tables.read_all(VERDICTS, ["item_id", "model", "regime", "abstained"])
    votes = site.workspace.tables.read_all(VOTES, ["item_id", "model", "regime", "rationale"])
    key = ["item_id", "model", "regime"]
    rationales = votes.groupby(key)["rationale"].agg(lambda texts: "\n".join(texts.dropna())).reset_index()
    rows = responses.merge(verdicts, on=key).merge(rationales, on=key, how="left")
    rows["said"] = rows["text"] + "\n" + rows["rationale"].fillna("")
    with visit(browser, site.address) as visited:
        page = visited.go("#/answers")
        assert page.locator(".status").inner_text() == f"{len(rows)} of {len(rows)} answers"
        page.get_by_label("Model").select_option("random-50")
        page.get_by_label("Side").select_option("void")
        page.get_by_label("Answer").select_option("answered")
        fits = rows["model"].eq("random-50") & rows["side"].eq("void") & rows["abstained"].eq(False)
        until(page, f"document.querySelector('.status').textContent.startsWith('{fits.sum()} of')")
        first, second, *_, last = str(rows.loc[fits, "text"].iloc[0]).strip(".").split()
        query = f'{last.upper()} "{first} {second}"'  # in any order, what is quoted together
        page.get_by_role("searchbox").fill(query)
        page.keyboard.press("Enter")
        said = rows["said"].str.lower()
        held = [said.str.contains(term.lower(), regex=False) for term in (last, f"{first} {second}")]
        wanted = int((fits & held[0] & held[1]).sum())
        assert wanted > 0
        until(page, "document.querySelector('.status').textContent.startsWith('“')")
        assert page.locator(".status").inner_text() == f"“{query}”: {wanted} of {fits.sum()} answers"
        assert page.locator(".answer", has=page.locator("mark")).count() == min(wanted, 25)
        page.get_by_role("searchbox").fill("left nowhere")
        page.keyboard.press("Enter")
        page.locator("main .notice").wait_for()
        assert page.locator(".status").inner_text().startswith("“left nowhere”: 0 of ")


def test_the_keyboard_reaches_a_pair_and_moves_through_its_neighbours(site: Site, browser: Browser) -> None:
    with visit(browser, site.address) as visited:
        page = visited.go("#/answers?model=prior&regime=standard&side=void&decision=answered")
        page.keyboard.press("Tab")
        assert page.evaluate("document.activeElement.id") == "skip"
        page.keyboard.press("Enter")
        assert page.evaluate("document.activeElement.tagName") == "H1"
        for _ in range(40):
            page.keyboard.press("Tab")
            if page.evaluate("Boolean(document.activeElement.closest('.answer'))"):
                break
        listed = page.locator(".answer a").all_inner_texts()
        page.keyboard.press("Enter")
        until(page, f"document.querySelector('.lead b')?.textContent === '{listed[0]}'")
        assert page.evaluate("document.activeElement.tagName") == "H1"
        until(page, "[...document.querySelectorAll('video')].every(video => video.readyState >= 2)")
        page.keyboard.press("ArrowRight")
        page.keyboard.press("ArrowRight")
        assert "frame 3 of" in page.locator("output").inner_text()
        page.get_by_role("button", name="Play").click()  # which now has the focus
        page.keyboard.press("ArrowLeft")
        assert page.locator("button", has_text="Play").count() == 1  # it stopped
        page.keyboard.press("]")
        until(page, f"document.querySelector('.lead b')?.textContent === '{listed[1]}'")
        page.keyboard.press("[")
        until(page, f"document.querySelector('.lead b')?.textContent === '{listed[0]}'")


@pytest.mark.parametrize("width", [390, 1280])
def test_no_view_is_wider_than_the_screen(site: Site, browser: Browser, width: int) -> None:
    pair = "#/pair/occlusion/hidden_race-0001?model=random-50&regime=standard&run=1&model2=prior&regime2=json"
    with visit(browser, site.address, width) as visited:
        views = ("", "?paper=1", "landscape?regime=every&paper=1", "model/prior", "matrix", "compare", "answers")
        for view in (*(f"#/{each}" for each in views), "#/cases", "#/scenes", pair):
            page = visited.go(view)
            assert page.evaluate("document.documentElement.scrollWidth") <= width, view
            assert page.evaluate("document.querySelectorAll('h1').length") == 1


def test_a_view_is_taken_along_as_a_table_or_as_an_address(site: Site, browser: Browser, tmp_path: Path) -> None:
    board = site.workspace.tables.read(LEADERBOARD, {})
    with visit(browser, site.address) as visited:
        page = visited.go("#/?dataset=chaotic&regime=standard")
        with page.expect_download() as download:
            page.get_by_role("button", name="CSV").first.click()
        download.value.save_as(tmp_path / "board.csv")
        read = pd.read_csv(tmp_path / "board.csv").set_index("model")["pecs"].sort_index()
        wanted = board.loc[(board["dataset"] == "chaotic") & (board["regime"] == "standard")].set_index("model")["pecs"]
        pd.testing.assert_series_equal(read, wanted.sort_index())
        page.context.grant_permissions(["clipboard-read", "clipboard-write"])
        page = visited.go("#/pair/occlusion/hidden_race-0001?model=prior&regime=standard&run=1")
        page.get_by_role("button", name="Copy link").click()
        page.get_by_role("button", name="Copied").wait_for()
        address = page.evaluate("navigator.clipboard.readText()")
        page.get_by_label("speed").select_option("0.25")
        page.get_by_role("button", name="Play").click()
        until(page, "[...document.querySelectorAll('video')].every(video => video.playbackRate === 0.25)")
    with visit(browser, site.address) as visited:  # as a colleague opens it
        visited.page.goto(address)
        visited.page.wait_for_selector(".panel h3")
        assert "hidden_race-0001" in visited.page.inner_text(".lead")
        assert visited.page.locator(".panel h3").inner_text().startswith("prior, standard, run 1")


def test_what_an_address_names_wrongly_is_said(site: Site, browser: Browser) -> None:
    with visit(browser, site.address) as visited:
        pair = "#/pair/occlusion/hidden_race-0001"
        for view, place, named in (
            (f"{pair}?model=nobody", "main [role=alert]", r"\bnobody\b"),
            ("#/compare?left=nobody&right=nobody2", "main [role=alert]", r"\bnobody\b.*\bnobody2\b"),
            ("#/pair/occlusion", "main .notice", "Scenes"),
            ("#/pair/occlusion/none", "main:has(.notice) h1", r"\bnone\b.*occlusion"),
            ("#/answers?model=nobody", "main:has(.notice) .status", "^0 of 288"),
        ):
            assert re.search(named, visited.go(view).inner_text(place)), view


def test_scenes_play_and_cases_lead_to_both_answers(site: Site, browser: Browser) -> None:
    with visit(browser, site.address) as visited:
        page = visited.go("#/scenes?family=hidden_race")
        until(page, "document.querySelectorAll('video').length >= 3")
        until(page, "[...document.querySelectorAll('video')].every(video => video.readyState >= 1)")
        page = visited.go("#/cases?kind=textual")
        first = page.locator("table[data-name=cases] tbody tr").first
        visual, textual = (first.locator("a").nth(k).get_attribute("href") or "" for k in range(2))
        for view, decision in ((visual, "answered"), (textual, "abstained")):
            page = visited.go(view)
            assert page.locator(".side h4 .chip").last.inner_text() == decision


def test_text_of_a_model_is_text_wherever_it_is_shown(browser: Browser, tmp_path: Path) -> None:
    workspace = Workspace.create(tmp_path / "study", Study(name="hostile", scenarios=["plinko-0001"]))
    write_cell(workspace, text=HOSTILE)
    write_site(workspace, tmp_path / "site")
    with visit(browser, (tmp_path / "site" / "index.html").as_uri()) as visited:
        page = visited.go("#/pair/chaotic/plinko-0001?model=oracle")
        assert page.locator(".panel div.text").first.inner_text() == AS_SHOWN
        assert "refused" in page.locator(".side").last.locator(".notice").inner_text()
        assert page.locator("main script, main img, main iframe").count() == 0
        for view in ("#/answers", "#/answers?q=desrever"):
            page = visited.go(view)
            until(page, "document.querySelector('.excerpt .untrusted')")
            assert AS_SHOWN[40:] in page.locator(".excerpt").first.inner_text()  # from a little before what was found
            assert page.locator("main script, main img").count() == 0
        assert page.locator("mark").inner_text() == "desrever"
        assert "owned" not in page.title()


def test_what_was_not_run_or_cannot_be_read_says_so(browser: Browser, tmp_path: Path) -> None:
    workspace = Workspace.create(tmp_path / "study", Study(name="empty", scenarios=["plinko-0001"]))
    about = {"dataset": "chaotic", "pair_id": "chaotic:plinko-0001", "scenario_id": "plinko-0001"}
    items = [row(ITEMS, item_id=f"chaotic:plinko-0001:{side}", side=side, **about) for side in ("control", "void")]
    workspace.tables.write(ITEMS, {"dataset": "chaotic"}, items, {})
    write_site(workspace, tmp_path / "site")
    address = (tmp_path / "site" / "index.html").as_uri()
    with visit(browser, address) as visited:
        for view, place, named in (
            ("", "td.absent", NOT_RUN),
            ("matrix", "td.absent", NOT_RUN),
            ("compare", ".notice", NOT_RUN),
            ("answers", ".status", "0 of 0 answers"),
            ("pair/chaotic/plinko-0001", ".clip-absent", "`traps site`"),
            ("model/nobody", "main:has(.notice) h1", "nobody"),
            ("nowhere", ".notice", "nowhere"),
        ):
            assert named in visited.go(f"#/{view}").inner_text(place), view
    (tmp_path / "site" / "data" / "items.js").unlink()
    page = patient(browser.new_page())
    page.goto(address + "#/matrix")
    assert "items.js" in page.inner_text("main [role=alert]")
    page.close()
