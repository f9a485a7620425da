"""Drawing scenarios: quotas keep answers balanced, few look alike, and what is written is what is read."""

from __future__ import annotations

import json
import re
import shutil
from collections import Counter
from pathlib import Path

import numpy as np
import pytest

from tests.build.errors import raises
from tools.redraw import draw_again, take_out
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.base.paths import RELEASED
from traps_pipeline.benchmark.records import load_released
from traps_pipeline.scenes.draw import sample as sampling
from traps_pipeline.scenes.draw.likeness import (
    NEAR_SHARE,
    excess_lookalike,
    frame_hash,
    lookalikes,
    perceptual_hash,
)
from traps_pipeline.scenes.draw.sample import (
    Draw,
    _full_answers,
    _mean_choices,
    answer_quota,
    load_tallies,
    rejection_kind,
    sample_family,
    try_draw,
)
from traps_pipeline.scenes.family_registry import get_family
from traps_pipeline.scenes.worlds.spec import load_trajectory


@pytest.mark.parametrize(
    ("count", "labels", "quota"),
    [
        (8, 2, 5),  # under ten: once more than the even split
        (7, 2, 5),
        (3, 3, 2),
        (6, 4, 3),
        (50, 2, 30),  # 60 % of two answers
        (200, 3, 100),  # 1.5 times the fair share
        (200, 6, 50),
        (50, 4, 18),
    ],
)
def test_the_quota_of_an_answer(count: int, labels: int, quota: int) -> None:
    assert answer_quota(count, labels) == quota
    assert answer_quota(count, labels) * labels >= count  # the quotas can be filled


