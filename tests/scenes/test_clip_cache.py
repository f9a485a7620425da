"""Clips that one study has rendered serve the next: copied, checked, bounded, and never needed."""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from tests.build.frames import frames
from tests.conftest import ROOT, Checkout
from tests.remedies.remedied import remedied
from traps_pipeline.scenes.worlds import clip_cache
from traps_pipeline.scenes.worlds.clip_cache import VARIABLE, ClipCache
from traps_pipeline.scenes.worlds.clip_notes import clip_note_path, read_clip, save_clip

SCENE = "a" * 64
ONE_SCENARIO = "name: one\npanel: rules\nmodels: [oracle]\nscenarios: [hidden_race-0001]\n"
FRAMES = 3 * 50  # control, void and twin


@pytest.fixture
def clip(tmp_path: Path) -> Path:
    path = tmp_path / "one" / "clips" / "s-0001" / "void-aaaa.mp4"
    save_clip(path, frames(), 10, leaked_pixels=0.25)
    return path


@pytest.fixture
def cache(tmp_path: Path) -> ClipCache:
    return ClipCache(tmp_path / "cache", 1e9)


def entries(cache: ClipCache) -> list[Path]:
    return sorted(cache.folder.rglob("*.mp4"))


def test_another_study_gets_the_bytes_and_the_note_and_keeps_them_when_the_cache_changes(
    cache: ClipCache, clip: Path, tmp_path: Path
) -> None:
    cache.keep([clip], SCENE)
    other = tmp_path / "other" / clip.name
    assert cache.bring(other, SCENE)
    (entry,) = entries(cache)
    entry.write_bytes(b"something else")
    known = read_clip(other)
    assert known is not None and known.leaked_pixels == 0.25
    assert other.read_bytes() == clip.read_bytes()


@pytest.mark.parametrize("damaged", ["clip", "note"])
def test_an_entry_with_a_flipped_byte_is_removed_and_not_given(
    damaged: str, cache: ClipCache, clip: Path, tmp_path: Path
) -> None:
    cache.keep([clip], SCENE)
    (entry,) = entries(cache)
    path = entry if damaged == "clip" else clip_note_path(entry)
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)
    other = tmp_path / "other" / clip.name
    assert not cache.bring(other, SCENE) and not other.exists()
    assert entries(cache) == []
    cache.keep([clip], SCENE)
    assert cache.bring(other, SCENE)


def test_another_scene_another_side_and_another_renderer_are_other_clips(
    cache: ClipCache, clip: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    cache.keep([clip], SCENE)
    assert not cache.bring(tmp_path / clip.name, "b" * 64)
    assert not cache.bring(tmp_path / clip.name.replace("void", "control"), SCENE)
    monkeypatch.setattr(clip_cache, "_renderer_digest", lambda: "Mesa 99")
    assert not cache.bring(tmp_path / clip.name, SCENE)


def test_the_clips_that_were_used_longest_ago_go_first_and_the_rest_is_within_the_bound(
    cache: ClipCache, clip: Path, tmp_path: Path
) -> None:
    scenes = [letter * 64 for letter in "abcd"]
    for age, scene in enumerate(scenes):
        cache.keep([clip], scene)
        (entry,) = {*entries(cache)} - {path for path in entries(cache) if path.stat().st_mtime < 1000}
        os.utime(entry, (age, age))
    assert cache.bring(tmp_path / clip.name, "a" * 64)  # used now
    size = sum(path.stat().st_size for path in cache.folder.rglob("*.*"))
    small = ClipCache(cache.folder, size * 0.6)
    small.trim()
    assert [small.bring(tmp_path / clip.name, scene) for scene in scenes] == [True, False, False, True]
    assert sum(path.stat().st_size for path in cache.folder.rglob("*.*")) <= small.most_bytes


def test_many_at_once_bring_a_whole_clip_or_none(cache: ClipCache, clip: Path, tmp_path: Path) -> None:
    def work(n: int) -> bool:
        other = tmp_path / f"other-{n}" / clip.name
        cache.keep([clip], SCENE)
        return cache.bring(other, SCENE) and other.read_bytes() == clip.read_bytes()

    with ThreadPoolExecutor(8) as pool:
        assert all(pool.map(work, range(40)))
    assert not [*cache.folder.rglob("*.part")]


def test_a_cache_that_cannot_be_written_is_none(clip: Path, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    cache = ClipCache(tmp_path / "file", 1e9)
    cache.keep([clip], SCENE)
    cache.trim()
    assert not cache.bring(tmp_path / clip.name, SCENE)


def test_its_size_is_chosen_in_gigabytes_or_off(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setenv(VARIABLE, "much")
    chosen = remedied(
        ClipCache.of_user, "scenes.worlds.clip_cache.ClipCache", lambda: monkeypatch.setenv(VARIABLE, "0.5")
    )
    assert chosen == ClipCache(tmp_path / "traps" / "clips", 5e8)
    monkeypatch.setenv(VARIABLE, "off")
    assert ClipCache.of_user() is None


@pytest.mark.slow
def test_two_studies_with_the_same_scene_render_it_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.delenv(VARIABLE)
    (tmp_path / "one.yaml").write_text(ONE_SCENARIO)

    def frames_drawn_in(name: str) -> int:
        finished = Checkout(ROOT, tmp_path / name).traps("run", tmp_path / "one.yaml", "--until", "items").ok()
        return finished.counts()["frames"]

    def clips(name: str) -> dict[str, bytes]:
        return {path.name: path.read_bytes() for path in (tmp_path / name / "clips").rglob("*.mp4")}

    assert [frames_drawn_in("first"), frames_drawn_in("second")] == [FRAMES, 0]
    assert clips("first") == clips("second") and len(clips("first")) == 3
    for entry in (tmp_path / "cache").rglob("*.mp4"):
        content = bytearray(entry.read_bytes())
        content[1000] ^= 1
        entry.write_bytes(content)
    assert frames_drawn_in("third") == FRAMES and clips("third") == clips("first")
    monkeypatch.setenv(VARIABLE, "off")
    assert frames_drawn_in("fourth") == FRAMES
