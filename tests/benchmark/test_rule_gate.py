"""What gives the sides away fails the gate of joined rules; the released records pass it."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from bench import rule_gate
from bench.rule_gate import above_limits, metrics, rows_of, rule_tables
from traps_pipeline.base.paths import TWO_EVENTS_RELEASED
from traps_pipeline.benchmark.filmed_lanes import trajectories_of
from traps_pipeline.benchmark.records import two_events_lines
from traps_pipeline.protocol.two_events import lane_items
from traps_pipeline.scenes.worlds.lanes import TwoLanes

FAMILIES = ("slide", "drop_split", "chain", "tower", "catch", "topple")


def items(planted: Callable[[TwoLanes], TwoLanes]) -> pd.DataFrame:
    """Two scenarios of each of six families, with a leak."""
    lines = two_events_lines(TWO_EVENTS_RELEASED)
    specs = [lines[f"{family}-e{n:03d}"].spec for family in FAMILIES for n in (1, 2)]
    worlds = [planted(spec.world(trajectories_of(spec)["qpos"])) for spec in specs]
    return pd.DataFrame([row for spec, world in zip(specs, worlds, strict=True) for row in rows_of(spec, world)])


def without_doubles(world: TwoLanes) -> TwoLanes:
    for name in (*world.doubles(0), *world.doubles(1)):
        world.model.geom(name).rgba[3] = 0
    return world


def strips_behind_boards(world: TwoLanes) -> TwoLanes:
    """The board before a scene comes so near that it hides the lane's strip, too."""
    layouts = []
    for layout in world.layouts:
        scene, bench = layout.boards
        (x, _, z), (across, thick, up) = scene.centre, scene.half
        near = replace(scene, centre=(x, layout.strip.low[1] - 0.05, z), half=(1.5 * across, thick, up))
        layouts.append(replace(layout, boards=(near, bench)))
    return replace(world, layouts=layouts)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("planted", "named"),
    [(lambda world: world, None), (without_doubles, "D place"), (strips_behind_boards, "C colours")],
)
def test_a_planted_leak_is_named_by_the_rule_that_finds_it(planted: Callable[[TwoLanes], TwoLanes], named: str | None):
    failures = above_limits(rule_tables(items(planted)))
    if named is None:
        assert not [line for line in failures if not line.startswith("D place")]  # twelve scenarios are few for D
    else:
        assert any(line.startswith(named) for line in failures), failures


def asked(scenarios: int) -> pd.DataFrame:
    all_items = [item for n in range(scenarios) for item in lane_items(f"slide-e{n:03d}")]
    columns = ("item_id", "scenario_id", "side")
    rows = [{name: getattr(item, name) for name in columns} | {"category": "hidden"} for item in all_items]
    return pd.DataFrame(rows)


def test_a_rule_is_above_the_limits_by_its_conjunction_or_by_its_specificity():
    frame = asked(20)
    hidden = (frame["side"] == "void").to_numpy()
    once = hidden & frame["scenario_id"].eq("slide-e000").to_numpy()  # right about one scenario of twenty
    twice = hidden & frame["scenario_id"].isin(["slide-e000", "slide-e001"]).to_numpy()
    table = metrics(frame, {"B words": once, "C colours": twice, "A clip": np.zeros(len(frame), bool)})
    assert table["conjunction"].tolist() == [1 / 20, 2 / 20, 0] and table["specificity"].tolist() == [0.05, 0.1, 0]
    failures = above_limits({"written": table.iloc[:0], "families held out": table})
    assert len(failures) == 1 and failures[0].startswith("C colours: conjunction 0.10 ")


@pytest.mark.slow
def test_the_released_records_pass(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]):
    monkeypatch.setattr(sys, "argv", ["rule_gate", "--cache", str(tmp_path / "seen.parquet")])
    with pytest.raises(SystemExit) as end:
        rule_gate.main()
    assert end.value.code is None, end.value.code
    assert "240 scenarios, 30 families" in capsys.readouterr().out
