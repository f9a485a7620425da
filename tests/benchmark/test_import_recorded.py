"""A folder of videos becomes a benchmark: real clips, made in the test, imported by the command."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from tests.build.recorded import TWO_EVENTS, WORDS, ball, balls, film, table
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.benchmark.footage import UnusableFootage
from traps_pipeline.benchmark.import_recorded import RECORDS, RecordedSpec, import_recorded
from traps_pipeline.benchmark.leaks import FILE, measure_leaks
from traps_pipeline.benchmark.recorded_clips import clip_path, make_clips
from traps_pipeline.benchmark.recorded_pairs import read_pairs
from traps_pipeline.benchmark.records import is_recorded, load_released, parse_two_events, two_events_lines
from traps_pipeline.scenes.worlds.spec import SceneSpec
from traps_pipeline.video.encode import decode


def one(folder: Path, **row: str) -> Path:
    """Write a folder of one pair, of three seconds, whose ball rolls aside from 1.5 s on."""
    film(folder / "c.mp4", ball("left"), options={"qp": "0", "preset": "ultrafast"})
    return table(folder, [{"id": "balls-0001", "control": "c.mp4", "answer": "left", **row}])


def clips_of(folder: Path):
    (pair,), problems = read_pairs(folder)
    assert problems == []
    return make_clips(pair, folder)


def test_a_cut_void_is_the_controls_own_beginning(tmp_path: Path) -> None:
    made = clips_of(one(tmp_path, cut_s="1.2"))
    assert len(made.clips["control"]) == 30
    assert len(made.clips["void"]) == 12
    assert all(np.array_equal(a, b) for a, b in zip(made.clips["void"], made.clips["control"], strict=False))
    assert made.void == {"cut_frame": 12}


def test_times_are_those_of_the_original_file(tmp_path: Path) -> None:
    made = clips_of(one(tmp_path, cut_s="1.9", start_s="0.5", end_s="2.5"))
    assert (len(made.clips["control"]), len(made.clips["void"])) == (20, 14)


def test_a_board_falls_over_its_part_alone_and_has_landed_when_it_says(tmp_path: Path) -> None:
    made = clips_of(one(tmp_path, cover="1.2 3 40 80 200 120"))
    control, void = (np.stack(made.clips[side]).astype(int) for side in ("control", "void"))
    changed = (control != void).any(axis=-1)
    assert not changed[:, 200:].any()
    assert not changed[:, :, :40].any()
    assert not changed[:, :, 240:].any()
    assert not changed[:8].any()
    # Its lower edge is 200 px from the top when it stands. Falling evenly faster it covers that way in 0.5 s, so 0.4 s
    # before there are (1 - 0.8)**2 of it: 8 px, and then 32, 72, 128.
    bottoms = [int(np.nonzero(changed[k].any(axis=1))[0].max()) + 1 for k in range(8, 12)]
    assert bottoms == [8, 32, 72, 128]
    for frame in void[12:]:
        board = frame[80:200, 40:240]
        assert (board == void[12][80:200, 40:240]).all()
        assert board.max() < 140  # as dark as a simulated one


def test_a_board_leaves_where_its_time_ends_before_the_clip(tmp_path: Path) -> None:
    made = clips_of(one(tmp_path, cover="0 1.5 40 80 200 120"))
    changed = [bool((a != b).any()) for a, b in zip(made.clips["control"], made.clips["void"], strict=True)]
    assert changed == [True] * 15 + [True] * 4 + [False] * 11


def test_a_cover_is_in_pixels_of_the_picture_as_it_is_seen(tmp_path: Path) -> None:
    film(tmp_path / "c.mp4", ball("left", size=(1280, 720)), options={"crf": "10", "preset": "ultrafast"})
    row = {"id": "balls-0001", "control": "c.mp4", "answer": "left", "cover": "0 9 641 361 601 301"}
    made = clips_of(table(tmp_path, [row]))
    assert made.clips["control"][0].shape == (312, 554, 3)
    changed = (np.stack(made.clips["void"]) != np.stack(made.clips["control"])).any(axis=(0, 3))
    rows, columns = (np.nonzero(changed.any(axis=axis))[0] for axis in (1, 0))
    # 641 to 1242 of 1280 is 277.4 to 537.6 of 554; 361 to 662 of 720 is 156.4 to 286.9 of 312: all in part covered.
    assert (columns.min(), columns.max()) == (277, 537)
    assert (rows.min(), rows.max()) == (156, 286)


@pytest.mark.parametrize(("y", "differs"), [(80, False), (110, True)])
def test_a_twin_proves_a_void_byte_for_byte_or_is_said_to_differ(tmp_path: Path, y: int, differs: bool) -> None:
    """The ball rolls aside above y = 110, which a board from there on does not hide."""
    film(tmp_path / "t.mp4", ball("right"), options={"qp": "0", "preset": "ultrafast"})
    cover = f"1.2 3 0 {y} 320 {240 - y}"
    made = clips_of(one(tmp_path, cover=cover, twin="t.mp4", twin_answer="right"))
    assert (made.evidence["twin_px"] > 0) == differs
    assert ["same byte for byte" in note for note in made.notes] == [not differs]
    assert not np.array_equal(made.clips["twin"][-1], made.clips["control"][-1])


def test_two_events_of_one_recording_are_hidden_by_themselves_both_or_not_at_all(tmp_path: Path) -> None:
    made = clips_of(one(tmp_path, **TWO_EVENTS, control_cover="2.5 3 0 80 150 160|2.5 3 160 80 160 160"))
    frames = {name: np.stack(clip) for name, clip in made.clips.items()}
    assert {*frames} == {"neither", "left", "right", "both"}
    halves = {name: (clip[:, :, :160], clip[:, :, 160:]) for name, clip in frames.items()}
    # Each half shows the same whether or not the other one is hidden.
    for half, same in enumerate((("neither", "right"), ("left", "both")), start=0):
        assert np.array_equal(halves[same[0]][0], halves[same[1]][0]), half
    assert np.array_equal(halves["neither"][1], halves["left"][1])
    assert np.array_equal(halves["right"][1], halves["both"][1])
    hidden = (frames["left"] != frames["neither"]).any(axis=-1)
    assert hidden[12:25, 80:240, :150].any() and not hidden[:, :, 150:].any()
    assert not hidden[25:].any()  # by then a board stands in each clip
    assert made.void == {
        "hides": [[(12, 30)]] * 2, "stands": [[(25, 30)]] * 2, "cover": [[0, 80, 150, 160], [160, 80, 160, 160]]
    }  # fmt: skip


def test_a_recording_of_two_events_becomes_eight_questions(tmp_path: Path) -> None:
    folder, out = balls(tmp_path / "in", 1, events=1), tmp_path / "out"
    (_, record), problems = import_recorded(folder, out, "some", workers=1)
    assert problems == []
    released = out / "two_events" / "released"
    (line,) = two_events_lines(released).values()
    assert line.spec == record
    for name, value in (("clips", {"both": "0"}), ("question", "Where?"), ("physics", {"fps": 10})):
        with pytest.raises(TrapsError, match=name):
            parse_two_events(json.dumps(json.loads(line.line) | {name: value}), "line 1")
    asked = {(q.item.name, q.text.split(" reach")[0], q.answer) for q in line.spec.questions()}
    red, blue = ("Which side does the red ball", "Which side does the blue ball")
    assert asked == {
        ("left.neither", red, "left"), ("right.neither", blue, "right"), ("left.left", red, None),
        ("right.left", blue, "right"), ("left.right", red, "left"), ("right.right", blue, None),
        ("left.both", red, None), ("right.both", blue, None),
    }  # fmt: skip


@pytest.mark.parametrize(
    ("row", "reason"),
    [
        ({}, "give one of void, cut_s, cover"),
        ({"cut_s": "1", "cover": "1 2 0 0 90 90"}, "not cut_s and cover"),
        ({"cut_s": "1", "answer": "lft"}, "did you mean left?"),
        ({"cut_s": "soon"}, "cut_s"),
        ({"cut_s": "1", "choices": "left"}, "choices"),
        ({"cut_s": "1", "id": "Ball 1"}, "id"),
        ({"cut_s": "1", "aliases": "links"}, "other=choice"),
        ({"cut_s": "1", "aliases": "links=rechts"}, "unknown labels ['rechts']"),
        ({"cut_s": "1", "start_s": "2"}, "between start_s and end_s"),
        ({"cover": "2 1 0 0 90 90"}, "from_s to_s x y width height"),
        ({"cover": "1 2 0 0 90"}, "cover"),
        ({"cover": "1 2 -1 0 90 90"}, "cover"),
        ({"cover": "nan 2 0 0 90 90"}, "cover"),
        ({"cut_s": "1", "twin": "c.mp4"}, "twin and twin_answer go together"),
        ({"cut_s": "1", "question": "left\nor right?"}, "hidden character"),
        ({"cut_s": "1", "control": "../c.mp4"}, "lies outside the folder"),
        ({"cut_s": "1", "control": "d.mp4"}, "is not there"),
        ({"cut_s": "1", "control": "d" * 300}, "is not there"),
        ({"cut_s": "2.9"}, "cut half a second or more"),
        ({"cover": "1 2 300 0 90 90"}, "leaves the picture, which is 320 x 240"),
        ({"cover": "9 10 0 0 90 90"}, "begins after the clip's end"),
        ({"two_events": "a|b", "cut_s": "1", "answer": "left|right"}, "and a cover for each"),
        ({"two_events": "a|b", "cover": "1 2 0 0 90 90", "answer": "left"}, "two answers and two boards"),
        ({"cover": "1 2 0 0 90 90|1 2 99 0 90 90"}, "a pair has one of each"),
        (TWO_EVENTS | {"question": "Which side?"}, "for {} in the question"),
        (TWO_EVENTS | {"two_events": "red|red"}, "two names"),
        (TWO_EVENTS | {"cover": "1 2 0 0 90 90|1 2 80 0 90 90"}, "stand side by side"),
        (TWO_EVENTS | {"control_cover": "1 2 0 0 90 90|1 2 80 0 90 90"}, "stand side by side"),
    ],
)
def test_a_wrong_line_gets_one_sentence(tmp_path: Path, row: dict[str, str], reason: str) -> None:
    film(tmp_path / "c.mp4", ball("left"))
    line = WORDS | {"id": "balls-0001", "control": "c.mp4", "answer": "left", **row}
    (tmp_path / "pairs.jsonl").write_text(json.dumps(line) + "\n", encoding="utf-8")
    pairs, problems = read_pairs(tmp_path)
    for pair in pairs:
        with pytest.raises(UnusableFootage) as refused:
            make_clips(pair, tmp_path)
        problems.append(str(refused.value))
    assert len(problems) == 1
    assert reason in problems[0]


def test_what_cannot_be_read_leaves_the_rest_imported(tmp_path: Path) -> None:
    folder = balls(tmp_path / "in", 1)
    good = json.dumps(WORDS | {"id": "balls-0001", "control": "0.mp4", "answer": "left", "cut_s": "1.2"})
    (folder / "broken.mp4").write_bytes(b"no")
    bad = good.replace("0.mp4", "broken.mp4").replace("0001", "0002")
    (folder / "pairs.csv").unlink()
    (folder / "pairs.jsonl").write_text("\n".join((bad, "{", "3", good, good)), encoding="utf-8")
    records, problems = import_recorded(folder, tmp_path / "out", "some", workers=1)
    assert [record.scenario_id for record in records] == ["balls-0001"]
    assert [problem.split(" ")[0] for problem in problems] == [
        *("pairs.jsonl:2:", "pairs.jsonl:3:", "pairs.jsonl:5:", "balls-0002:"),
    ]


def test_an_import_is_read_as_records_and_goes_on_where_it_stopped(tmp_path: Path) -> None:
    folder, out = balls(tmp_path / "in", 3), tmp_path / "out"
    first, problems = import_recorded(folder, out, "some", workers=2)
    assert (len(first), problems) == (3, [])
    load_released.cache_clear()
    assert [*load_released(out / "released").values()] == first
    assert is_recorded(out / "released")
    clips = {path: path.stat().st_mtime_ns for path in (out / "released").rglob("*.mp4")}
    assert len(clips) == 7  # of three pairs, one with a twin
    clip_path(out / "released", "balls-0003", "void").unlink()
    again, _ = import_recorded(folder, out, "other", workers=1)
    assert again == first
    kept = {path for path, made in clips.items() if path.stat().st_mtime_ns == made}
    assert {path.parent.name for path in clips.keys() - kept} == {"balls-0003"}
    words = (folder / "pairs.csv").read_text(encoding="utf-8").replace("Which side", "Which end")
    (folder / "pairs.csv").write_text(words, encoding="utf-8")
    worded, _ = import_recorded(folder, out, "other", workers=1)
    assert all(record.question.startswith("Which end") for record in worded)
    assert [record.scene_hash for record in worded] == [record.scene_hash for record in first]


def test_a_clip_holds_nothing_of_its_original_but_its_picture(tmp_path: Path) -> None:
    folder, out = tmp_path / "in", tmp_path / "out"
    film(folder / "the-answer-is-left.mp4", ball("left"), sound=True)
    row = {"id": "balls-0001", "control": "the-answer-is-left.mp4", "answer": "left", "cut_s": "1.2"}
    (record,), _ = import_recorded(table(folder, [row]), out, "some", workers=1)
    assert len(record.evidence["originals"]["control"]) == 64
    for path in (out / "released").rglob("*"):
        if path.is_file():
            assert b"the-answer-is-left" not in path.read_bytes()
            assert b"secret title" not in path.read_bytes()


def test_a_benchmark_of_both_kinds_is_refused(tmp_path: Path) -> None:
    folder, out = balls(tmp_path / "in", 1), tmp_path / "out"
    import_recorded(folder, out, "some", workers=1)
    simulated = next(Path("scene_specs/released").absolute().glob("plinko.jsonl")).read_text().splitlines()[0]
    (out / "released" / "plinko.jsonl").write_text(simulated + "\n")
    for act in (lambda: is_recorded(out / "released"), lambda: import_recorded(folder, out, "some", workers=1)):
        with pytest.raises(TrapsError, match="never averaged"):
            act()


def pairs_of(records: Sequence[RecordedSpec]) -> list[SceneSpec]:
    return [record for record in records if isinstance(record, SceneSpec)]


def noisy(answer: str, number: int) -> list[np.ndarray]:
    """Return a ball's frames with a sensor's noise."""
    rng = np.random.default_rng([number, *answer.encode()])
    frames = ball(answer, number, n=22, size=(128, 96))
    return [np.clip(frame + rng.integers(-9, 10, frame.shape), 0, 255).astype(np.uint8) for frame in frames]


def test_a_leak_that_was_planted_is_found(tmp_path: Path) -> None:
    """Voids that were encoded twice, coarsely, differ in detail from all controls; others do not."""
    j_of_detail = {}
    for planted in (False, True):
        folder, rows = tmp_path / str(planted), []
        for k in range(6):
            film(folder / f"{k}.mp4", noisy("left", k))
            void = film(folder / f"{k}v.mp4", noisy("right", k))
            if planted:
                film(void, decode(void)[0], options={"crf": "40", "preset": "ultrafast"})
            rows.append({"id": f"balls-{k}", "control": f"{k}.mp4", "void": f"{k}v.mp4", "answer": "left"})
        records, problems = import_recorded(table(folder, rows), folder / "out", "some", workers=1)
        assert problems == []
        measure_leaks(pairs_of(records), folder / "out")
        rows = json.loads((folder / "out" / FILE).read_text(encoding="utf-8"))
        (j_of_detail[planted],) = (row["j"] for row in rows if row["cue"] == "detail")
    assert j_of_detail[True] == 1
    assert j_of_detail[False] < 0.5


def test_the_same_clip_under_two_names_is_a_near_duplicate(tmp_path: Path) -> None:
    folder = tmp_path / "in"
    rows = []
    for k, number in enumerate((0, 1, 0)):
        film(folder / f"{k}.mp4", ball("left", number), options={"crf": str(16 + k), "preset": "ultrafast"})
        rows.append({"id": f"balls-{k}", "control": f"{k}.mp4", "answer": "left", "cut_s": "1.2"})
    records, _ = import_recorded(table(folder, rows), tmp_path / "out", "some", workers=1)
    lines = [line for line in measure_leaks(pairs_of(records), tmp_path / "out").splitlines() if "nearly" in line]
    assert [line.split(":")[0] for line in lines] == ["balls-0 and balls-2"]


def test_a_record_without_its_clips_is_refused(tmp_path: Path) -> None:
    (record,), _ = import_recorded(balls(tmp_path / "in", 1), tmp_path / "out", "some", workers=1)
    line = record.model_dump(mode="json")
    assert SceneSpec.model_validate(line) == record
    with pytest.raises(ValueError, match=r"params\.clips"):
        SceneSpec.model_validate(line | {"params": {"size": [320, 240]}})


@pytest.mark.slow
def test_the_command_imports_and_says_that_nothing_is_certified(tmp_path: Path) -> None:
    folder, out = balls(tmp_path / "in", 6), tmp_path / "out"
    (folder / "broken.mp4").write_bytes(b"no")
    with (folder / "pairs.csv").open("a") as file:
        file.write(
            (folder / "pairs.csv").read_text().splitlines()[1].replace("0.mp4", "broken.mp4").replace("0001", "9")
        )
    command = [sys.executable, "-m", "traps_pipeline.cli", "benchmark", "import", str(folder), "--out", str(out)]
    done = subprocess.run(command, capture_output=True, text=True, env=os.environ, timeout=300, check=False)
    assert done.returncode == 1
    assert "6 pairs" in done.stdout
    assert "not certified" in done.stdout
    assert "broken.mp4" in done.stderr
    assert len((out / "released" / RECORDS).read_text().splitlines()) == 6
