"""`traps people annotate` with scripted annotators in a real browser: what is sent and kept, and the tables of it."""

from __future__ import annotations

import json
import re
import sqlite3
import time
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pandas as pd
import pytest
from playwright.sync_api import Page

from tests.conftest import EXPERIMENT, Checkout
from tests.integration.listening import TOKEN, Server, listening
from tests.pages import a_browser, ready, until, watched
from traps_pipeline.people.human_label_rows import HUMAN_AGREEMENT, HUMAN_LABELS
from traps_pipeline.people.human_score_rows import CORRECTED, HUMAN_ROW, PANEL_ERRORS
from traps_pipeline.people.label_units import TaskName, label_units
from traps_pipeline.protocol.datasets import DATASETS
from traps_pipeline.report.tables.human_tables import people_notes
from traps_pipeline.scoring.score_rows import LEADERBOARD
from traps_pipeline.storage.benchmark_tables import ITEMS
from traps_pipeline.storage.workspace import Workspace

pytestmark = pytest.mark.slow
MODELS, REGIMES = ("oracle", "random-50", "prior", "observer"), ("standard", "guided")
SIDES = ("control", "void", "twin")


def forbidden(clips: Iterable[Mapping[str, Any]]) -> re.Pattern[str]:
    """What must never reach a browser. Scripts of the pages are the same for all, and name parts of a player."""
    scenarios = {row["scenario_id"] for row in clips}
    families = {scenario.rpartition("-")[0] for scenario in scenarios}
    names = "|".join((*MODELS, *REGIMES, *SIDES, *DATASETS, *scenarios, *families))
    return re.compile(rf"\b({names})\b|\.mp4", re.IGNORECASE)


@dataclass
class Traffic:
    """Everything that the browsers sent and got, but for the bytes of clips, from recordings (HAR)."""

    texts: list[str] = field(default_factory=list)
    scripts: set[str] = field(default_factory=set)
    clips: int = 0

    def read(self, recording: Path) -> None:
        for entry in json.loads(recording.read_text())["log"]["entries"]:
            request, answer = entry["request"], entry["response"]
            if not request["url"].startswith("http"):
                continue
            headers = [
                each for each in request["headers"] + answer["headers"] if each["name"].lower() != "cache-control"
            ]
            self.texts += [request["url"], *(f"{each['name']}: {each['value']}" for each in headers)]
            self.texts.append(request.get("postData", {}).get("text", ""))
            kind, text = answer["content"]["mimeType"], answer["content"].get("text", "")
            if kind.startswith("video/"):
                self.clips += 1
            elif kind.startswith("text/javascript"):
                self.scripts.add(text)
            else:
                self.texts.append(re.sub(r"<style>.*?</style>", "", text, flags=re.DOTALL))


@dataclass
class Knowing:
    """What a scripted annotator looks up: the labels' database, and the items behind units."""

    study: Checkout

    @property
    def folder(self) -> Path:
        return self.study.workspace / "labels"

    def units(self, task: TaskName) -> pd.DataFrame:
        workspace = Workspace.open(self.study.workspace)
        items = workspace.tables.read_all(ITEMS, ["item_id", "ground_truth"], dataset=DATASETS)
        return label_units(workspace, task).merge(items, on="item_id").set_index("unit")

    def waiting(self, who: str) -> str:
        (unit,) = self._ask("SELECT unit FROM shown WHERE who = ? AND waits ORDER BY at DESC LIMIT 1", who)[0]
        return unit

    def shown(self, who: str, since: float) -> list[str]:
        rows = self._ask(
            "SELECT scenario_id FROM shown WHERE task = 'answerability' AND who = ? AND at > ?", who, since
        )
        return [scenario for (scenario,) in rows]

    def a_day_passes(self) -> None:
        with sqlite3.connect(self.folder / "labels.sqlite") as database:
            database.execute("UPDATE shown SET at = at - 86400")

    def lines(self) -> list[dict[str, Any]]:
        return [json.loads(line) for line in (self.folder / "labels.jsonl").read_text().splitlines()]

    def _ask(self, query: str, *values: Any) -> list[Any]:
        with sqlite3.connect(self.folder / "labels.sqlite") as database:
            return database.execute(query, values).fetchall()


def label_clip(page: Page, truth: str | None) -> None:
    """Answer the clip on a page by keys; without a truth, say that it cannot be known."""
    ready(page)
    before = page.locator("#progress").inner_text()
    if truth is None:
        page.keyboard.press("x")
    else:
        page.keyboard.press("w")
        page.keyboard.type(truth)
        page.keyboard.press("Enter")
    until(page, f"!(document.getElementById('progress') || {{}}).textContent?.startsWith({json.dumps(before)})")


