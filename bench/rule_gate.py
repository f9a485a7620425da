"""Fail a release whose two events are passed by a rule that follows no event (docs/scoring.md, "Two events").

Where a rule does not abstain it answers like an oracle, so that each metric bounds what it can earn. Frames are drawn
from the records, half a second apart. Learned rules are boosted trees:

A: of the clip alone. B: of the words alone. C: joined by the named colours: how much of them is in the picture in each
frame. D: joined by place: of the named lane alone, in its upper and its lower stage (two boards mark them), in each
frame: boards, things in the asked one's colour, what moves. D+: also other colours, by which scene and bench could be
told apart: it finds objects.

    python -m bench.rule_gate
"""

from __future__ import annotations

import argparse
import re
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from sklearn.ensemble import HistGradientBoostingClassifier
from sklearn.feature_extraction.text import CountVectorizer
from sklearn.model_selection import GroupKFold

from bench.quick import parse
from traps_pipeline.base.digests import file_digest
from traps_pipeline.base.paths import TWO_EVENTS_RELEASED, WORKSPACES
from traps_pipeline.base.workers import run_in_order
from traps_pipeline.benchmark.filmed_lanes import trajectories_of
from traps_pipeline.benchmark.lane_balance import balance, lane_numbers
from traps_pipeline.benchmark.records import two_events_lines
from traps_pipeline.protocol.datasets import TWO_EVENTS
from traps_pipeline.protocol.two_events import CLIPS, LANES
from traps_pipeline.scenes.physics.kit import COLOURS
from traps_pipeline.scenes.picture.render import Renderer
from traps_pipeline.scenes.worlds.lane_records import TwoEventsSpec
from traps_pipeline.scenes.worlds.lanes import TwoLanes
from traps_pipeline.scoring.two_way import CELLS, LOWEST, two_way

STEP = 5  # frames from one that is looked at to the next
PLAY = ("red", "green", "blue", "yellow", "orange", "cyan", "purple", "black", "white")
ASIDES = ("what", "which colour", "from which", "towards which", "how many numbered")  # first words of asides
LATE = -4  # frames from here on are late ones
MOVED = 24  # difference of a pixel that moves, of 255
FOLDS = {"scenarios": ("scenario_id", 5), "families": ("family", 10)}
LEARNED = {"A clip": r"^a ", "B words": "words", "C colours": r"^c ", "D place": r"^d (?!named)", "D+ objects": r"^d "}
ENDS = ("conjunction", "specificity")
# The largest of both of a released benchmark, families held out.
LIMITS = dict.fromkeys(("twelve lines", "A clip", "B words", "C colours"), (0.05, 0.15)) | {"D place": (0.6, 1.0)}
RESAMPLES = 2000


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--records", type=Path, default=TWO_EVENTS_RELEASED, help="folder of records of two events")
    parser.add_argument("--families", nargs="+", metavar="FAMILY", help="of these alone")
    parser.add_argument("--cache", type=Path, default=WORKSPACES / "rule_gate.parquet", help="what is seen in frames")
    parser.add_argument("--workers", type=int, default=1)
    arguments = parse(parser, families=["slide", "drop_split", "chain"])
    lines = two_events_lines(arguments.records).values()
    specs = [line.spec for line in lines if not arguments.families or line.family in arguments.families]
    items = seen_items(specs, arguments.records, arguments.cache, arguments.workers)
    tables = rule_tables(items)
    print(balance(lane_numbers(specs)).round(3).to_string(index=False))
    print(f"\n{len(items)} items of {len(specs)} scenarios, {items['family'].nunique()} families")
    for title, table in tables.items():
        print(f"\n{title}\n{table[[*LOWEST, 'specificity_ci_high', *CELLS]].round(2).to_string()}")
    sys.exit("\n".join(above_limits(tables)) or None)


def rule_tables(items: pd.DataFrame) -> dict[str, pd.DataFrame]:
    """Return TWO_WAY rows of rules by their names: of those that are written, and of those fitted on other groups."""
    rows = items.to_dict("records")
    decisions = {"written": {name: np.array([rule(row) for row in rows]) for name, rule in WRITTEN.items()}}
    for title, (column, folds) in FOLDS.items():
        groups = items[column].to_numpy()
        decisions[f"{title} held out"] = {
            name: learned(items, columns, groups, folds) for name, columns in LEARNED.items()
        }
    return {title: metrics(items, of_rules) for title, of_rules in decisions.items()}


def above_limits(tables: Mapping[str, pd.DataFrame]) -> list[str]:
    """Return a sentence for each rule that earns more than a release allows."""
    released = pd.concat([tables["written"], tables["families held out"]]).to_dict("index")
    found = [(str(name), *(float(row[end]) for end in ENDS)) for name, row in released.items() if name in LIMITS]
    return [
        f"{name}: conjunction {conjunction:.2f} and specificity {specificity:.2f} of a rule that follows no event; at "
        f"most {LIMITS[name][0]} and {LIMITS[name][1]} are released: find what gives the sides away"
        for name, conjunction, specificity in found
        if conjunction > LIMITS[name][0] or specificity > LIMITS[name][1]
    ]


