"""Arms and two events from an experiment to their figures, and variations to the table of hypotheses.

They are asked on request, made once, and no part of the pairs' figures.
"""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import pandas as pd
import pytest
from fastapi.testclient import TestClient
from playwright.sync_api import Browser

from tests.conftest import Checkout
from tests.pages import until, watched
from traps_pipeline.benchmark.records import load_released, two_events_lines
from traps_pipeline.models.asking.answer_rows import RESPONSES
from traps_pipeline.protocol.two_events import CLIPS, LANES, lane_items
from traps_pipeline.release.checksums import altered_files
from traps_pipeline.release.content import content_of
from traps_pipeline.release.folder import Options, write_release
from traps_pipeline.release.harness.scoring import TWO_WAY_METRICS, judge, run_metrics
from traps_pipeline.release.harness.write import write_harness
from traps_pipeline.release.submission import pack_submission, read_submission
from traps_pipeline.release.submissions import gather
from traps_pipeline.release.verification import released_items, verify
from traps_pipeline.report.explorer.site import write_site
from traps_pipeline.scenes.worlds.lane_records import TwoEventsSpec
from traps_pipeline.scoring.score_rows import GRADED_CUTS, HYPOTHESES, LEADERBOARD, TWO_WAY
from traps_pipeline.servers.review import Decision, Preview, Review, review_app
from traps_pipeline.servers.server import Refused
from traps_pipeline.storage.benchmark_tables import ARMS, ITEMS
from traps_pipeline.storage.parquet import TableStore
from traps_pipeline.storage.tables import records
from traps_pipeline.storage.workspace import Workspace

pytestmark = pytest.mark.slow
EXPERIMENT = """
name: with-arms
models: [oracle, any-rule, occluder-rule]
regimes: [standard]
panel: rules
epoch: small
scenarios: [hidden_race-0001, hidden_drop-e001, plinko-0001]
datasets:
  [occlusion, occlusion_ill_posed, chaotic, chaotic_ill_posed, twin_control, two_events,
   labels_two, labels_six, occluder_grey, schema_abstain, frames_few, graded]
"""


UNTIL = ("--until", "leaderboard,two_way,hypotheses,graded")


@pytest.fixture(scope="module")
def armed(small: Checkout, tmp_path_factory: pytest.TempPathFactory) -> tuple[Checkout, Path, dict[str, int]]:
    """A study of the experiment, which takes over the small study's clips; its file; and what its run counted."""
    folder = tmp_path_factory.mktemp("arms")
    (folder / "with-arms.yaml").write_text(EXPERIMENT)
    study = Checkout(small.root, folder / "armed")
    shutil.copytree(small.workspace / "clips", study.workspace / "clips")
    ran = study.traps("run", folder / "with-arms.yaml", *UNTIL).ok()
    return study, folder / "with-arms.yaml", ran.counts()


@pytest.fixture
def tables(armed: tuple[Checkout, Path, dict[str, int]]) -> TableStore:
    return Workspace.open(armed[0].workspace).tables


def test_arms_and_variations_are_asked_and_rendered_once(
    armed: tuple[Checkout, Path, dict[str, int]], tables: TableStore
) -> None:
    study, path, counts = armed
    # Pairs: 2 scenarios x 2 datasets x 2 sides. Arms: twin_control 2. Two events: 8.
    # Variations: 2 x 2 of the race, whose answers are colours, panel 1, schema and frames 2 x 2 each. A graded cut.
    assert counts["answers"] == 3 * (8 + 2 + 8 + (4 + 1 + 4 + 4) + 1)
    arms = tables.read_all(ARMS)
    # Grey, the graded cut and the four clips of two events; the others show the pair's own clips.
    assert counts["frames"] == 50 + 4 * 50 + arms.set_index("arm").loc["graded", "n_frames"]
    refused = arms.dropna(subset=["refused"])
    assert {*zip(refused["arm"], refused["scenario_id"], strict=True)} == {
        (arm, "plinko-0001")  # the numbers of its buckets are no colours
        for arm in ("labels_two", "labels_six")
    }
    assert study.traps("run", path, *UNTIL).counts() == {"answers": 0, "votes": 0, "frames": 0}


def test_each_text_and_each_clip_of_two_events_is_answered_as_often_as_not(tables: TableStore) -> None:
    items = tables.read_all(ITEMS, dataset="two_events")
    assert len(items) == 8 and items["clip"].nunique() == 4 and items["question"].nunique() == 2
    assert items.groupby("question")["side"].value_counts().eq(2).all()
    spec = two_events_lines()["hidden_drop-e001"].spec
    right = items.loc[items["item_id"].str.contains(":right.")]
    assert {*right["control_answer"]} == {*right["ground_truth"].dropna()} == {spec.lanes[1].ground_truth}
    shown = tables.read_all(ARMS).query("arm == 'two_events'").set_index("item")
    assert {*shown.index} == {item.name for item in lane_items("hidden_drop-e001")}