def press(page: Page, key: str) -> None:
    """Press a key after which the page shows something else."""
    ready(page)
    shown = "document.getElementById('shown')?.textContent"
    before = page.evaluate(shown)
    page.keyboard.press(key)
    until(page, f"{shown} && {shown} !== {json.dumps(before)}")
    ready(page)


def in_turn(server: Server, who: str, task: str) -> Iterator[dict[str, Any]]:
    """What a person is shown of a task, one after another as each is labelled, until nothing more is for now."""
    while True:
        status, page = server.ask("GET", f"/task/{task}", who=who)
        assert status == 200
        found = re.search(rb'id="shown">(.*?)</script>', page)
        if not found:
            return
        yield json.loads(found[1])


def give(server: Server, who: str, shown: dict[str, Any], label: dict[str, Any]) -> None:
    assert server.ask("POST", "/label", {"handle": shown["handle"], "label": label}, who=who) == (200, {"kept": True})


def test_two_people_label_blindly_a_kill_loses_nothing_and_the_tables_follow(study: Checkout, tmp_path: Path) -> None:
    knowing, traffic = Knowing(study), Traffic()
    clips = knowing.units("answerability").to_dict("index")
    truth = {str(unit): row["ground_truth"] if row["side"] == "control" else None for unit, row in clips.items()}
    never = forbidden(clips.values())
    with a_browser() as browser:
        recordings = {who: tmp_path / f"{who}.har" for who in ("jd", "ab")}
        pages = {who: watched(browser, recording=recording) for who, recording in recordings.items()}
        with listening(study, "annotate", *pages) as server:
            for who, (page, _) in pages.items():
                page.goto(server.addresses[who])
                page.get_by_role("link", name="Begin").first.click()
            for _ in range(3):  # both at once, in turn
                for who, (page, _) in pages.items():
                    ready(page)
                    label_clip(page, truth[knowing.waiting(who)])
            kept = knowing.lines()
            assert [line["who"] for line in kept] == ["jd", "ab"] * 3
            server.kill()
        page = pages["jd"][0]
        page.keyboard.press("x")  # nobody answers: the page says so, and stays
        until(page, "document.querySelector('#said.error')?.textContent")
        with listening(study, "annotate", *pages, port=server.port) as server:
            assert knowing.lines() == kept
            page.reload()
            assert page.locator("#progress").inner_text() == "3 of 48 labelled"
            ready(page)
            press(page, "u")  # the last one once more
            assert knowing.waiting("jd") == kept[4]["unit"]
            press(page, "x")
            assert knowing.lines()[-1] | {"at": "", "sum": "", "seconds": 0} == {
                "seq": 7, "task": "answerability", "unit": kept[4]["unit"], "who": "jd", "at": "", "seconds": 0,
                "label": {"answer": None}, "sum": "",
            }  # fmt: skip
            for who, (own, _) in pages.items():
                own.goto(f"http://127.0.0.1:{server.port}/task/abstention")
                press(own, "a")
                assert own.locator("#progress").inner_text().startswith("1 of ")
                assert knowing.lines()[-1]["who"] == who
            said = [text for _, problems in pages.values() for text in problems]
            # While it was killed: a connection was refused, or broke off with what was under way.
            ways = ("CONNECTION_REFUSED", "CONNECTION_RESET", "EMPTY_RESPONSE", "CONTENT_LENGTH_MISMATCH")
            assert said and {*said} <= {f"Failed to load resource: net::ERR_{way}" for way in ways}, said
            for who, (own, _) in pages.items():
                own.context.close()
                traffic.read(recordings[who])
            assert traffic.clips >= 6 and len(traffic.scripts) == 1
            assert sum('id="shown"' in text for text in traffic.texts) >= 8
            assert [found[0] for text in traffic.texts for found in never.finditer(text)] == []
            rest(server, knowing, truth)
    check_tables(study, knowing)


def rest(server: Server, knowing: Knowing, truth: Mapping[str, str | None]) -> None:
    """Both people label all clips, over several sittings; jd labels answers too."""
    for _ in range(6):
        began = time.time()
        for who in ("jd", "ab"):
            for shown in in_turn(server, who, "answerability"):
                right = truth[knowing.waiting(who)]
                give(server, who, shown, {"answer": "cannot tell which" if who == "ab" and right else right})
            met = knowing.shown(who, began - 3600)
            assert len(met) == len(set(met))  # no two clips of a scenario in one sitting
        knowing.a_day_passes()
    done = server.ask("GET", "/task/answerability", who="ab")[1].decode()
    assert "You have labelled all 48." in done
    tasks: tuple[tuple[TaskName, str], ...] = (("abstention", "abstained"), ("correctness", "correct"))
    for task, decision in tasks:
        panel = knowing.units(task)["panel"]
        for k, shown in enumerate(in_turn(server, "jd", task)):
            give(server, "jd", shown, {decision: bool(panel[knowing.waiting("jd")]) != (k % 10 == 9)})
            if k == 20:
                break


