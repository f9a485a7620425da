"""A row of one's own: a model and judges described in the experiment, a model that says dots, a panel that changes."""

from __future__ import annotations

import json
from pathlib import Path

import dagster as dg
import pytest

from tests.conftest import KEY, ROOT, SMALL, Checkout
from tests.providers.server import Provider
from tests.providers.servers import closed_port
from traps_pipeline.pipeline.run import dagster_history
from traps_pipeline.pipeline.step import EXPERIMENT_TAG
from traps_pipeline.scoring.score_rows import LEADERBOARD
from traps_pipeline.storage.workspace import Workspace

pytestmark = pytest.mark.slow


def experiment(study: Checkout, url: str, panel: str) -> Path:
    """Two models and three judges at a server, in four lines each or fewer."""
    judges = "".join(f'  - {{id: judge-{k}, base_url: "{url}/v1"}}\n' for k in "abc")
    scenarios = SMALL.read_text()[SMALL.read_text().index("scenarios:") :]
    path = study.workspace.parent / "own.yaml"
    path.write_text(
        "name: own\nmodels:\n"
        f'  - {{id: seer, base_url: "{url}/v1", served_name: org/Seer-7B, media: images}}\n'
        f'  - {{id: dots, base_url: "{url}/v1", media: images}}\n'
        f"judges:\n{judges}panels: {{three: [judge-a, judge-b, judge-c], one: [judge-a]}}\npanel: {panel}\n"
        f"regimes: [standard]\ndatasets: [occlusion]\n{scenarios}"
    )
    return path


def board(study: Checkout) -> dict[str, dict[str, object]]:
    rows = Workspace.open(study.workspace).tables.read(LEADERBOARD, {})
    own = rows.loc[rows["model"].isin(["seer", "dots"]) & (rows["dataset"] == "occlusion")]
    return {row["model"]: row for row in own.to_dict("records")}


@pytest.mark.promise
def test_a_model_that_says_dots_is_broken_and_not_modest_and_a_changed_panel_makes_exactly_its_own_stale(
    unasked: Checkout, provider: Provider
) -> None:
    provider.configure(scripts={"dots": {"fall": "....."}})  # to every question about dominoes
    finished = unasked.score(experiment(unasked, provider.url, "three"))
    # The study's other experiments are not run; a panel other than the study's is a contradiction.
    assert (finished.code, finished.raised) == (1, "pipeline.experiment.Experiment.judged")
    assert "'rules'" in finished.err and "'three'" in finished.err
    path = experiment(unasked, provider.url, "three")
    finished = unasked.traps("run", path, "--panel", "three", "--until", "leaderboard").ok()
    rows = board(unasked)
    assert all(str(row["panel"]).startswith("three@") for row in rows.values())
    assert rows["dots"]["is_broken"] and not rows["seer"]["is_broken"]
    assert rows["dots"]["n_degenerate"] == rows["dots"]["n_missing"] and float(str(rows["dots"]["broken"])) > 0.2

    path = experiment(unasked, provider.url, "one")
    assert unasked.traps("init", path, "--panel", "one").code == 0
    stages = json.loads(unasked.traps("status", path, "--json").out)["stages"]
    stale = {row["stage"] for row in stages if row["stale"]}
    assert {"votes", "verdicts", "metrics", "leaderboard"} <= stale and not {"responses", "items", "videos"} & stale
    again = unasked.traps("run", path, "--until", "leaderboard").ok()
    assert again.counts() == {"answers": 0, "votes": 0, "frames": 0}  # judge-a has voted before
    assert all(str(row["panel"]).startswith("one@") for row in board(unasked).values())


