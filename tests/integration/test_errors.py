"""Bad input ends in a sentence that names the file and the remedy; no table is half-written, no answer is lost."""

from __future__ import annotations

import os
import sqlite3
import subprocess
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest
import yaml

from tests.build.records import edit_record
from tests.conftest import EXPERIMENT, ROOT, Checkout, Finished, forget_answers, make_checkout
from tests.lacking import lack
from traps_pipeline.models.tables import RESPONSES
from traps_pipeline.scoring.score_rows import METRICS
from traps_pipeline.storage.workspace import Workspace

pytestmark = pytest.mark.slow


def assert_refused(finished: Finished, *words: str) -> None:
    assert finished.code == 1, finished.out
    assert "Traceback" not in finished.err, finished.err
    for word in words:
        assert word in finished.err, finished.err


def test_a_malformed_spec_names_file_and_line(own_study: Checkout) -> None:
    path = own_study.root / "scene_specs" / "released" / "plinko.jsonl"
    lines = path.read_text().splitlines()
    path.write_text("\n".join([lines[0], lines[1][:50], *lines[2:]]) + "\n")
    assert_refused(own_study.traps("run", EXPERIMENT), f"{path}:2", "restore the line from git")


def test_an_unknown_family_is_answered_with_the_known_ones(own_study: Checkout) -> None:
    path = edit_record(own_study, "plinko", 1, family="plonko")
    assert_refused(
        own_study.traps("run", EXPERIMENT), f"{path}:1", "unknown family 'plonko'", "domino_chain, domino_count"
    )


def test_a_duplicate_scenario_names_the_second_line(own_study: Checkout) -> None:
    path = edit_record(own_study, "plinko", 2, scenario_id="plinko-0001")
    assert_refused(own_study.traps("run", EXPERIMENT), f"{path}:2", "'plinko-0001' occurs twice")


def test_a_label_outside_the_closed_set_is_refused(own_study: Checkout) -> None:
    own_study.correct("domino_chain-0001", answer="maybe")
    where = own_study.root / "scene_specs" / "corrections" / "review.jsonl"
    assert_refused(own_study.traps("run", EXPERIMENT), f"{where}:1", "'maybe' is not one of the labels ['yes', 'no']")


def test_a_correction_of_an_unknown_scenario_names_its_line(own_study: Checkout) -> None:
    own_study.correct("domino_chain-0001", action="keep")
    own_study.correct("domino_chain-0777", question="Who?")
    where = own_study.root / "scene_specs" / "corrections" / "review.jsonl"
    assert_refused(own_study.traps("run", EXPERIMENT), f"{where}:2", "'domino_chain-0777' is unknown")


def test_an_altered_trajectory_is_noticed(own_study: Checkout) -> None:
    folder = own_study.root / "scene_specs" / "released" / "trajectories"
    (folder / "plinko-0001.npz").write_bytes((folder / "plinko-0002.npz").read_bytes())
    own_study.correct(
        "plinko-0003", ill_posed_question="How heavy is the moon in the picture?"
    )  # makes the category stale
    assert_refused(
        own_study.traps("run", EXPERIMENT), "plinko-0001.npz", "is not the record's", "restore the file from git"
    )