def check_tables(study: Checkout, knowing: Knowing) -> None:
    """`traps run` makes the tables of the labels, and nothing is asked for them."""
    workspace = Workspace.open(study.workspace)
    before = people_notes(workspace.tables.read_all(HUMAN_ROW), workspace.tables.read_all(PANEL_ERRORS))
    assert all("traps people annotate" in note for note in before)  # of people's scores, and of the panel's validation
    ran = study.traps("run", EXPERIMENT, "--until", "report_page").ok()
    assert ran.counts() == {"answers": 0, "votes": 0, "frames": 0}
    labels = workspace.tables.read(HUMAN_LABELS, {})
    assert len(labels) == len({(line["task"], line["unit"], line["who"]) for line in knowing.lines()})
    row = workspace.tables.read(HUMAN_ROW, {}).set_index("dataset").loc["overall"]
    # jd is always right but for the clip that was labelled again, and ab writes what is no answer to any control.
    assert (row["n_people"], row["n_clips"], row["n_labels"]) == (2, 48, 96)
    assert 0.45 < row["acc"] < 0.55 and row["abs_rec"] > 0.9 and row["false_abs"] < 0.1
    agreement = workspace.tables.read(HUMAN_AGREEMENT, {}).set_index(["task", "decision"])
    assert agreement.loc[("answerability", "abstained"), "n_shared"] == 48
    errors = workspace.tables.read(PANEL_ERRORS, {}).set_index("task")
    assert (
        (errors["n_answers"] >= 21).all() and (errors["sensitivity"] > 0.6).all() and errors["undefined"].isna().all()
    )
    corrected = workspace.tables.read(CORRECTED, {}).set_index(["model", "regime", "dataset"])
    board = workspace.tables.read(LEADERBOARD, {}).set_index(["model", "regime", "dataset"])
    both = corrected.merge(board, left_index=True, right_index=True, suffixes=("", "_board"))
    for name in ("acc", "abs_rec", "false_abs", "pecs", "pecs_ci_low", "pecs_ci_high"):
        assert both[name].to_numpy() == pytest.approx(both[f"{name}_board"].to_numpy(), nan_ok=True)
    assert both["pecs_corrected"].notna().all() and (both["pecs_corrected"] != both["pecs"]).any()
    after = people_notes(workspace.tables.read(HUMAN_ROW, {}), workspace.tables.read(PANEL_ERRORS, {}))
    assert re.search(r"\b2 \D+ 48\b", after[0]) and not [note for note in after if "traps people annotate" in note]


def test_strangers_and_others_get_nothing(study: Checkout) -> None:
    with listening(study, "annotate", "jd", "ab") as server:
        shown = next(in_turn(server, "jd", "answerability"))
        label = {"handle": shown["handle"], "label": {"answer": None}}
        clip = f"/clip/{shown['handle']}"
        assert server.ask("GET", clip, who="jd")[0] == 200
        assert server.ask("GET", clip, who="ab")[0] == 404  # a handle is one person's own
        assert server.ask("POST", "/label", label, who="ab")[0] == 404
        for wrong in (
            {"Origin": "http://evil.example"},
            {"Authorization": f"Bearer {TOKEN}"},
        ):  # tokens are made from it
            assert server.ask("POST", "/label", label, who="jd", **wrong)[0] == 403, wrong
        for path in ("/task/secrets", "/clip/0123", "/clip/plinko-0001", "/docs", "/../study.yaml", "/labels.sqlite"):
            assert server.ask("GET", path, who="jd")[0] == 404, path
        for wrong in ({"answer": ""}, {"answer": None, "side": "void"}, {"abstained": True}, {"answer": "x" * 201}):
            assert server.ask("POST", "/label", {**label, "label": wrong}, who="jd")[0] == 400, wrong
        assert not (study.workspace / "labels" / "labels.jsonl").read_text()
        give(server, "jd", shown, {"answer": None})
        assert server.ask("POST", "/label", label, who="jd")[0] == 409  # once is enough
        assert server.ask("POST", "/reopen", {"task": "correctness"}, who="jd")[0] == 404
    twice = study.traps("people", "annotate", "--who", "jd", "jd")
    assert twice.code == 1 and "--who jd jd" in twice.err
    beyond = study.traps("people", "annotate", "--who", "jd", "--host", "0.0.0.0")
    assert beyond.code == 1 and "TRAPS_ANNOTATE_TOKEN" in beyond.err