# --- what is seen -----------------------------------------------------------------------------------------------------


def seen_items(specs: Sequence[TwoEventsSpec], records: Path, cache: Path, workers: int = 1) -> pd.DataFrame:
    """Return the items of records, with what each class of rules knows of them; cached by record and this file."""
    code = file_digest(Path(__file__))
    keys = {f"{code} {spec.spec_hash}": spec for spec in specs}
    stored = pd.read_parquet(cache) if cache.is_file() else pd.DataFrame({"key": pd.Series(dtype=str)})
    stored = stored.loc[stored["key"].str.startswith(code)]
    missing = [(key, spec, records) for key, spec in keys.items() if key not in set(stored["key"])]
    drawn = pd.DataFrame([row for _, rows in run_in_order(_drawn, missing, workers) for row in rows])
    items = pd.concat([frame for frame in (stored, drawn) if len(frame)], ignore_index=True)
    cache.parent.mkdir(parents=True, exist_ok=True)
    items.to_parquet(cache)
    return items.loc[items["key"].isin([*keys])].reset_index(drop=True)


def _drawn(job: tuple[str, TwoEventsSpec, Path]) -> list[dict[str, object]]:
    key, spec, records = job
    qpos = trajectories_of(spec, records / "trajectories" / f"{spec.scenario_id}.npz")["qpos"]
    return [{"key": key, **row} for row in rows_of(spec, spec.world(qpos))]


def rows_of(spec: TwoEventsSpec, world: TwoLanes) -> Iterator[dict[str, object]]:
    """Yield a record's eight items with what each class of rules knows of them."""
    with Renderer(world.model, world.camera, supersample=1) as renderer:
        drawn = {
            name: np.stack([frame[::2, ::2] for frame in renderer.frames(world.clip(CLIPS[name])[::STEP])])
            for name in ("neither", "both")
        }
    named = named_colours(spec.question)
    asked = asked_colour(world, named)
    strips = [record.lane.strip for record in spec.lanes]
    seen, counts = {}, {}
    for lane, hidden in product(range(2), (False, True)):  # lanes do not reach into each other's half of the picture
        frames = drawn["both" if hidden else "neither"].astype(np.int16)[:, :, 160 * lane : 160 * (lane + 1)]
        seen[lane, hidden] = lane_numbers_of(frames, asked, named)
        counts[lane, hidden] = {c: like(frames, c).sum(axis=(1, 2)) for c in {asked, *named, *strips}}
    for asked_item in spec.questions():
        item = asked_item.item
        lane, hidden = LANES.index(item.lane), CLIPS[item.clip]
        strip = strips[lane]
        whole = {c: np.sum([counts[k, hidden[k]][c] for k in range(2)], axis=0) for c in {strip, asked, *named}}
        yield {
            **{name: getattr(item, name) for name in ("item_id", "scenario_id", "side")},
            **{"family": spec.family, "category": spec.category, "question": asked_item.text},
            **{f"a {k} {name}": value for k in range(2) for name, value in seen[k, hidden[k]].items()},
            **{
                f"c {n} {i}": float(v) for n, c in enumerate((strip, asked, *named[:2])) for i, v in enumerate(whole[c])
            },
            **{f"d {name}": value for name, value in seen[lane, item.asked_hidden].items()},
            "least": min(float(whole[colour].max()) for colour in (strip, *named)),
        }


def named_colours(question: str) -> list[str]:
    """Return the colours that a question names, in its order."""
    return [word for word in re.findall(r"[a-z]+", question.lower()) if word in PLAY]


def asked_colour(world: TwoLanes, named: list[str]) -> str:
    """Return the colour of what decides, of those that are named if it is one of them."""
    model = world.model
    colours = [model.geom(name).rgba[:3] for name in world.doubles(0)]
    near = {name: min(float(np.abs(c - np.array(COLOURS[name])).sum()) for c in colours) for name in PLAY}
    return min(near, key=lambda name: (near[name], name not in named))


def like(frames: np.ndarray, colour: str) -> np.ndarray:
    """Return which pixels (F, H, W) look like a colour, in shade too."""
    wanted, values = np.array(COLOURS[colour]) * 255, frames.astype(np.float32)
    if max(wanted) - min(wanted) < 30:  # black or white
        return (
            (values.max(axis=-1) < 50) & (np.ptp(values, axis=-1) < 14) if wanted[0] < 60 else values.min(axis=-1) > 225
        )
    norm = np.linalg.norm(values, axis=-1) * np.linalg.norm(wanted)
    return (
        (values @ wanted.astype(np.float32) > 0.975 * norm)
        & (values.max(axis=-1) > 60)
        & (np.ptp(values, axis=-1) > 50)
    )


def boards(frames: np.ndarray) -> np.ndarray:
    """Return which pixels (F, H, W) are of a board."""
    red, green, blue = (frames[..., channel] for channel in range(3))
    return (red < 60) & (green < 60) & (blue > red + 18) & (blue < 120)


