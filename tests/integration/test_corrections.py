"""What a correction touches is asked and rendered again, and only that; Dagster shows the same partitions stale."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest

from tests.conftest import EXPERIMENT, Checkout
from tests.tables import TABLES
from traps_pipeline.benchmark.records import load_release
from traps_pipeline.models.asking.answer_rows import RESPONSES
from traps_pipeline.scoring.score_rows import METRICS
from traps_pipeline.storage.benchmark_tables import ITEMS, SCENE_SPECS, VIDEOS
from traps_pipeline.storage.workspace import Workspace

pytestmark = pytest.mark.slow


@pytest.fixture
def study(own_study: Checkout) -> Checkout:
    """A study whose records the tests correct."""
    return own_study


EVALUATIONS = 3 * 2 * 1  # models x regimes x runs of the small study

# Dagster's own verdict on every partition, by the resolver behind its UI, once sources are observed as sensors do it.
STALE = """
import json, os, sys
from pathlib import Path
import dagster as dg
from dagster._core.definitions.data_version import CachingStaleStatusResolver
from dagster._core.loader import LoadingContextForTest
from traps_pipeline.definitions import defs
from traps_pipeline.pipeline.graph import the_graph
from traps_pipeline.pipeline.history import History
from traps_pipeline.pipeline.lineage import Lineage
from traps_pipeline.storage.workspace import Workspace
graph = defs.get_repository_def().asset_graph
with dg.DagsterInstance.get() as instance:
    History(instance, the_graph()).observe(Lineage(Workspace.open(Path(os.environ["TRAPS_WORKSPACE"]))))
    resolver = CachingStaleStatusResolver(instance, graph, LoadingContextForTest(instance))
    nodes = [(s.name, k) for s in the_graph().stages for k in the_graph().keys(s.name) if k is not None]
    found = {f"{s}/{k}": resolver.get_status(dg.AssetKey(s), k).value for s, k in nodes}
print(json.dumps(sorted(name for name, status in found.items() if status == "STALE")))
"""


# The newest result of a check, as the UI shows it for the asset.
LATEST = """
import sys
import dagster as dg
key = dg.AssetCheckKey(dg.AssetKey(sys.argv[1]), sys.argv[2])
with dg.DagsterInstance.get() as history:
    record = history.event_log_storage.get_latest_asset_check_execution_by_key([key])[key]
    print(record.status.value, record.event.dagster_event.asset_check_evaluation_data.partition)
"""


def stale_in_dagster(study: Checkout) -> list[str]:
    finished = study.python("-c", STALE).ok()
    return json.loads(finished.out.splitlines()[-1])


def why(study: Checkout, item: str) -> list[str]:
    """The state of an item's answers, of each evaluation that has asked it."""
    return [each["state"] for each in json.loads(study.traps("why", item, "--json").ok().out)["evaluations"]]


def cells(*datasets: str) -> list[str]:
    models, regimes = ("oracle", "random-50", "prior"), ("standard", "json")
    return [f"{d}|{m}__{r}__run1" for d in datasets for m in models for r in regimes]


def materialize(study: Checkout, stage: str, *keys: str) -> None:
    for key in keys:
        study.dagster(
            *("asset", "materialize", "-m", "traps_pipeline.definitions", "--select", stage, "--partition", key)
        ).ok()


@pytest.mark.promise
def test_a_corrected_ill_posed_question_asks_one_item_again(study: Checkout) -> None:
    study.correct("plinko-0002", ill_posed_question="What does the triangle at the bottom weigh?")
    states = why(study, "chaotic_ill_posed:plinko-0002:void")
    keys = [row["key"][:12] for row in study.ledger_rows("answers")]
    # Each still stands under its key: nothing is made from the correction yet.
    assert len(states) == EVALUATIONS and all(any(key in state for key in keys) for state in states)
    run = study.score(EXPERIMENT).ok()
    assert run.counts() == {"answers": EVALUATIONS, "votes": 3 * EVALUATIONS, "frames": 0}
    # Versions change where the correction reaches, and nowhere else.
    tables = Workspace.open(study.workspace).tables
    release = load_release().version
    versions = tables.read_all(ITEMS).groupby("dataset")["benchmark_version"].unique()
    corrected = versions.pop("chaotic_ill_posed")
    assert len(corrected) == 1 and corrected[0].startswith(f"{release}+")
    assert {version for found in versions for version in found} == {release}
    specs = tables.read_all(SCENE_SPECS)
    assert set(specs.query("category != 'plinko'")["benchmark_version"]) == {release}
    assert set(tables.read_all(VIDEOS)["benchmark_version"]) == {release}  # a corrected question renders nothing


def test_dagster_shows_exactly_the_touched_partitions_stale_stage_by_stage(study: Checkout) -> None:
    assert stale_in_dagster(study) == []
    study.correct("hidden_race-0003", question="Which of the balls leaves the tunnel before the other ones?")
    stages = {row["stage"]: row for row in json.loads(study.traps("status", "--json").out)["stages"]}
    assert [*stages["scene_specs"]["stale"]] == ["hidden"]
    assert "corrections" in " ".join(stages["scene_specs"]["stale"]["hidden"])
    assert stale_in_dagster(study) == ["scene_specs/hidden"]
    materialize(study, "scene_specs", "hidden")
    assert stale_in_dagster(study) == ["items/occlusion", "items/occlusion_ill_posed", "videos/hidden"]
    materialize(study, "videos", "hidden")
    materialize(study, "items", "occlusion", "occlusion_ill_posed")
    touched = cells("occlusion", "occlusion_ill_posed")
    # Votes, verdicts and metrics are made from items as well as from what is before them.
    stale = [f"{stage}/{cell}" for stage in ("responses", "verdicts", "votes") for cell in touched]
    assert stale_in_dagster(study) == sorted([*stale, "metrics/occlusion", "metrics/occlusion_ill_posed"])
    run = study.score(EXPERIMENT)
    assert run.counts() == {"answers": 3 * EVALUATIONS, "votes": 15 * EVALUATIONS, "frames": 0}
    assert stale_in_dagster(study) == []


