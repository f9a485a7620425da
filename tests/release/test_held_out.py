"""Neither a held-out release nor what a study may publish beside it tells a side, or which items belong together."""

from __future__ import annotations

import json
import os
import shutil
import stat
import sys
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import pytest

from tests.build.errors import raises
from tests.conftest import ROOT, Checkout, copy_of
from traps_pipeline.base.digests import file_digest
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.benchmark import held_out
from traps_pipeline.benchmark.held_out import (
    MARKER,
    begin_publication,
    drawn_items,
    held_out_items,
    held_out_key,
    mark_held_out,
    require_secret_seed,
)
from traps_pipeline.benchmark.items import build_items
from traps_pipeline.benchmark.records import load_release
from traps_pipeline.protocol.datasets import DATASETS, TWO_EVENTS
from traps_pipeline.protocol.two_events import LaneItem, lane_item, lane_items
from traps_pipeline.release.content import Content, content_of
from traps_pipeline.release.folder import Options, write_release
from traps_pipeline.scoring.score_rows import LEADERBOARD
from traps_pipeline.storage.benchmark_tables import ITEMS, VIDEOS
from traps_pipeline.storage.workspace import Workspace
from traps_pipeline.video.encode import decode, frames_digest

pytestmark = pytest.mark.slow
NEAR = 1.2  # mean difference of two thumbnails, in levels, below which they show nearly the same
KEYS = 3  # releases of one study under as many keys, so that chance is known to a tenth


class Published(NamedTuple):
    """A released item: its row, its clip, and what its reader must not find out."""

    row: Mapping[str, Any]
    clip: Path
    scenario: str
    is_void: bool


def rows(path: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in path.read_text().splitlines()]


def published(folder: Path, key: Path) -> list[Published]:
    which = {row["item"]: row["item_id"] for row in rows(key.with_name(f"{key.name}.items.jsonl"))}
    items = rows(folder / "clips" / "metadata.jsonl")
    assert {row["item"] for row in items} == {*which}
    return [Published(row, folder / "clips" / row["file_name"], *_truth(which[row["item"]])) for row in items]


def _truth(item_id: str) -> tuple[str, bool]:
    dataset, scenario, side = item_id.split(":")
    return scenario, (lane_item(item_id).side if dataset == TWO_EVENTS else side) == "void"


@pytest.fixture(scope="module")
def study(demo: Checkout, tmp_path_factory: pytest.TempPathFactory) -> Checkout:
    return copy_of(demo, tmp_path_factory.mktemp("held"))


@pytest.fixture(scope="module")
def content(study: Checkout) -> Content:
    return content_of(Workspace.open(study.workspace))


@pytest.fixture(scope="module")
def releases(content: Content, tmp_path_factory: pytest.TempPathFactory) -> list[tuple[Path, Path]]:
    """Folder and key of releases under several keys, each as if it were the only one."""
    made, root = [], tmp_path_factory.mktemp("releases")
    for number in range(KEYS):
        (content.study / MARKER).unlink(missing_ok=True)
        folder, key = root / f"held-{number}", root / f"key-{number}"
        write_release(content, folder, Options(held_out=key))
        made.append((folder, key))
    return made


def test_each_item_is_alone_of_its_scenario_and_kinds_are_drawn_equally_often(
    releases: list[tuple[Path, Path]], content: Content
) -> None:
    draws = [tuple(sorted((one.scenario, one.is_void) for one in published(*release))) for release in releases]
    assert len({*draws}) == KEYS
    for draw in draws:
        assert [scenario for scenario, _ in draw] == sorted({row["scenario_id"] for row in content.items})
    for seed in range(5):
        drawn = drawn_items(content.items, bytes([seed]) * 32)
        kinds = Counter((row["dataset"], row["side"]) for row in drawn if row["dataset"] != TWO_EVENTS)
        assert set(kinds.values()) == {4}  # 16 of a taxonomy, 4 kinds
        again = drawn_items(reversed(content.items), bytes([seed]) * 32)
        assert [row["item_id"] for row in again] == [row["item_id"] for row in drawn]