def test_an_answer_that_few_questions_offer_has_its_quota_sooner() -> None:
    plinko = get_family("plinko")  # boards of five, six or seven buckets, a third each
    shares = {bucket: 1 / choices for bucket, choices in _mean_choices(plinko).items()}
    assert sum(shares.values()) == pytest.approx(1)
    assert shares["1"] == pytest.approx((1 / 5 + 1 / 6 + 1 / 7) / 3, abs=0.01)
    assert shares["7"] == pytest.approx(1 / 7 / 3, abs=0.01)
    counts = Counter({"1": 20, "7": 20})
    assert _full_answers(counts, 125, plinko) == {"7"}  # 125 x 1.5 x .17 = 31 and 125 x 1.5 x .047 = 8 are allowed


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two scenarios of hidden_race, drawn in one go."""
    folder = tmp_path_factory.mktemp("whole")
    tally = sample_family("hidden_race", 2, 11, folder, workers=1)
    assert (tally.seed, tally.wanted, tally.draws >= 2) == (11, 2, True)
    return folder


def stopped(folder: Path, at: str, family: str = "hidden_race", count: int = 2, seed: int = 11) -> list[str]:
    """What sampling says up to a line that holds some text, at which it is stopped."""
    said: list[str] = []

    def report(line: str) -> None:
        said.append(line)
        if at in line:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        sample_family(family, count, seed, folder, workers=1, report=report)
    return said


@pytest.mark.slow
def test_why_draws_are_rejected_is_said_at_the_first_draw_of_a_kind(tmp_path: Path) -> None:
    (said,) = stopped(tmp_path / "released", "", "ramp_race", 1, 6)
    reason = try_draw(Draw("ramp_race", 6, 0, frozenset(), tuple(sorted(get_family("ramp_race").looks))))
    assert said.startswith("ramp_race: ") and " 1 " in said and said.endswith(f": {reason}")


def test_a_family_that_is_not_full_after_all_its_draws_is_told_with_the_reasons(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sampling, "MAX_DRAWS", 0)
    with raises(TrapsError, "scenes.draw.sample.sample_family", "hidden_race", "0 of 2"):
        sample_family("hidden_race", 2, 11, tmp_path / "released", workers=1)


def test_a_reason_is_of_one_kind_whatever_was_measured() -> None:
    small = "outcome 'yes' has a margin of 0.0120 m, below 0.03 m"
    assert rejection_kind(small) == rejection_kind("outcome 'no' has a margin of 0.0041 m, below 0.03 m")
    assert (
        rejection_kind("the twin's void differs from the void: in 5 pixels") == "the twin's void differs from the void"
    )
    assert rejection_kind("answer 'yes' has its quota") != rejection_kind(small)


@pytest.mark.slow  # draws one scenario
def test_the_place_of_a_record_that_is_taken_out_is_filled_by_a_later_draw(tmp_path: Path, whole: Path) -> None:
    folder = shutil.copytree(whole, tmp_path / "again")
    lines = (folder / "hidden_race.jsonl").read_text(encoding="utf-8").splitlines()
    before = load_tallies(folder)["hidden_race"]
    far = json.loads(lines[0])
    far["params"]["run_m"] += 0.1  # which its draw does not give
    (folder / "hidden_race.jsonl").write_text(f"{json.dumps(far)}\n{lines[1]}\n", encoding="utf-8")
    altered = (folder / "hidden_race.jsonl").read_text(encoding="utf-8")
    assert draw_again(folder, "hidden_race", workers=1, only={"hidden_race-0002"}) == {}
    assert (folder / "hidden_race.jsonl").read_text(encoding="utf-8") == altered  # the other one is left alone
    ((taken_out, rejected),) = draw_again(folder, "hidden_race", workers=1).items()
    assert taken_out == "hidden_race-0001"
    assert (folder / "hidden_race.jsonl").read_text(encoding="utf-8").splitlines() == [lines[1]]
    assert not (folder / "trajectories" / "hidden_race-0001.npz").exists()
    tally = sample_family("hidden_race", 2, 11, folder, workers=1)
    after = (folder / "hidden_race.jsonl").read_text(encoding="utf-8").splitlines()
    assert [json.loads(line)["scenario_id"] for line in after] == ["hidden_race-0001", "hidden_race-0002"]
    assert after[1] == lines[1]
    assert json.loads(after[0])["seed"] >= before.draws > json.loads(lines[0])["seed"]
    assert tally.rejected[rejected] == 1
    assert tally.draws == 2 + tally.rejected.total()  # each draw is a record or has a reason
    with pytest.raises(KeyError):
        take_out(folder, {"hidden_race-0009": "is not there"})


def test_a_stopped_sampling_goes_on_and_gives_the_same_scenarios(tmp_path: Path, whole: Path) -> None:
    said = stopped(tmp_path / "halves", "hidden_race-0001: ")
    first = (tmp_path / "halves" / "hidden_race.jsonl").read_text(encoding="utf-8")
    assert len(first.splitlines()) == 1
    with (tmp_path / "halves" / "hidden_race.jsonl").open("a", encoding="utf-8") as lines:
        lines.write('{"scenario_id": "hidden_race-00')  # what a kill leaves of a line
    sample_family("hidden_race", 2, 11, tmp_path / "halves", workers=1, report=said.append)
    records = [line.split(":")[0] for line in said if line.startswith("hidden_race-")]
    assert records == ["hidden_race-0001", "hidden_race-0002"]
    for name in ("hidden_race.jsonl", "draws.json"):
        assert (tmp_path / "halves" / name).read_text(encoding="utf-8") == (whole / name).read_text(encoding="utf-8")
    specs = load_released(whole).values()
    load_released.cache_clear()
    assert len({spec.ill_posed_question for spec in specs}) == 2
    for spec in specs:
        path = tmp_path / "halves" / "trajectories" / f"{spec.scenario_id}.npz"
        load_trajectory(path, spec.trajectory_sha256)
        load_trajectory(path, spec.twin.trajectory_sha256, "twin")


@pytest.mark.slow  # draws one scenario
def test_a_draw_whose_first_frame_looks_like_that_of_another_is_rejected(tmp_path: Path, whole: Path) -> None:
    folder = shutil.copytree(whole, tmp_path / "again")
    lines, notes = folder / "hidden_race.jsonl", folder / "draws.json"
    record, tallies = json.loads(lines.read_text(encoding="utf-8").splitlines()[0]), json.loads(notes.read_text())
    # The drawing is set back to the draw that gave this record, which is there as one of an earlier draw.
    tallies["hidden_race"] |= {"draws": record["seed"], "rejected": {}}
    lines.write_text(json.dumps(record | {"seed": -1}) + "\n", encoding="utf-8")
    notes.write_text(json.dumps(tallies))
    (said,) = stopped(folder, "")
    assert said.startswith("hidden_race: ") and f" {record['seed'] + 1} " in said and "hidden_race-0001" in said


def test_another_seed_replaces_what_is_there(tmp_path: Path, whole: Path) -> None:
    shutil.copytree(whole, tmp_path / "released")
    sample_family("hidden_race", 1, 12, tmp_path / "released", workers=1)
    after = (tmp_path / "released" / "hidden_race.jsonl").read_text(encoding="utf-8")
    assert len(after.splitlines()) == 1
    assert after not in (whole / "hidden_race.jsonl").read_text(encoding="utf-8")
    assert [path.stem for path in (tmp_path / "released" / "trajectories").iterdir()] == ["hidden_race-0001"]


def test_records_of_another_version_of_a_familys_file_are_drawn_again(tmp_path: Path, whole: Path) -> None:
    folder = shutil.copytree(whole, tmp_path / "released")
    notes = json.loads((folder / "draws.json").read_text(encoding="utf-8"))
    assert sample_family("hidden_race", 2, 11, folder, workers=1).draws == notes["hidden_race"]["draws"]
    notes["hidden_race"]["file"] = "0" * 64
    (folder / "draws.json").write_text(json.dumps(notes), encoding="utf-8")
    first, *_ = stopped(folder, "hidden_race-0001: ")
    assert first.startswith("hidden_race: ") and not re.search(r"\d", first)  # of no draw and no record
    assert {path.stem for path in (folder / "trajectories").iterdir()} <= {"hidden_race-0001"}


def test_an_unknown_family_is_answered_with_the_known() -> None:
    with raises(KeyError, "scenes.family_registry.get_family", "trebuchet", "tumbling_dice"):
        get_family("trebuchet")


def test_a_hash_tells_places_and_not_shades() -> None:
    blocks = np.random.default_rng(0).integers(20, 200, (8, 6))
    picture = np.kron(blocks, np.ones((60, 60))).astype(np.uint8)[:, :, None].repeat(3, axis=2)
    assert perceptual_hash(picture) == perceptual_hash(picture + 40)
    assert (perceptual_hash(picture) ^ perceptual_hash(picture[:, ::-1].copy())).bit_count() > 8


def test_records_whose_hashes_differ_in_eight_bits_are_alike_and_in_nine_are_not() -> None:
    assert lookalikes({"a": 0, "b": 0xFF, "c": 0x1FF << 20}) == {"a": "b", "b": "a"}


def test_a_tenth_of_a_family_may_have_a_neighbour() -> None:
    looks = {f"x-{k}": 0xFFFF << 16 * k for k in range(4)}  # sixteen bits and more apart
    assert excess_lookalike(looks, 0xFFFF, 20) is None  # two of twenty
    assert excess_lookalike(looks, 0xFFFF, 19) == "x-0"
    assert excess_lookalike(looks, 0xFFFF0000 << 8, 19) is None
    assert excess_lookalike({**looks, "x-9": 0xFFFF}, 0xFFFF0001, 39) == "x-1"  # two were alike, four are more than 3.9
    assert excess_lookalike({**looks, "x-9": 0xFFFF}, 0xFFFF << 8, 19) is None  # it has no part in it


@pytest.mark.slow
def test_few_released_boards_of_plinko_look_like_another() -> None:  # of all families the one where most did
    specs = {id_: spec for id_, spec in load_released().items() if spec.family == "plinko"}
    files = {id_: RELEASED / "trajectories" / f"{id_}.npz" for id_ in specs}
    looks = {id_: frame_hash(spec, load_trajectory(files[id_], spec.trajectory_sha256)) for id_, spec in specs.items()}
    assert len(looks) == 50 and len(lookalikes(looks)) <= NEAR_SHARE * 50