def lane_numbers_of(frames: np.ndarray, asked: str, named: list[str]) -> dict[str, float]:
    """Return numbers of a lane's half of the picture: of its upper and its lower stage, in each frame, and late."""
    board = boards(frames)
    rows = np.flatnonzero(board.any(axis=0).sum(axis=1) > 10)
    ever = board[:, rows.min() :].all(axis=0) if len(rows) else board[0]
    still = np.flatnonzero(ever.sum(axis=1) > 10) + (rows.min() if len(rows) else 0)
    middle = still_edge(board, still)
    masks = {
        "board": board,
        "asked": like(frames, asked) & ~board,
        "moves": np.abs(np.diff(frames, axis=0, append=frames[-1:])).max(axis=-1) > MOVED,
        "named": np.any(
            [like(frames, colour) for colour in named if colour != asked] or [np.zeros_like(board)], axis=0
        ),
    }
    numbers: dict[str, float] = {"still upper": float(len(still) > 0 and still.mean() < middle)}
    for name, mask in masks.items():
        for stage, part in (("upper", slice(0, middle)), ("lower", slice(middle, None))):
            counts = mask[:, part].sum(axis=(1, 2)).astype(float)
            numbers |= {f"{name} {stage} {i}": float(count) for i, count in enumerate(counts)}
            numbers |= {
                f"{name} {stage} most late": counts[LATE:].max(),
                f"{name} {stage} least late": counts[LATE:].min(),
            }
        for stage, part in (("still", True), ("other", False)):  # the stage of the still board, and the other one
            is_upper = bool(numbers["still upper"]) == part
            counts = mask[:, slice(0, middle) if is_upper else slice(middle, None)].sum(axis=(1, 2)).astype(float)
            numbers |= {f"{name} {stage} {i}": float(count) for i, count in enumerate(counts)}
    return numbers


def still_edge(board: np.ndarray, still: np.ndarray) -> int:
    """Return the row between the stage of the still board and the other one: an edge of the still board."""
    if not len(still):
        return board.shape[1] // 2
    outside = board.sum(axis=(0, 2))  # where the other board stands; on its way it is in fewer frames
    above, below = int(outside[: still.min()].sum()), int(outside[still.max() + 1 :].sum())
    return int(still.min()) if above > below else int(still.max()) + 1


# --- rules ------------------------------------------------------------------------------------------------------------


def twelve_lines(item: Mapping[str, Any]) -> bool:
    """Abstain as the rule that earned version 0.3: by the clip's looks or an absent colour, unless it is an aside."""
    question = item["question"].split(": ", 1)[1]
    looks_void = item["a 0 board upper 0"] + item["a 0 board lower 0"] + item["a 1 board upper 0"] > 250
    is_aside = question.startswith(ASIDES)
    return bool((looks_void or item["least"] < 3) and not is_aside)


def late(item: Mapping[str, Any], name: str, stage: str) -> float:
    return float(item[f"d {name} {stage} most late"])


WRITTEN: dict[str, Callable[[Mapping[str, Any]], bool]] = {
    "twelve lines": twelve_lines,
    "board below": lambda item: bool(item["d still upper"] == 0),
    "board above": lambda item: bool(item["d still upper"] == 1),
    "nothing alike, late": lambda item: late(item, "asked", "upper") + late(item, "asked", "lower") < 6,
    "never": lambda item: False,
    "always": lambda item: True,
}


def learned(items: pd.DataFrame, columns: str, groups: np.ndarray, folds: int) -> np.ndarray:
    """Return the decisions of trees that are fitted on other groups."""
    words = CountVectorizer(ngram_range=(1, 2), binary=True, max_features=300)
    known = (
        words.fit_transform(items["question"]).toarray()
        if columns == "words"
        else items.filter(regex=columns).to_numpy(float)
    )
    hidden, abstains = (items["side"] == "void").to_numpy(), np.zeros(len(items), bool)
    for train, test in GroupKFold(min(folds, len(set(groups)))).split(known, groups=groups):
        fitted = HistGradientBoostingClassifier(max_iter=150, learning_rate=0.1, random_state=0).fit(
            known[train], hidden[train]
        )
        abstains[test] = fitted.predict(known[test])
    return abstains


def metrics(items: pd.DataFrame, decisions: Mapping[str, np.ndarray]) -> pd.DataFrame:
    """Return the TWO_WAY row of each rule, by its name, from whether it abstains on each item."""
    about = dict.fromkeys(("regime", "epoch", "panel", "benchmark_version"), "bench") | {
        "dataset": TWO_EVENTS,
        "run": 1,
    }
    control = (items["side"] == "control").to_numpy()
    verdicts = [
        items[["item_id", "scenario_id", "side", "category"]].assign(
            **about, model=name, abstained=abstains, correct=pd.Series(~abstains, items.index).where(control)
        )
        for name, abstains in decisions.items()
    ]
    return two_way(pd.concat(verdicts), RESAMPLES).set_index("model").loc[[*decisions]]


if __name__ == "__main__":
    main()