def test_no_digest_name_size_date_or_order_links_an_item_to_another_or_to_the_study(
    releases: list[tuple[Path, Path]], content: Content, study: Checkout
) -> None:
    videos = Workspace.open(study.workspace).tables.read_all(VIDEOS)
    known = {*videos["file_sha256"], *videos["frames_sha256"], *(row["media_digest"] for row in content.items)}
    known |= {frames_digest(decode(path)[0]) for path in content.clips.values()}
    seen, told = Counter[str](), {row[n] for row in content.items for n in ("item_id", "pair_id", "scenario_id")}
    for folder, key in releases:
        items = published(folder, key)
        files = [path for path in folder.rglob("*") if path.is_file()]
        assert len({path.stat().st_mtime_ns for path in files}) == len({one.clip.stat().st_size for one in items}) == 1
        assert [one.row["item"] for one in items] == sorted(one.row["item"] for one in items)
        for one in items:
            assert one.row["media_digest"] == file_digest(one.clip) and one.clip.stem in one.row["media_digest"]
            seen.update([one.row["media_digest"], frames_digest(decode(one.clip)[0]), one.row["item"]])
        texts = "".join(path.read_text() for path in files if path.suffix != ".mp4")
        assert [name for name in told if name in texts] == []
        assert {*items[0].row} == {"item", "question", "file_name", "media_digest", "canary"}
    assert not known & {*seen} and {*seen.values()} == {1}


def test_an_items_clip_shows_what_its_study_showed(releases: list[tuple[Path, Path]], content: Content) -> None:
    clip_of = {row["item_id"]: content.clips[row["clip"]] for row in content.items}
    folder, key = releases[0]
    which = {row["item"]: row["item_id"] for row in rows(key.with_name(f"{key.name}.items.jsonl"))}
    for one in published(folder, key)[::4]:
        (own, own_times), (shown, times) = decode(one.clip), decode(clip_of[which[one.row["item"]]])
        assert np.array_equal(own_times, times) and own.shape == shown.shape
        error = np.abs(own.astype(int) - shown)
        assert 0.2 < error.mean() < 2.0 and (error > 12).mean() < 0.002  # levels of 255


def test_each_of_the_eight_items_of_two_events_is_drawn_as_often_as_any_other() -> None:
    items = [
        {"dataset": TWO_EVENTS, "taxonomy": "occlusion", "scenario_id": f"chain-e{n:03d}", **vars_of(item)}
        for n in range(24)
        for item in lane_items(f"chain-e{n:03d}")
    ]
    pairs = [
        {"dataset": "occlusion", "taxonomy": "occlusion", "scenario_id": f"chain-{n}", "side": side, "item_id": side}
        for n in range(3)
        for side in ("control", "void")
    ]
    drawn = [row["item_id"] for row in drawn_items([*pairs, *items], bytes(32)) if row["dataset"] == TWO_EVENTS]
    assert Counter(lane_item(item_id).name for item_id in drawn) == dict.fromkeys({i.name for i in lane_items("")}, 3)


def vars_of(item: LaneItem) -> dict[str, str]:
    return {"side": item.side, "item_id": item.item_id}


# --- attacks ----------------------------------------------------------------------------------------------------------


def distances(items: Sequence[Published]) -> np.ndarray:
    """Mean difference, in levels, of each sampled frame of each item to each of any other, (n, n, 3, 3)."""
    looks = [
        np.stack([cv2.resize(f, (32, 24), interpolation=cv2.INTER_AREA) for f in decode(one.clip)[0][[0, 6, -1]]])
        for one in items
    ]
    flat = np.stack(looks).astype(int).reshape(len(items), 3, -1)
    return np.stack([np.abs(one[None, :, None] - flat[:, None]).mean(-1) for one in flat])