def test_a_truncated_clip_is_noticed_and_rendered_anew_once_deleted(study: Checkout) -> None:
    clip = next((study.workspace / "clips" / "hidden_race-0001").glob("void-*.mp4"))
    whole = clip.read_bytes()
    clip.write_bytes(whole[: len(whole) // 2])
    assert_refused(study.traps("run", EXPERIMENT), str(clip), "truncated or altered", "delete it and run again")
    clip.unlink()
    again = study.score(EXPERIMENT)
    assert again.code == 0, again.err
    assert again.counts() == {"answers": 0, "votes": 0, "frames": 50}
    assert clip.read_bytes() == whole


def test_a_damaged_row_of_the_ledger_is_named_and_its_answer_alone_asked_again(study: Checkout) -> None:
    path = study.workspace / "ledger" / "ledger.sqlite"
    with closing(sqlite3.connect(path)) as opened:
        name = "oracle__json__run1"
        sql = "select min(r.id) from traps_rows r join traps_evaluations e on r.evaluation = e.id where e.name = ?"
        (row,) = opened.execute(sql, [name]).fetchone()
        opened.execute("update traps_rows set content = replace(content, 'answer', 'answes') where id = ?", [row])
        opened.commit()
    for table in (study.workspace / "tables" / "responses").glob("*/oracle/json/*.parquet"):
        table.unlink()
    finished = study.score(EXPERIMENT)
    assert finished.code == 0, finished.err
    assert f"{path}: row {row}: not what was written: it is not believed; its answer is asked again" in finished.err
    assert finished.counts()["answers"] == 1


def test_a_workspace_of_another_format_is_refused(study: Checkout) -> None:
    path = study.workspace / "study.yaml"
    path.write_text(yaml.safe_dump(yaml.safe_load(path.read_text()) | {"format": 99}))
    assert_refused(study.traps("run", EXPERIMENT), str(path), "format 99", "ledger folder can be copied over")


def test_a_workspace_keeps_its_benchmark(study: Checkout, tmp_path: Path) -> None:
    experiment = tmp_path / "other.yaml"
    experiment.write_text("name: other\nmodels: [oracle]\nscenarios: [plinko-0001]\n")
    assert_refused(study.traps("run", experiment), "a workspace keeps its benchmark", "choose another folder")


def test_unknown_names_are_answered_with_the_known_ones(study: Checkout, tmp_path: Path) -> None:
    known = ", ".join(sorted(path.stem for path in (study.root / "assets" / "experiments").glob("*.yaml")))
    assert_refused(study.traps("plan", "nonesuch"), "no experiment 'nonesuch'", f"known: arms, {known[6:]}, or give")
    experiment = tmp_path / "typo.yaml"
    experiment.write_text("name: typo\nmodels: [orakel]\n")
    assert_refused(study.traps("plan", experiment), "unknown model 'orakel'", "oracle")
    experiment.write_text("name: typo\nmodels: [oracle]\nregimes: [polite]\n")
    assert_refused(study.traps("plan", experiment), str(experiment), "regimes", "choose from standard, guided, json")
    mistyped = study.traps("run", EXPERIMENT, "--until", "leaderbord")
    assert_refused(mistyped, "--until leaderbord: no such stage", "leaderboard")
    assert_refused(study.traps("why", "occlusion:nothing-0001:void"), "is unknown", "an item is dataset:scenario:side")


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A file system of 1 MB."""
    folder = tmp_path / "small"
    folder.mkdir()
    mounted = (
        os.geteuid() == 0
        and subprocess.run(["mount", "-t", "tmpfs", "-o", "size=1m", "tmpfs", folder], check=False).returncode == 0
    )
    if not mounted:
        lack("mounting a tmpfs needs root")
    yield folder
    subprocess.run(["umount", "-l", folder], check=True)


def test_a_full_disk_ends_in_a_sentence_and_the_same_command_goes_on(study: Checkout, small_disk: Path) -> None:
    forget_answers(study)
    ledger = study.workspace / "ledger"
    ledger.symlink_to(small_disk, target_is_directory=True)
    filler = small_disk / "filler"
    filler.write_bytes(b"0" * 500_000)
    refused = study.score(EXPERIMENT)
    assert_refused(refused, "ledger.sqlite: cannot be read or written", "no space left", "run the same command again")
    kept = {row["key"] for row in study.ledger_rows("answers")}
    assert kept
    filler.unlink()
    # Tables made so far are whole; the rest follows with room for it.
    more = study.workspace.parent / "ledger"
    subprocess.run(["cp", "-r", f"{small_disk}/.", more], check=True)
    ledger.unlink()
    ledger.symlink_to(more, target_is_directory=True)
    finished = study.score(EXPERIMENT)
    assert finished.code == 0, finished.err
    rows = study.ledger_rows("answers")
    assert len({row["key"] for row in rows}) == len(rows) == 288  # 3 models x 2 regimes x 48 items
    assert not list(study.workspace.rglob("*.part"))


def test_a_history_that_cannot_be_written_ends_in_a_sentence_too(study: Checkout, small_disk: Path) -> None:
    (small_disk / "filler").write_bytes(b"0" * 700_000)
    full = Checkout(study.root, small_disk / "study")
    assert_refused(full.traps("run", EXPERIMENT), str(small_disk), "free some space")


def test_failed_calls_are_told_counted_as_missing_and_asked_again(study: Checkout, tmp_path: Path) -> None:
    text = (study.root / EXPERIMENT).read_text().replace("[oracle, random-50, prior]", "[flaky]")
    (tmp_path / "flaky.yaml").write_text(text)
    run = study.score(tmp_path / "flaky.yaml")
    assert run.code == 1
    assert "calls failed" in run.err
    rows = Workspace.open(study.workspace).tables.read_all(RESPONSES, model="flaky")
    outcomes = rows["outcome"].value_counts().to_dict()
    assert set(outcomes) == {"answer", "empty", "refused", "error"}
    assert rows.loc[rows["outcome"] != "answer", "text"].isna().all()  # no failure is a text
    cells = Workspace.open(study.workspace).tables.read_all(METRICS).query("model == 'flaky' and scope == 'all'")
    assert cells["n_missing"].sum() == outcomes["empty"] + outcomes["refused"] + outcomes["error"]
    assert cells["n_refused"].sum() == outcomes["refused"]
    assert (cells["acc"] == 1.0).all()  # an oracle behind a bad provider: what is missing is not wrong
    again = study.score(tmp_path / "flaky.yaml")
    assert again.code == 1
    assert again.counts()["answers"] == outcomes["error"]  # those that failed, and no other


def test_a_fresh_checkout_without_assets_says_what_it_is(tmp_path: Path) -> None:
    root = make_checkout(tmp_path / "half")
    subprocess.run(["rm", "-r", root / "scene_specs"], check=True)
    finished = Checkout(root, tmp_path / "none").traps("run", ROOT / EXPERIMENT)
    assert_refused(finished, "scene_specs is missing", "clone the repository")