def test_a_rule_of_boards_earns_nothing_on_two_events(tables: TableStore) -> None:
    figures = tables.read_all(TWO_WAY).set_index("model")
    board = tables.read_all(LEADERBOARD).query("dataset == 'overall'").set_index("model")
    names = ["conjunction", "own_effect", "other_effect", "specificity"]
    assert figures.loc["oracle", names].tolist() == [1.0, 1.0, 0.0, 1.0] and board.loc["oracle", "pecs"] == 1.0
    assert board.loc["any-rule", "pecs"] == 1.0  # it understands nothing of a void
    assert figures.loc["any-rule", names].tolist() == [0.0, 0.0, 0.0, 0.0]  # a board stands in each of the four clips
    assert figures["refused"].isna().all()


@pytest.mark.parametrize("width", [390, 1280])
def test_four_clips_play_in_step_above_the_times_of_their_boards(
    armed: tuple[Checkout, Path, dict[str, int]], browser: Browser, tmp_path: Path, width: int
) -> None:
    write_site(Workspace.open(armed[0].workspace), tmp_path / "site")
    page, problems = watched(browser, width, ((tmp_path / "site").as_uri(), "data:,"))
    page.goto(f"{(tmp_path / 'site' / 'index.html').as_uri()}#/pair/two_events/hidden_drop-e001?model=oracle")
    until(page, "[...document.querySelectorAll('video')].filter(video => video.readyState >= 2).length === 4")
    spec = two_events_lines()["hidden_drop-e001"].spec
    comes_and_goes = [[[a / 10, b / 10] for a, b in record.lane.timetable.spans] for record in spec.lanes]
    for clip, hidden in CLIPS.items():
        figure = page.locator("figure").nth([*CLIPS].index(clip))
        tracks = [figure.locator(".track").nth(k).get_attribute("aria-label") or "" for k in range(4)]
        times = [[[float(t) for t in span] for span in re.findall(r"([\d.]+) to ([\d.]+) s", text)] for text in tracks]
        still = [[0.0, 5.0]]
        expected = [
            (still, goes) if is_hidden else (goes, still)
            for is_hidden, goes in zip(hidden, comes_and_goes, strict=True)
        ]
        assert times == [spans for lane in expected for spans in lane], clip
    page.locator("h1").click()
    for _ in range(12):
        page.keyboard.press("ArrowRight")
    seconds = "[...document.querySelectorAll('video')].map(video => video.currentTime)"
    until(page, f"{seconds}.every(time => time > 1.2 && time < 1.3)")
    assert page.locator(".now").evaluate_all("marks => marks.map(mark => mark.style.left)") == ["25%"] * 4
    rows = [page.locator(f"table[data-name={lane}_lane] tbody tr").all_inner_texts() for lane in LANES]
    for lane, record, texts in zip(LANES, spec.lanes, rows, strict=True):
        asked = [item for item in lane_items(spec.scenario_id) if item.lane == lane]
        answers = ["abstain" if item.asked_hidden else record.ground_truth for item in asked]
        assert [text.split("\t")[1].strip() for text in texts] == answers
        assert [("abstained" in text, "correct" in text) for text in texts] == [
            (item.asked_hidden, not item.asked_hidden) for item in asked
        ]
    assert page.evaluate("document.documentElement.scrollWidth") == width
    page.get_by_role("link", name="8 of 8").first.click()
    assert page.get_by_role("link", name="4 of 8").count() == 2  # any-rule and occluder-rule abstain on all
    page.context.close()
    assert problems == []


def test_two_events_are_reviewed_with_their_four_clips(armed: tuple[Checkout, Path, dict[str, int]]) -> None:
    review, id_ = Review(Workspace.open(armed[0].workspace), "jd"), "hidden_drop-e001"
    assert id_ in review.queue("all") and {side for scenario, side in review.clips if scenario == id_} == {*CLIPS}
    shown = TestClient(review_app(review)).get(f"/scenario/{id_}").text
    assert all(f"Hidden, {clip}: " in shown for clip in CLIPS)
    cost = review.preview(Preview(scenario_id=id_, changes={"question": "Left or right?"}))["cost"]
    assert cost.startswith("8 items ") and "24 answers" in cost  # of three models, under one regime
    with pytest.raises(Refused, match="drawn"):
        review.decide(Decision(scenario_id=id_, action="add", changes={}, why="more", seen=0))