def structure(items: Sequence[Published]) -> np.ndarray:
    """All that surrounds an item's own question and clip, (n, features)."""
    apart, questions = distances(items), np.array([one.row["question"] for one in items])
    of_scene, of_clip = apart.min((2, 3)) < NEAR, np.diagonal(apart, axis1=2, axis2=3).max(2) < NEAR
    same_words = questions[:, None] == questions[None]
    digests = [one.row["media_digest"] for one in items]
    features = [
        np.arange(len(items)), np.argsort(np.argsort(digests)), [int(d[:8], 16) for d in digests],
        [int(one.row["item"][:8], 16) for one in items], [one.clip.stat().st_size for one in items],
        [one.clip.stat().st_mtime_ns for one in items], [digests.count(d) for d in digests], same_words.sum(1),
        *((alike & words).sum(1) for alike in (of_scene, of_clip) for words in (True, same_words, ~same_words)),
    ]  # fmt: skip
    return np.array(features, float).T


def counted(items: Sequence[Published]) -> float:
    """How often this is right: an item that is alone with its question on its frames is a void."""
    of_clip = np.diagonal(distances(items), axis1=2, axis2=3).max(2) < NEAR
    questions = np.array([one.row["question"] for one in items])
    alone = (of_clip & (questions[:, None] == questions[None])).sum(1) == 1
    return float((alone == [one.is_void for one in items]).mean())


def learned(sets: Sequence[Sequence[Published]]) -> float:
    """Balanced accuracy of trees on the side of scenarios that they were not fitted on."""
    from sklearn.ensemble import ExtraTreesClassifier
    from sklearn.metrics import balanced_accuracy_score
    from sklearn.model_selection import GroupKFold, cross_val_predict

    features = np.concatenate([structure(items) for items in sets])
    is_void = np.array([one.is_void for items in sets for one in items])
    groups = [one.scenario for items in sets for one in items]
    trees = ExtraTreesClassifier(200, min_samples_leaf=2, random_state=0).set_params(class_weight="balanced")
    predicted = cross_val_predict(trees, features, is_void, groups=groups, cv=GroupKFold(8))
    return float(balanced_accuracy_score(is_void, predicted))


def test_who_has_the_folder_alone_is_at_chance_about_sides_and_no_two_items_are_linked(
    releases: list[tuple[Path, Path]],
) -> None:
    sets = [published(*release) for release in releases]
    for items in sets:
        assert np.array_equal(distances(items).min((2, 3)) < NEAR, np.eye(len(items), dtype=bool))
        assert counted(items) == np.mean([one.is_void for one in items])  # each is alone
        assert abs(counted(items) - 0.5) < 1 / len(items)  # half are voids, but for the one of two events
    assert abs(learned(sets) - 0.5) < 3 * 0.5 / np.sqrt(32 * KEYS)  # three standard errors


def test_the_attacks_succeed_on_a_release_of_whole_pairs(content: Content) -> None:
    whole = [
        Published({**row, "item": row["item_hash"]}, content.clips[row["clip"]], *_truth(row["item_id"]))
        for row in content.items
    ]
    assert counted(whole) == 1.0 and learned([whole]) > 0.9


def test_a_study_made_after_the_release_asks_the_released_items_alone(
    releases: list[tuple[Path, Path]], study: Checkout
) -> None:
    _, key = releases[-1]
    released, asked = (
        {row["item_id"] for row in rows(key.with_name(f"{key.name}.items.jsonl"))},
        (*DATASETS, TWO_EVENTS),
    )
    built = [row.item_id for dataset in asked for row in build_items(Workspace.open(study.workspace), dataset)]
    assert sorted(built) == sorted(released) and len(built) == 33


# --- the guard --------------------------------------------------------------------------------------------------------


