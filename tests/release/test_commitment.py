"""A revealed benchmark is proven to be the committed one; a changed record, seed or number is refused."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import pytest

from tests.build.commitments import committed
from tests.build.errors import raises
from tests.conftest import ROOT, Checkout
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.benchmark.records import load_released
from traps_pipeline.release.commitment import (
    broken_seals,
    commit,
    is_same_scene,
    read_commitment,
    read_reveal,
    revealed_specs,
)

__all__ = ["committed"]  # a fixture

pytestmark = pytest.mark.slow


@pytest.fixture
def copy(committed: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(committed, tmp_path / "copy"))


def edit(path: Path, **changes: Any) -> Path:
    path.write_text(json.dumps(json.loads(path.read_text()) | changes) + "\n")
    return path


def problems(folder: Path) -> list[str]:
    files = read_commitment(folder / "commitment.json"), read_reveal(folder / "reveal.json")
    return broken_seals(*files, revealed_specs(folder / "private"))


def named(problems: list[str]) -> list[str]:
    """What each problem names first."""
    return [problem.partition(": ")[0] for problem in problems]


def test_the_seed_draws_the_committed_records_again(committed: Path, tmp_path: Path) -> None:
    checkout = Checkout(ROOT, tmp_path / "none")  # no study is needed
    given = committed / "commitment.json", committed / "reveal.json", "--specs", committed / "private"
    finished = checkout.traps("benchmark", "prove", *given, "--workers", "1")
    assert finished.code == 0, finished.out + finished.err
    assert "hidden_drop-0001: " in finished.out  # which is drawn
    outcome = json.loads(checkout.traps("benchmark", "prove", *given, "--without-drawing", "--json").ok().out)
    assert outcome["problems"] == [] and len(outcome["proven"]) == 1


def test_a_commitment_tells_neither_the_seed_nor_a_record(committed: Path) -> None:
    text, reveal = (committed / "commitment.json").read_text(), read_reveal(committed / "reveal.json")
    (spec,) = load_released(committed / "private" / "released").values()
    assert [word for word in (reveal.nonce, spec.spec_hash, spec.scene_hash, spec.question) if word in text] == []
    assert (committed / "reveal.json").stat().st_mode & 0o077 == 0


def test_an_edited_record_is_named(copy: Path, committed: Path) -> None:
    assert problems(committed) == []
    edit(copy / "private" / "released" / "hidden_drop.jsonl", ill_posed_question="What does it weigh?")
    edit(copy / "private" / "two_events" / "released" / "hidden_drop.jsonl", question="Left or right?")
    assert named(problems(copy)) == ["hidden_drop-0001", "hidden_drop-e001"]


def test_records_that_were_left_out_or_added_are_named(copy: Path) -> None:
    spec, lanes = revealed_specs(copy / "private").values()
    other = spec.model_copy(update={"scenario_id": "hidden_drop-0002"})
    files = read_commitment(copy / "commitment.json"), read_reveal(copy / "reveal.json")
    left = {each.scenario_id: each for each in (other, lanes)}
    assert named(broken_seals(*files, left)) == ["hidden_drop-0001", "hidden_drop-0002"]
    assert named(broken_seals(*files, {spec.scenario_id: spec})) == ["hidden_drop-e001"]


# Records are sealed with the number, too.
@pytest.mark.parametrize(("change", "n_broken"), [({"seed": 2027}, 1), ({"nonce": "0" * 64}, 3)])
def test_another_seed_or_number_is_refused_before_anything_is_drawn(
    copy: Path, tmp_path: Path, change: dict[str, Any], n_broken: int
) -> None:
    reveal = edit(copy / "reveal.json", **change)
    checkout = Checkout(ROOT, tmp_path / "none")
    finished = checkout.traps("benchmark", "prove", copy / "commitment.json", reveal, "--specs", copy / "private")
    assert (finished.code, finished.raised) == (1, "cli.benchmark_commands.verify_commitment")
    told = finished.out.splitlines()  # and of no draw
    assert len(told) == n_broken and "hidden_drop" not in told[0]


def test_records_that_were_chosen_and_not_drawn_are_refused(copy: Path, committed: Path) -> None:
    """Whoever edits a record and then commits can seal it, but the seed still draws the other one."""
    edit(copy / "private" / "released" / "hidden_drop.jsonl", ill_posed_question="What does it weigh?")
    commit(copy / "private", copy / "c.json", copy / "r.json")
    given = copy / "c.json", copy / "r.json", "--specs", copy / "private"
    proved = Checkout(ROOT, copy / "none").traps("benchmark", "prove", *given, "--workers", "1", "--json")
    assert proved.code == 1 and named(json.loads(proved.out)["problems"]) == ["hidden_drop-0001"]
    drawn = load_released(committed / "private" / "released")  # what the seed draws, as the first test shows
    chosen = load_released(copy / "private" / "released")
    assert not is_same_scene(drawn["hidden_drop-0001"], chosen["hidden_drop-0001"])
    elsewhere = drawn["hidden_drop-0001"].model_copy(update={"trajectory_sha256": "0" * 64})
    assert is_same_scene(drawn["hidden_drop-0001"], elsewhere)


def test_a_commitment_is_made_once_and_of_one_draw(copy: Path, tmp_path: Path) -> None:
    with raises(TrapsError, "release.commitment.commit", str(copy / "commitment.json")):
        commit(copy / "private", copy / "commitment.json", tmp_path / "reveal.json")
    (copy / "private" / "released" / "draws.json").unlink()
    with raises(TrapsError, "release.commitment.commit", str(copy / "private"), "`traps benchmark sample`"):
        commit(copy / "private", tmp_path / "c.json", tmp_path / "r.json")
    with raises(TrapsError, "release.commitment._read", str(copy / "reveal.json")):
        read_commitment(copy / "reveal.json")
