"""Each remedy that an error names is carried out as it is written, and the same command then goes on to the same
tables."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.build.studies import assert_same_tables
from tests.conftest import EXPERIMENT, Checkout, Finished

pytestmark = pytest.mark.slow
CELL = "occlusion|oracle__json__run1"
FILE = "occlusion/oracle/json/1.parquet"


@pytest.fixture
def study(own_study: Checkout) -> Checkout:
    """A study whose records the tests correct."""
    return own_study


def halve(path: Path) -> Path:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    return path


def cut_record(study: Checkout) -> Path:
    path = study.root / "scene_specs" / "released" / "plinko.jsonl"
    first, second, *others = path.read_text().splitlines(keepends=True)
    path.write_text("".join([first, second[:50] + "\n", *others]))
    return path


def swapped_trajectory(study: Checkout) -> Path:
    """The trajectory of another scene, beside a record that was edited, so that it is read again."""
    released = study.root / "scene_specs" / "released"
    first, *others = (released / "plinko.jsonl").read_text().splitlines(keepends=True)
    edited = json.loads(first) | {"ill_posed_question": "How heavy is the moon in the picture?"}
    (released / "plinko.jsonl").write_text("".join([json.dumps(edited) + "\n", *others]))
    path = released / "trajectories" / "plinko-0001.npz"
    shutil.copy(path.with_name("plinko-0002.npz"), path)
    return path


def halved_clip(study: Checkout) -> Path:
    return halve(next((study.workspace / "clips" / "hidden_race-0001").glob("control-*.mp4")))


def wrong_correction(study: Checkout) -> Path:
    study.correct("domino_chain-0777", action="keep")
    return study.root / "scene_specs" / "corrections" / "review.jsonl"


def restored(study: Checkout, path: Path, kept: Path) -> None:
    shutil.copytree(kept, study.root / "scene_specs", dirs_exist_ok=True)


def renamed(study: Checkout, path: Path, kept: Path) -> None:
    path.write_text(path.read_text().replace("domino_chain-0777", "domino_chain-0001"))


# What is done to a study, and what the error then says to do with the file that it names.
FAULTS: dict[str, tuple[Callable[[Checkout], Path], Callable[[Checkout, Path, Path], object]]] = {
    "a record cut short": (cut_record, restored),
    "another scene's trajectory": (swapped_trajectory, restored),
    "half of a clip": (halved_clip, lambda study, path, kept: path.unlink()),
    "a correction of no scene": (wrong_correction, renamed),
}


def test_each_remedy_for_a_file_lets_the_same_command_go_on(study: Checkout, small: Checkout, tmp_path: Path) -> None:
    shutil.copytree(study.root / "scene_specs", tmp_path / "kept")
    for name, (damaged, remedy) in FAULTS.items():
        path = damaged(study)
        finished = study.score(EXPERIMENT)
        assert finished.code == 1, finished.out
        assert str(path) in finished.err and "Traceback" not in finished.err, finished.err
        remedy(study, path, tmp_path / "kept")
        again = study.score(EXPERIMENT)
        assert again.code == 0, f"{name}: {again.err}"
        counts = again.counts()
        assert (counts["answers"], counts["votes"]) == (0, 0), f"{name}: {json.dumps(counts)}"
    assert_same_tables(study.workspace, small.workspace)


def test_the_stage_that_an_error_names_is_the_one_to_materialize(study: Checkout, small: Checkout) -> None:
    def materialize(stage: str) -> Finished:
        command = ("asset", "materialize", "-m", "traps_pipeline.definitions", "--select", stage)
        return study.dagster(*command, "--partition", CELL)

    tables = study.workspace / "tables"
    (tables / "votes" / FILE).unlink()
    halve(tables / "responses" / FILE)
    stage, made = "verdicts", []
    while (finished := materialize(stage)).code:
        assert len(made) < 4, finished.err[-3000:]
        named = re.findall(r"materialize (\w+) for (?:it again|this partition first)", finished.err + finished.out)
        assert named, finished.err[-3000:]
        made.append(named[-1])
        stage = named[-1] if materialize(named[-1]).code else "verdicts"
    assert set(made) <= {"responses", "votes"}
    assert made
    assert_same_tables(study.workspace, small.workspace)