def test_nothing_with_sides_is_published_of_a_study_whose_items_are_held_out(demo: Checkout, tmp_path: Path) -> None:
    study = copy_of(demo, tmp_path)
    key, held = tmp_path / "key", tmp_path / "held"
    study.traps("publish", "release", held, "--without-answers", key).ok()
    marker, out = study.workspace / MARKER, tmp_path / "out"
    commands = [
        ("publish", "submit", out, "--name", "mine"), ("site", out), ("results", "export", out),
        ("publish", "release", out), ("publish", "release", out, "--without-answers", tmp_path / "other"),
    ]  # fmt: skip
    for command in commands:
        finished = study.traps(*command)
        assert finished.code == 1 and not out.exists() and len(finished.err.splitlines()) == 1, command
        assert finished.raised in ("benchmark.held_out.begin_publication", "benchmark.held_out.mark_held_out")
    study.traps("publish", "release", held, "--without-answers", key).ok()  # the same again
    marker.unlink()
    study.traps("publish", "submit", out, "--name", "mine").ok()
    assert out.is_file()


def test_secrets_are_readable_by_their_owner_alone(releases: list[tuple[Path, Path]], content: Content) -> None:
    _, key = releases[-1]
    for path in (key, key.with_name(f"{key.name}.items.jsonl"), content.study / MARKER):
        assert stat.S_IMODE(path.stat().st_mode) == 0o600, path


def test_a_key_inside_the_folder_and_no_key_are_refused(content: Content, tmp_path: Path) -> None:
    inside = tmp_path / "held" / "key"
    with raises(TrapsError, "release.folder.write_release", str(inside)):
        write_release(content, tmp_path / "held", Options(held_out=inside))
    (tmp_path / "other").write_text("no key")
    with raises(TrapsError, "benchmark.held_out.held_out_key", str(tmp_path / "other"), "64"):
        held_out_key(tmp_path / "other")
    assert not (tmp_path / "held").exists() and not (tmp_path / "key").exists()


# --- kills ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("held_out", [False, True])
def test_a_kill_while_a_release_is_written_leaves_nothing_half_made_and_the_same_command_works(
    demo: Checkout, tmp_path: Path, held_out: bool
) -> None:
    study, folder = copy_of(demo, tmp_path), tmp_path / "out"
    part = tmp_path / ".out.new.part"
    command = ["publish", "release", folder, *(["--without-answers", tmp_path / "key"] if held_out else [])]
    for n_files in (1, 9, 20):
        process = study.start(sys.executable, "-m", "traps_pipeline.cli", *command)
        while process.poll() is None and sum(len(files) for _, _, files in os.walk(part)) < n_files:
            pass
        process.kill()
        process.communicate()
        assert not folder.exists() or (folder / "SHA256SUMS").is_file()
        shutil.rmtree(folder, ignore_errors=True)
    study.traps(*command).ok()
    study.traps("publish", "verify", folder).ok()
    assert sorted(path.name for path in tmp_path.iterdir() if "out" in path.name) == ["out"]


def test_files_are_created_in_the_order_of_their_names(releases: list[tuple[Path, Path]]) -> None:
    """A folder's own order, which archives keep, is that of creation on some disks; inodes are numbered by it."""
    for folder, _ in releases:
        clips = sorted((folder / "clips" / "items").glob("*.mp4"))
        created = sorted(clips, key=lambda path: path.stat().st_ctime_ns)
        assert len(clips) == 33 and created == clips