@pytest.mark.promise
def test_a_corrected_parameter_renders_that_scenario_alone(study: Checkout) -> None:
    clips = study.workspace / "clips"
    before = {path: path.stat().st_mtime_ns for path in clips.rglob("*.mp4")}
    azimuth = json.loads(_released(study, "domino_chain-0002"))["params"]["azimuth_deg"]
    study.correct("domino_chain-0002", params={"azimuth_deg": azimuth + 2.0})
    run = study.score(EXPERIMENT).ok()
    # Both items of `occlusion` and both of `occlusion_ill_posed` show new clips. Judges see no clip: a vote is asked
    # again only where the new answer reads otherwise, which is so for the random strategy at most.
    counts = run.counts()
    assert counts["votes"] <= 2 * (6 + 3) * 2
    assert (counts["answers"], counts["frames"]) == (4 * EVALUATIONS, 150)  # control, void, twin
    after = {path: path.stat().st_mtime_ns for path in clips.rglob("*.mp4")}
    assert {path: time for path, time in after.items() if path in before} == before
    new = set(after) - set(before)
    sides = {("domino_chain-0002", side) for side in ("control", "void", "twin")}
    assert {(path.parent.name, path.name.split("-")[0]) for path in new} == sides


def test_a_discarded_scenario_leaves_every_table_and_keeps_its_answers(study: Checkout) -> None:
    rows = study.ledger_rows("answers")
    study.correct("tumbling_dice-0003", action="discard")
    run = study.score(EXPERIMENT).ok()
    assert run.counts()["frames"] == 0
    before = {row["key"] for row in rows}
    asked = [row for row in study.ledger_rows("answers") if row["key"] not in before]
    # Nothing is asked again but `prior`, and that where the commonest answer of the dice changed with the scenario.
    assert {row["components"]["participant"] for row in asked} <= {"prior"}
    tables = Workspace.open(study.workspace).tables
    for table in TABLES.values():
        frame = tables.read_all(table)
        for column in ("scenario_id", "item_id", "pair_id"):
            if column in frame:
                assert not frame[column].str.contains("tumbling_dice-0003").any(), (table.name, column)
    cells = tables.read_all(METRICS, dataset="chaotic").query("scope == 'all'")
    assert (cells["n_pairs"] == 5).all()
    assert before <= {row["key"] for row in study.ledger_rows("answers")}
    assert len(why(study, "chaotic:tumbling_dice-0003:void")) == EVALUATIONS


def whole_benchmark(study: Checkout, folder: Path) -> Checkout:
    """A study of all occlusion scenarios of the same checkout, which two families are left of; its clips serve it."""
    for path in (study.root / "scene_specs" / "released").glob("*.jsonl"):
        if path.stem not in ("domino_chain", "hidden_race"):
            path.unlink()
    (folder / "whole.yaml").write_text(
        "name: whole\npanel: rules\nmodels: [oracle]\nregimes: [standard]\ndatasets: [occlusion]\n"
    )
    shutil.copytree(study.workspace / "clips", folder / "whole" / "clips")
    return Checkout(study.root, folder / "whole")


def test_an_added_scenario_joins_and_a_copy_is_told_by_every_run_until_it_is_gone(
    study: Checkout, demo: Checkout, tmp_path: Path
) -> None:
    params = json.loads(_released(study, "hidden_race-0001"))["params"]
    study.correct("hidden_race-9001", action="add", family="hidden_race", params=params)
    shutil.rmtree(study.workspace / "clips")
    shutil.copytree(demo.workspace / "clips", study.workspace / "clips")
    whole = whole_benchmark(study, tmp_path)
    for _ in range(2):  # the second run finds everything fresh, and still says so
        run = whole.traps("run", tmp_path / "whole.yaml", "--until", "responses")
        assert run.code == 1
        assert any("clips_distinct" in line and "videos/hidden" in line for line in run.err.splitlines()), run.err
    assert len(Workspace.open(whole.workspace).tables.read_all(RESPONSES)) == 2 * (8 + 6 + 1)
    (failing,) = json.loads(whole.traps("status", "--json").out)["checks"]
    assert (failing["check"], failing["stage"], failing["partition"]) == ("clips_distinct", "videos", "hidden")
    materialize(whole, "videos", "dominoes")  # another category passes, exit code 0; the failure stays Dagster's newest
    latest = whole.python("-c", LATEST, "videos", "clips_distinct")
    assert latest.out.split() == ["FAILED", "hidden"], latest.err
    study.correct("hidden_race-9001", params={"azimuth_deg": params["azimuth_deg"] + 3.0})
    run = whole.traps("run", tmp_path / "whole.yaml", "--until", "responses").ok()
    assert run.counts()["frames"] == 150


def _released(study: Checkout, scenario_id: str) -> str:
    family = scenario_id.rsplit("-", 1)[0]
    lines = (study.root / "scene_specs" / "released" / f"{family}.jsonl").read_text().splitlines()
    return next(line for line in lines if json.loads(line)["scenario_id"] == scenario_id)