def test_two_events_are_released_submitted_and_scored_by_others(
    armed: tuple[Checkout, Path, dict[str, int]], tables: TableStore, tmp_path: Path
) -> None:
    workspace, released = Workspace.open(armed[0].workspace), tmp_path / "released"
    write_release(content_of(workspace), released, Options())
    assert altered_files(released) == []
    (record,) = map(json.loads, (released / "two_events.jsonl").read_text().splitlines())
    spec = two_events_lines()["hidden_drop-e001"].spec
    assert TwoEventsSpec.model_validate_json(record["record"]) == spec
    items = [json.loads(line) for line in (released / "clips" / "metadata.jsonl").read_text().splitlines()]
    lanes = {row["item_id"]: row for row in items if row["dataset"] == "two_events"}
    assert {*lanes} == {item.item_id for item in lane_items(spec.scenario_id)}
    assert all((released / "clips" / row["file_name"]).is_file() for row in lanes.values())

    pack_submission(workspace, tmp_path / "mine.zip", "mine")
    submission = read_submission(tmp_path / "mine.zip")
    assert verify(submission, released_items(released)).problems == []
    board = gather([tmp_path / "mine.zip"], released).groups[0]
    stored = tables.read_all(TWO_WAY).drop(columns=["inference_acc", "inference_abstains"])
    assert records(board.two_way[stored.columns]) == records(stored)
    frames = {name: frame.copy() for name, frame in submission.tables.items()}
    frames["two_way.parquet"].loc[0, "conjunction"] = 0.5
    forged = verify(replace(submission, tables=frames), released_items(released)).problems
    assert len(forged) == 1 and "two_way" in forged[0] and "conjunction" in forged[0]
    frames = {name: frame.loc[~is_of(frame, lanes, "left.both")] for name, frame in submission.tables.items()}
    left_out = verify(replace(submission, tables=frames), released_items(released)).problems
    assert any("left.both: is in the release and was not asked" in problem for problem in left_out)

    write_harness(released, tmp_path / "harness")
    package = tmp_path / "harness" / "traps_harness"
    asked = [json.loads(line) for line in (package / "items.jsonl").read_text().splitlines()]
    assert len(asked) == 8 + 8 and {*lanes} <= {row["item_id"] for row in asked}
    said = tables.read_all(RESPONSES).query("model == 'any-rule'").set_index("item_id")["text"]
    found = run_metrics(judge(row, "answer", said[row["item_id"]], "standard") for row in asked)
    assert {name: found[name] for name in TWO_WAY_METRICS} == dict.fromkeys(TWO_WAY_METRICS, 0.0)


def is_of(frame: pd.DataFrame, lanes: Mapping[str, Any], name: str) -> Any:
    """Which rows are of an item of two events."""
    ids = frame["item_id"] if "item_id" in frame else pd.Series("", frame.index)
    return ids.isin([item_id for item_id in lanes if item_id.endswith(name)])


def test_variations_are_doses_of_their_hypotheses(tables: TableStore) -> None:
    doses = tables.read_all(HYPOTHESES).set_index(["model", "hypothesis", "dose"])
    grey = doses.loc[("occluder-rule", "occluder", "grey")]
    assert (grey["at_reference"], grey["value"], grey["rule_change"]) == (1.0, 0.0, -1.0)
    assert doses.loc[("oracle", "schema", "reason, abstain, final_answer"), "j"] == 1.0
    assert doses.loc[("oracle", "answer space", "6 answers"), "chance"] == pytest.approx(1 / 6)
    assert set(tables.read_all(ITEMS, dataset="labels_two")["labels"].map(len)) == {2}
    said = tables.read_all(RESPONSES, dataset="schema_abstain").query("model == 'oracle'")
    assert said["is_json"].all() and {json.loads(text)["abstain"] for text in said["text"]} == {True, False}


def test_a_graded_cut_is_scored_by_its_posterior(tables: TableStore) -> None:
    posterior = json.loads(tables.read_all(ARMS).set_index("arm").loc["graded", "evidence"])["posterior"]
    truth = load_released()["plinko-0001"].ground_truth
    graded = tables.read_all(GRADED_CUTS).query("scope == 'all'").set_index("model")
    assert graded.loc["oracle", "points"] == pytest.approx(4 * posterior[truth] - 3)  # it knows what came of it
    assert graded.loc["oracle", "points_best"] == pytest.approx(4 * max(posterior.values()) - 3)
    assert (graded.loc["any-rule", ["coverage", "points"]] == 0).all()  # it takes a short clip for a void