def test_one_key_gives_other_names_in_another_benchmark(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    key = tmp_path / "key"
    first = held_out_key(key, make=True)
    another = load_release().model_copy(update={"canary": "ANOTHER:CANARY:1"})
    monkeypatch.setattr(held_out, "load_release", lambda: another)
    assert held_out_key(key) != first and len(first) == len(held_out_key(key)) == 32


def test_a_map_of_another_release_is_not_overwritten(content: Content, tmp_path: Path) -> None:
    (content.study / MARKER).unlink(missing_ok=True)
    (tmp_path / "key.items.jsonl").write_text("{}\n")
    with raises(TrapsError, "release.folder._held_out_release", str(tmp_path / "key.items.jsonl")):
        write_release(content, tmp_path / "folder", Options(held_out=tmp_path / "key"))
    assert (tmp_path / "key.items.jsonl").read_text() == "{}\n"


@pytest.mark.parametrize(
    ("name", "seed"),
    [
        ("lab-4702163958821407365", 4702163958821407365), ("lab-4142-3b82-12cd-be85", 0x41423B8212CDBE85),
        ("lab", 2026), ("lab", 2**48 - 3), ("lab", 2026112820261128), ("lab", 1234567890123456789), ("lab", 10**18),
    ],
)  # fmt: skip
def test_a_seed_of_a_private_benchmark_that_is_told_or_guessed_is_refused(tmp_path: Path, name: str, seed: int) -> None:
    with raises(TrapsError, "benchmark.held_out.require_secret_seed", str(tmp_path)):
        require_secret_seed(private_benchmark(tmp_path, name, seed))
    require_secret_seed(private_benchmark(tmp_path / "remedied", "lab-12026", 4702163958821407365))


def private_benchmark(folder: Path, name: str, seed: int) -> Path:
    (folder / "released").mkdir(parents=True)
    draws = {"plinko": {"seed": seed, "wanted": 1, "draws": 1, "rejected": {}}}
    (folder / "released" / "draws.json").write_text(json.dumps(draws))
    canary = f"{name.upper()}:CANARY:7c1b9a52-2026-4b7f-9a64-2f5d8e0c41b6"
    (folder / "benchmark.yaml").write_text(f"name: {name}\nversion: 1.0.0\ncanary: '{canary}'\n")
    return folder


def test_a_private_benchmark_is_published_with_its_sides_or_held_out_and_copies_of_its_folders_are_known(
    content: Content, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    monkeypatch.setattr(held_out, "SCENE_SPECS", tmp_path / "private")
    drawn, otherwise = (drawn_items(content.items, bytes([seed]) * 32) for seed in (0, 1))
    begin_publication(tmp_path / "study", "a submission")
    with raises(TrapsError, "benchmark.held_out.mark_held_out", "a submission", "published.txt"):
        mark_held_out(tmp_path / "copied-study", drawn)
    (note,) = (tmp_path / "state" / "traps").iterdir()
    note.unlink()  # as the message says
    mark_held_out(tmp_path / "study", drawn)
    monkeypatch.setattr(held_out, "SCENE_SPECS", tmp_path / "copied")  # before the release, so that it has no marker
    copy = tmp_path / "copied-study"
    with raises(TrapsError, "benchmark.held_out.begin_publication", "the explorer"):
        begin_publication(copy, "the explorer")
    with raises(TrapsError, "benchmark.held_out.mark_held_out"):
        mark_held_out(copy, otherwise)
    assert {*held_out_items(copy).values()} == {row["item_id"] for row in drawn}
    assert stat.S_IMODE(next((tmp_path / "state" / "traps").iterdir()).stat().st_mode) == 0o600
    mark_held_out(copy, drawn)


def test_a_participant_who_answered_all_is_complete_though_a_dataset_has_no_drawn_item(tmp_path: Path) -> None:
    study = Checkout(ROOT, tmp_path / "study")
    study.workspace.mkdir()
    drawn = ["occlusion:domino_chain-0001:control", "occlusion:domino_chain-0002:void"]
    (study.workspace / MARKER).write_text(json.dumps(drawn))
    scenarios = "scenarios: [domino_chain-0001, domino_chain-0002]\n"
    (tmp_path / "held.yaml").write_text(
        f"name: held\nmodels: [oracle]\nregimes: [standard]\nruns: [1]\npanel: rules\n{scenarios}"
    )
    study.traps("run", tmp_path / "held.yaml").ok()
    tables = Workspace.open(study.workspace).tables
    board = tables.read_all(LEADERBOARD)
    columns = ["dataset", "n_pairs", "n_missing", "answered", "incomplete", "pecs", "rank"]
    assert board[columns].to_numpy().tolist() == [["occlusion", 2, 0, 1.0, False, 1.0, 1]]
    assert (
        tables.state(ITEMS, {"dataset": "occlusion_ill_posed"}) and sorted(tables.read_all(ITEMS)["item_id"]) == drawn
    )
    assert "incomplete" not in (study.workspace / "reports" / "leaderboard.md").read_text()
