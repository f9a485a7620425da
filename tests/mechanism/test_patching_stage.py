"""The patching stage: its ratio, interval and flips worked out by hand, which cells are patched, which tokens count as
changed, where the nulls of a pair come from, and what a killed run leaves."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.local_models import SYSTEM, ask, clip, model
from tests.mechanism.own_process import printed, start
from tests.mechanism.study import PAIRS, SETTINGS, make_study, register, tiny_entry
from traps_pipeline.base.digests import file_digest
from traps_pipeline.mechanism import patching_stage
from traps_pipeline.mechanism.directions import seeded_order
from traps_pipeline.mechanism.mechanism_rows import PROBE_ITEMS
from traps_pipeline.mechanism.patching_effects import Patch, RecordedPass, trace_pass
from traps_pipeline.mechanism.patching_stage import (
    Side,
    best_cells,
    effect_of,
    groups_of,
    patching_rows,
    summarize_effects,
)
from traps_pipeline.mechanism.probe_items import probe_items
from traps_pipeline.models.local.adapter import LocalModel, Prompt, load_local_model
from traps_pipeline.models.local.spans import changed_tokens, token_spans
from traps_pipeline.models.registry.entries import ModelEntry, get_model
from traps_pipeline.models.registry.prompts import vqa_prompt
from traps_pipeline.protocol.cells import Extraction
from traps_pipeline.protocol.datasets import SIDES
from traps_pipeline.storage.benchmark_tables import ITEMS
from traps_pipeline.storage.media import MediaSpec, pick_frames
from traps_pipeline.storage.study import PatchingSettings
from traps_pipeline.storage.workspace import Workspace
from traps_pipeline.video.encode import encode

pytestmark = pytest.mark.slow
TINY = Extraction("tiny", "standard")
QUESTION = "Does the ball end up left or right?"


def test_an_effect_is_a_ratio_of_sums_with_the_interval_of_resampled_pairs() -> None:
    before, after, there = np.zeros(2), np.ones(2), np.array([2.0, 4.0])
    effect, low, high = effect_of(before, after, there, 0)
    assert effect == pytest.approx(2 / 6)  # a mean of ratios were 3/8
    assert low is not None and high is not None and low < 1 / 4 and high > 1 / 2
    moved = effect_of(before - 3, after - 3, there - 3, 0)
    assert moved == pytest.approx((effect, low, high))  # from where one starts tells nothing


def test_pairs_that_all_move_whole_or_not_at_all_leave_an_interval_its_width() -> None:
    """With an unseen pair of the same weight the end is a quantile of Beta(n, 1): .025^(1/n)."""
    for n in (1, 2, 8):
        end = 0.025 ** (1 / n)
        assert effect_of(np.zeros(n), np.ones(n), np.ones(n), 0) == (1, pytest.approx(end, abs=0.05), 1)
        assert effect_of(np.zeros(n), np.zeros(n), np.ones(n), 0) == (0, 0, pytest.approx(1 - end, abs=0.05))


def test_sides_that_do_not_differ_have_no_effect() -> None:
    assert effect_of(np.zeros(2), np.ones(2), np.zeros(2), 0) == (None, None, None)
    assert effect_of(np.zeros(2), np.ones(2), np.array([4.0, 0.0]), 0)[0] == pytest.approx(1 / 2)


def change(scenario: str, before: float, after: float, there: float, **other: Any) -> dict[str, Any]:
    about = {"scenario": scenario, "into": "control", "source": "pair"}
    about |= {"site": "residual", "layer": 1, "group": "stamps", "tokens": 4}
    return about | {"before": before, "change": after - before, "there": there} | other


def left_out(scenario: str, into: str, source: str) -> dict[str, Any]:
    return {"scenario": scenario, "into": into, "source": source, "left_out": True}


def test_rows_count_flips_among_pairs_that_could_flip_and_say_which_were_left_out() -> None:
    estimates = [
        change("a", -2.0, 1.0, 2.0),
        change("b", -2.0, -1.5, 2.0),
        change("c", -2.0, -2.5, -3.0),
        change("a", -2.0, -1.0, 2.0, group="last"),
        left_out("d", "control", "pair"),
        left_out("e", "control", "pair"),
    ]
    patches = [
        change("a", -2.0, 1.0, 2.0),  # flips, and could
        change("b", -2.0, -1.0, 2.0, tokens=8),  # could, and does not
        change("c", -2.0, 1.0, -3.0, tokens=6),  # flips, though both sides say the same
        left_out("a", "void", "other scenario"),
        left_out("d", "control", "other scenario"),
        change("a", -2.0, 0.0, 2.0, source="other scenario"),
    ]
    rows = {(row.into, row.source, row.group): row for row in summarize_effects(estimates, patches, TINY, "chaotic", 0)}
    assert set(rows) == {
        ("control", "pair", "stamps"), ("control", "pair", "last"), ("control", "other scenario", "stamps"),
        ("void", "other scenario", "all"),
    }  # fmt: skip
    stamps = rows["control", "pair", "stamps"]
    assert stamps.effect == pytest.approx((3 + 1 + 3) / (4 + 4 - 1))
    assert stamps.attributed == pytest.approx((3 + 0.5 - 0.5) / (4 + 4 - 1))
    assert (stamps.flips, stamps.n_flippable, stamps.n, stamps.n_left_out) == (0.5, 2, 3, 2)
    assert stamps.tokens == 6 and (stamps.site, stamps.layer) == ("residual", 1)
    last = rows["control", "pair", "last"]  # estimated alone
    assert (last.attributed, last.effect, last.flips, last.n) == (0.25, None, None, 1)
    null = rows["control", "other scenario", "stamps"]  # a margin of 0 is neither sign
    assert (null.effect, null.flips, null.n, null.n_left_out) == (0.5, 1.0, 1, 1)
    nothing = rows["void", "other scenario", "all"]
    assert (nothing.effect, nothing.low, nothing.high, nothing.flips) == (None, None, None, None)
    assert (nothing.n, nothing.n_flippable, nothing.n_left_out) == (0, 0, 1)


def test_no_flips_are_reported_where_no_pair_could_flip() -> None:
    (row,) = summarize_effects([], [change("a", 1.0, -1.0, 2.0)], TINY, "chaotic", 0)
    assert row.effect == -2.0 and row.flips is None and row.n_flippable == 0


def test_the_cells_with_the_largest_sums_of_estimates_are_patched_at_every_so_many_layers() -> None:
    sizes = {("residual", 0, "all"): 9.0, ("residual", 2, "last"): -5.0, ("residual", 1, "last"): 8.0,
             ("mlp", 4, "last"): 3.0, ("attention", 5, "all"): 2.0, ("mlp", 2, "all"): 1.0}  # fmt: skip
    estimates = [
        change(scenario, 0.0, share * size, 1.0, site=site, layer=layer, group=group)
        for (site, layer, group), size in sizes.items()
        for scenario, share in (("a", 1.5), ("b", -0.5))
    ]
    estimates.append(change("a", 0.0, 0.1, 1.0, into="void", layer=2))
    chosen = best_cells(estimates, PatchingSettings(exact=3, stride=2), 5)
    into_control = [("attention", 5, "all"), ("mlp", 4, "last"), ("residual", 2, "last")]  # 5: the last layer
    assert chosen == [*(("control", *cell) for cell in into_control), ("void", "residual", 2, "stamps")]


# --- which tokens changed ---------------------------------------------------------------------------------------------


def pocket() -> tuple[LocalModel, np.ndarray, np.ndarray]:
    shown = pick_frames(clip(), get_model("pocket").media or MediaSpec(profile="frames"))
    return load_local_model(get_model("pocket"), inside=True), shown.frames, shown.times_s


def side(of: LocalModel, frames: np.ndarray, times_s: np.ndarray, question: str = QUESTION) -> Side:
    prompt = of.prompt(SYSTEM, question, frames, times_s)
    return Side(prompt, token_spans(of, prompt, SYSTEM, question))


def test_one_changed_square_of_pixels_is_one_changed_token() -> None:
    """The pocket reads squares of 16 pixels in pairs of frames: 8 x 6 tokens for each of four pairs."""
    of, frames, times = pocket()
    altered, faintly = frames.copy(), frames.copy()
    altered[5, 32:48, 64:80] = 255 - altered[5, 32:48, 64:80]  # third pair of frames, row 2, column 4
    one, other = side(of, frames, times), side(of, altered, times)
    n_visual = int(one.parts["visual"].sum())
    assert n_visual == 4 * 48
    found = changed_tokens(one.prompt, other.prompt, one.parts["visual"])
    assert found is not None and np.flatnonzero(found[one.parts["visual"]]).tolist() == [2 * 48 + 2 * 8 + 4]
    groups = groups_of(one, other)
    assert groups is not None
    visual = one.parts["visual"]
    assert np.flatnonzero(groups["changed"]).tolist() == np.flatnonzero(visual & found).tolist()
    assert (groups["changed"] | groups["unchanged"]).tolist() == one.parts["visual"].tolist()
    assert not (groups["changed"] & groups["unchanged"]).any() and groups["all"].all()
    for part in ("system", "stamps", "question", "last"):
        assert groups[part].tolist() == one.parts[part].tolist()
    faintly[5, 32:48, 64:80] += np.uint8(3)  # as a codec might: no change
    same = changed_tokens(one.prompt, side(of, faintly, times).prompt, visual)
    assert same is not None and not same.any()


def test_where_pixels_do_not_come_token_by_token_all_visual_tokens_count_as_changed() -> None:
    of = model("llava-next-video")
    prompt = ask(of)
    parts = token_spans(of, prompt, SYSTEM, "Does it stop?")
    assert changed_tokens(prompt, prompt, parts["visual"]) is None
    groups = groups_of(Side(prompt, parts), Side(prompt, parts))
    assert groups is not None and not groups["unchanged"].any()
    assert groups["changed"].tolist() == parts["visual"].tolist()


def test_prompts_of_another_form_have_no_groups() -> None:
    of, frames, times = pocket()
    one = side(of, frames, times)
    assert groups_of(one, side(of, frames, times, QUESTION.replace("left or right", "left, right or behind"))) is None
    assert groups_of(one, side(of, frames, times + 10)) is None  # stamps of more digits
    assert groups_of(one, side(of, frames, times, QUESTION.replace("left or right", "right or left"))) is not None


# --- where nulls come from --------------------------------------------------------------------------------------------


@pytest.fixture
def entry(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> ModelEntry:
    made = tiny_entry(tmp_path / "checkpoint")
    patching = {"patching": {"pairs": PAIRS, "sites": ["residual", "attention"], "exact": 6, "stride": 1}}
    monkeypatch.setattr("tests.mechanism.study.SETTINGS", SETTINGS | patching)
    register(monkeypatch, made)
    return made


def content(prompt: Prompt) -> tuple[bytes, ...]:
    return tuple(prompt.inputs[name].numpy().tobytes() for name in sorted(prompt.inputs))


def with_longer_voids(root: Path) -> Workspace:
    """A study whose chaotic voids go on for longer than their controls, so that the sides have other time stamps, and
    whose question about plinko-2 is longer than the others."""
    workspace = make_study(root)
    items = workspace.tables.read(ITEMS, {"dataset": "chaotic"})
    for number, row in enumerate(items.to_dict("records")):
        if row["side"] == "void":
            noise = np.random.default_rng(number).integers(0, 256, (6, 6, 8, 3))
            encode(list(np.kron(noise, np.ones((1, 8, 8, 1))).astype(np.uint8)), workspace.resolve(row["clip"]), 2)
    items["media_digest"] = [file_digest(workspace.resolve(path)) for path in items["clip"]]
    longer = items["scenario_id"] == "plinko-2"
    items.loc[longer, "question"] = "Does plinko-2 end left, right or behind the wall?"
    rows = [ITEMS.row_type(**{str(name): value for name, value in row.items()}) for row in items.to_dict("records")]
    workspace.tables.write(ITEMS, {"dataset": "chaotic"}, rows, {})
    workspace.tables.write(PROBE_ITEMS, {"dataset": "chaotic"}, probe_items(workspace, "chaotic"), {})
    return workspace


def test_a_null_is_the_next_scenario_that_fits_or_the_own_frames_with_the_other_sides_times(
    entry: ModelEntry, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    workspace, of = with_longer_voids(tmp_path), load_local_model(entry, inside=True)
    assert entry.media is not None
    names = {}
    rows = {
        (row["scenario_id"], row["side"]): row
        for row in workspace.tables.read(ITEMS, {"dataset": "chaotic"}).to_dict("records")
    }
    for (name, which), row in rows.items():
        for times_of in SIDES:
            shown = pick_frames(workspace.resolve(row["clip"]), entry.media)
            times = pick_frames(workspace.resolve(rows[name, times_of]["clip"]), entry.media).times_s
            prompt = of.prompt(vqa_prompt("standard"), row["question"], shown.frames, times)
            names[content(prompt)] = (name, which, times_of)
    assert len(names) == 2 * 2 * PAIRS  # no two of them alike

    prompts: dict[int, tuple[str, str, str]] = {}
    kept: list[RecordedPass] = []
    pairs: list[tuple[tuple[str, str, str], tuple[str, str, str]]] = []

    def recording(of: LocalModel, prompt: Prompt, *rest: Any) -> RecordedPass:
        recorded = trace_pass(of, prompt, *rest)
        kept.append(recorded)  # or another one might get its address
        prompts[id(recorded)] = names[content(prompt)]
        return recorded

    def changes(
        _: LocalModel, target: RecordedPass, source: RecordedPass, patches: Sequence[Patch], __: Any
    ) -> np.ndarray:
        pairs.append((prompts[id(target)], prompts[id(source)]))
        return np.full(len(patches), float(pairs[-1][0][1] != pairs[-1][1][1]))  # 1 for frames of the other side

    monkeypatch.setattr(patching_stage, "trace_pass", recording)
    monkeypatch.setattr(patching_stage, "patched_changes", changes)
    made = patching_rows(workspace, entry, TINY)
    order = seeded_order(sorted({name for name, _ in rows}), workspace.mechanism.seed)
    fitting = [name for name in order if name != "plinko-2"]
    expected = set()
    for name, (into, towards) in [(n, pair) for n in order for pair in (SIDES, SIDES[::-1])]:
        target = (name, into, into)
        expected |= {(target, (name, towards, towards)), (target, (name, into, towards))}
        if name in fitting:
            following = fitting[(fitting.index(name) + 1) % len(fitting)]
            expected |= {(target, (following, towards, towards)), (target, (following, into, into))}
    assert set(pairs) == expected and len(pairs) == len(expected)
    for row in (row for row in made if row.effect is not None):  # plinko-2 has no scenario of its form
        null = row.source in ("other scenario", "same side")
        assert (row.effect != 0) == (row.source in ("pair", "other scenario"))
        assert (row.n, row.n_left_out) == ((PAIRS - 1, 1) if null else (PAIRS, 0)), row
    assert {row.source for row in made} == {"pair", "other scenario", "same side", "other times"}
    cells = [
        {(row.into, row.site, row.layer, row.group) for row in made if row.source == source and row.effect is not None}
        for source in patching_stage.SOURCES
    ]
    assert len(cells[0]) == 2 * 6 and all(of_null == cells[0] for of_null in cells)


# --- a killed run -----------------------------------------------------------------------------------------------------


def test_a_killed_run_goes_on_behind_its_last_pair_and_gives_the_same_rows(entry: ModelEntry, tmp_path: Path) -> None:
    workspaces = [make_study(tmp_path / name) for name in ("killed", "alone")]
    for workspace in workspaces:
        for dataset in patching_stage.WELL_POSED:
            workspace.tables.write(PROBE_ITEMS, {"dataset": dataset}, probe_items(workspace, dataset), {})

    killed, written = start("patch", workspaces[0].root, entry), workspaces[0].root / "patching"
    while len([*written.rglob("*-patches-*.json")]) < 2:  # behind the estimates of a dataset, amid its patches
        assert killed.poll() is None
        time.sleep(0.02)
    killed.kill()
    killed.communicate()
    again, whole = (printed(start("patch", workspace.root, entry)) for workspace in workspaces)
    assert again["content"] == whole["content"] and whole["made"] > 0
    per_pair = whole["made"] / (2 * PAIRS)  # half of the pairs were estimated, and two of them patched
    assert again["made"] <= whole["made"] - per_pair