@pytest.mark.promise
def test_whatever_is_wrong_with_a_model_is_named_before_anything_is_rendered_or_judged(
    provider: Provider, tmp_path: Path
) -> None:
    dead = f"http://127.0.0.1:{closed_port()}/v1"
    said = '{"reason": "seen", "final_answer": "red and blue"}'
    provider.configure(
        fault_by_model={"wrong-name": "not_found", "wrong-key": "unauthorized"},
        blind=["blind"],
        scripts={"no-schema": {"": "red and then blue"}, "thinks": {"": f"<think>red, blue</think>{said}"}},
    )
    named = {
        "dead": dead,
        "wrong-name": "'wrong-name'",
        "wrong-key": KEY,
        "blind": " blue",  # a colour of the clip
        "no-schema": "`json_schema: false`",
        "thinks": "`thinking: ",
    }
    path = tmp_path / "broken.yaml"
    address = {name: dead if name == "dead" else f"{provider.url}/v1" for name in named}
    models = "".join(
        f'  - {{id: {name}, base_url: "{url}", key: {KEY}, media: images}}\n' for name, url in address.items()
    )
    path.write_text(f"name: broken\nmodels:\n{models}panel: rules\nscenarios: [domino_chain-0001]\n")
    study = Checkout(ROOT, tmp_path / "study")
    finished = study.traps("run", path, "--judged-by-rules")
    assert (finished.code, finished.raised) == (1, "checks.live_check.require_sound")
    *told, advice = (line for line in finished.err.splitlines() if not line.startswith(("! ", "preflight: ")))
    for (name, what), line in zip(named.items(), told, strict=True):
        assert f"{name}: " in line and what in line, finished.err
    assert "--no-preflight" in advice
    assert not list((study.workspace / "clips").rglob("*.mp4")) and not study.ledger_rows("answers")
    assert {row["components"]["about"]["check"] for row in study.ledger_rows("votes")} == {"clip", "no clip", "schema"}


@pytest.mark.parametrize("panel", ["rules", "three"])
def test_a_run_that_made_its_tables_prints_them_whatever_the_votes_are(
    unasked: Checkout, provider: Provider, panel: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    prose, endless = {"": "I think that it may fall, or so."}, {"": "The answer is: left." * 55_000}
    provider.configure(scripts={"org/Seer-7B": prose, "dots": endless, "judge-c": {"": "I say no JSON."}})
    path = experiment(unasked, provider.url, panel)
    options = ["--panel", panel, *(["--judged-by-rules"] if panel == "rules" else [])]
    for _ in range(2):
        finished = unasked.traps("run", path, *options, "--no-preflight")
        assert "\nreport " in finished.out and "\nexplorer " in finished.out and "seer" in finished.out
        assert "run the same command" not in finished.out + finished.err
        assert finished.code == (0 if panel == "rules" else 1)  # unread answers are counted; broken votes are told
        assert ("few_invalid_votes" in finished.err) == (panel == "three")
    # the answers of dots have no end, and the rules do not read those of seer, which are prose
    lacking = (
        "dots: 12 of 12 answers were unfinished"
        if panel == "three"
        else "dots, seer: 12 of 24 answers were unfinished, 12 unread"
    )
    assert lacking in finished.out and finished.out.index(lacking) < finished.out.index("Judged by")
    explorer = json.loads(
        (unasked.workspace / "reports" / "data" / "study.js").read_text().partition(",")[2].partition(",")[2][:-3]
    )
    titles = [column["title"] for column in explorer["counts"]]
    assert explorer["shortfall"].startswith(lacking)
    page = (unasked.workspace / "reports" / "report.html").read_text()
    assert lacking in page and titles and all(f">{title}<" in page for title in titles)
    monkeypatch.setenv("DAGSTER_HOME", str(unasked.workspace / "dagster"))
    with dagster_history(Workspace.open(unasked.workspace)) as instance:
        runs = instance.get_runs()
        events = [
            entry for run in runs for entry in instance.all_logs(run.run_id, dg.DagsterEventType.ASSET_CHECK_EVALUATION)
        ]
    own = [run for run in runs if run.tags.get(EXPERIMENT_TAG) == "own"]
    checks = [entry.get_dagster_event().asset_check_evaluation_data for entry in events]
    failed = {(check.check_name, check.severity) for check in checks if not check.passed}
    assert own and {run.status for run in own} == {dg.DagsterRunStatus.SUCCESS}  # what blocks nothing turns no step red
    assert failed == ({("few_invalid_votes", dg.AssetCheckSeverity.WARN)} if panel == "three" else set())
    rows = board(unasked)
    assert rows["seer"]["n_unread"] == (12 if panel == "rules" else 0)
    assert rows["dots"]["n_unfinished"] == rows["dots"]["n_missing"] == 12  # 1.1 MB in 8,000 tokens
